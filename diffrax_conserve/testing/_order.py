"""An assertion about the order of a solver."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from .._custom_types import Args, RealScalarLike, Y
from .._tree import eps_of, ravel, tree_sub

_REFINEMENTS = np.array([1, 2, 3, 4, 6])
# Errors below this many units of roundoff of the state are dominated by roundoff.
_FLOOR = 1e3


def assert_order(
    solver: dfx.AbstractSolver,
    terms: PyTree[dfx.AbstractTerm],
    y0: Y,
    *,
    t0: RealScalarLike = 0.0,
    t1: RealScalarLike,
    dt0: RealScalarLike,
    args: Args = None,
    order: RealScalarLike | None = None,
    reference: Y | None = None,
    margin: RealScalarLike = 0.3,
) -> None:
    r"""Asserts that the error of a solver decreases with the step size according to its order.

    Solves with fixed steps of $h/1$, $h/2$, $h/3$, $h/4$ and $h/6$, where $h$ is `dt0`, fits
    $\log(\text{error at } t_1) = p \log h + c$ by least squares, and requires
    $p \ge order - margin$. Errors dominated by roundoff are ignored. A higher order than claimed is
    not a failure.

    **Arguments:**

    - `solver`: a diffrax solver, wrapped or not, that can take fixed steps.
    - `terms`, `y0`, `t0`, `t1`, `dt0`, `args`: as for `diffrax.diffeqsolve`. Choose a smooth
        problem, and a `dt0` in the asymptotic range of the method.
    - `order`: the claimed order. Default: `solver.order(terms)`.
    - `reference`: the exact state at `t1`. Default: computed by `diffrax.Dopri8` with ten times as
        many steps, if `terms` is a `diffrax.ODETerm`; otherwise by `solver` with 48 times as many.
    - `margin`: the accepted difference by which the measured slope is smaller.

    **Raises:**

    `AssertionError` with the table of steps and errors if the slope is too small or a solve fails;
    `ValueError` if there is no order to compare with, or too few errors are above roundoff.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import diffrax_conserve.testing as dct
        import jax

        jax.config.update("jax_enable_x64", True)
        system = dfc.systems.RigidBody()
        solver = dfc.ManifoldProjection(dfc.RK4(), system.manifold)
        term = diffrax.ODETerm(system.vector_field)
        dct.assert_order(solver, term, system.y0, t1=1.0, dt0=0.1)
        ```
    """
    order = solver.order(terms) if order is None else order
    if order is None:
        raise ValueError(f"{type(solver).__name__} states no order for these terms. Pass `order=`.")
    span = jnp.asarray(t1, float) - t0
    count = int(np.ceil(float(jnp.abs(span / dt0)) - 1e-6))
    problem = (terms, jnp.asarray(t0, span.dtype), span, y0, args)
    counts = count * _REFINEMENTS
    finals = [_final(solver, problem, n, int(counts[-1])) for n in counts]
    if reference is None:
        is_ode = isinstance(terms, dfx.ODETerm)
        best, n = (dfx.Dopri8(), 10 * int(counts[-1])) if is_ode else (solver, 48 * count)
        reference = _final(best, problem, n, n)
    errors = np.array([_largest(tree_sub(y, reference)) for y in finals])
    steps = float(span) / counts
    rows = [f"    {abs(h):<12.6g} {e:.3e}" for h, e in zip(steps, errors, strict=True)]
    table = "\n".join(["    step         error", *rows])
    if not np.all(np.isfinite(errors)):
        raise AssertionError(
            f"A solve did not succeed (its error is NaN):\n{table}\n"
            "To look at: a smaller `dt0`; whether the solver works with fixed steps."
        )
    eps = max(eps_of(jnp.result_type(x)) for x in jtu.tree_leaves(reference))
    used = errors > _FLOOR * eps * _largest(reference)
    if np.sum(used) < 2:
        raise ValueError(
            f"The order cannot be measured: all errors but {int(np.sum(used))} are lost in "
            f"roundoff.\n{table}\nTake a larger `dt0`, a longer solve, or float64."
        )
    slope = np.polyfit(np.log(np.abs(steps[used])), np.log(errors[used]), 1)[0]
    if not slope >= order - margin:
        raise AssertionError(
            f"The measured order is {slope:.2f}, but {order:g} is claimed:\n{table}\n"
            "To look at: is `dt0` small enough for the method to be asymptotic? Is the state at "
            "the end of a step moved by more than the local error?"
        )


def _largest(y: Y) -> float:
    return float(jnp.max(jnp.abs(ravel(y)), initial=0))


@eqx.filter_jit
def _final(
    solver: dfx.AbstractSolver,
    problem: tuple[PyTree[dfx.AbstractTerm], Array, Array, Y, Args],
    count: Any,
    count_max: int,
) -> Y:
    terms, t0, span, y0, args = problem
    sol = dfx.diffeqsolve(
        terms, solver, t0, t0 + span, span / count, y0, args, max_steps=count_max + 2, throw=False
    )
    # NaN in the table marks the solves that failed.
    okay = dfx.is_okay(sol.result)
    return jtu.tree_map(lambda y: jnp.where(okay, y[-1], jnp.nan), sol.ys)
