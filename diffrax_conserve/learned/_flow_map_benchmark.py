"""The verdict after a training: error and time of a learned step beside those of classical ones."""

import time
from collections.abc import Callable
from typing import Any, final

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from .._custom_types import Args, Manifold, RealScalarLike
from .._manifold import check_manifold, check_vector_field
from .._options import one_of
from .._solver.manifold_projection import ManifoldProjection
from .._solver.unrolled import RK4
from .._tree import eps_of
from ._networks.flat import (
    as_states,
    check_scalars,
    check_within,
    flatten,
    largest,
    stacked_vectors,
)
from ._networks.flow_map import args_domain_of, as_flow_map, known_args
from ._solvers.checks import check_output
from ._solvers.flow_map_solver import DeepONetSolver

# Substeps that are tried for an equal error.
_SUBSTEPS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)
# Times are those of a solve of so many steps, the fastest of so many.
_STEPS, _REPEATS = 16, 5


@final
class Comparison(eqx.Module):
    """What [`diffrax_conserve.learned.compare`][] returns. `print` shows it as a table.

    **Attributes:**

    - `methods`: the names of the rows, the network first; then, in the same order:
    - `substeps`: the number of steps in one step of the network; 0 if 128 are not enough.
    - `error`, `error_99`: the median and the 99th percentile over the states of the error of one
        step, for each leaf relative to its largest component.
    - `alone`, `batch`: seconds for it, of a single state and of each state in the batch; and
        `alone_projected`, `batch_projected` with a projection. NaN if there is no manifold.
    - `outside`: the number of states from which the step leaves the domain of the flow map.
    - `count`: the number of states.
    - `args_error`, `args_wrong_sign`: of a family, the median relative error of the derivatives of
        the step with respect to `args`, and the share of them that points the wrong way; otherwise
        NaN.
    """

    methods: tuple[str, ...]
    substeps: np.ndarray
    error: np.ndarray
    error_99: np.ndarray
    alone: np.ndarray
    batch: np.ndarray
    alone_projected: np.ndarray
    batch_projected: np.ndarray
    outside: int
    count: int
    args_error: float
    args_wrong_sign: float

    @property
    def verdict(self) -> str:
        """In words, which step is better at an equal error."""
        if not np.isfinite(self.error[0]):
            return "The step of the network is not finite, or that of the reference is not."
        found = []
        for name, times in (
            ("Alone", self.alone),
            ("In the batch", self.batch),
            ("Alone and projected", self.alone_projected),
            ("In the batch and projected", self.batch_projected),
        ):
            usable = np.where(self.substeps > 0, times, np.inf)
            best = int(np.argmin(usable[1:])) + 1
            if np.isnan(times[0]):
                continue
            if np.isinf(usable[best]):
                found.append("No classical step is as accurate with 128 substeps.")
                break
            ratio, other = times[0] / usable[best], self.methods[best]
            if ratio > 1:
                found.append(f"{name}, {other} is better: {ratio:.1f} times as fast.")
            else:
                found.append(f"{name}, the network is {1 / ratio:.1f} times as fast as {other}.")
        if self.outside:
            found.append(f"{self.outside} of {self.count} steps leave the domain of the flow map.")
        if self.args_error > 0.1:
            found.append(
                "Derivatives with respect to `args` are wrong by "
                f"{self.args_error:.1g} in the median; {self.args_wrong_sign:.0%} point the wrong "
                "way: do not estimate parameters with this flow map."
            )
        return " ".join(found)

    def __str__(self) -> str:
        head = ("", "substeps", "error", "99 %", "alone", "projected", "in batch", "projected")
        rows = [" ".join(f"{x:>10}" for x in head)]
        times = self.alone, self.alone_projected, self.batch, self.batch_projected
        for i, name in enumerate(self.methods):
            errors = [f"{x[i]:.1e}" for x in (self.error, self.error_99)]
            shown = ["-" if np.isnan(x[i]) else f"{1e6 * x[i]:.3g} µs" for x in times]
            count = str(self.substeps[i]) if self.substeps[i] else f">{_SUBSTEPS[-1]}"
            rows.append(" ".join(f"{x:>10}" for x in (name, count, *errors, *shown)))
        return "\n".join([*rows, self.verdict])


def compare(
    flow_map: Any,
    vector_field: Callable[[RealScalarLike, Any, Args], Any],
    states: PyTree[Array],
    *,
    step: float | None = None,
    manifold: Manifold | None = None,
    args: Args = None,
) -> Comparison:
    """Prints and returns error and time of a learned step, beside classical steps of equal error.

    RK4, [`diffrax.Tsit5`][] and [`diffrax.Dopri8`][] take as many substeps as their median error
    needs to be that of the network. Times are those of whole solves with fixed steps, on this
    machine as it is now, compiled before. It takes half a minute.

    **Arguments:**

    - `flow_map`: any that [`diffrax_conserve.DeepONetSolver`][] takes.
    - `vector_field`, `args`: $f(t, y, args)$ and its parameters.
    - `states`: initial states, stacked along a leading axis; best those of a test, not of the
        training. They are the batch.
    - `step`: the length of the step. Default: the `max_step` of the flow map.
    - `manifold`: to compare the steps inside a [`diffrax_conserve.ManifoldProjection`][] too.

    **Returns:**

    A [`diffrax_conserve.learned.Comparison`][]. Raises a `ValueError` or `TypeError` if the
    arguments do not fit together.

    !!! example

        ```python
        import contextlib

        import diffrax_conserve as dfc
        import jax

        system = dfc.systems.get("conservative-lorenz")
        flow_map = dfc.load_pretrained("conservative-lorenz")
        states = jax.vmap(system.sample)(jax.random.split(jax.random.key(0), 100))
        with contextlib.redirect_stdout(None):  # without this it prints the table
            verdict = dfc.learned.compare(flow_map, system.vector_field, states)
        ```
    """
    flow_map, states = as_flow_map(flow_map), as_states(states)
    y0 = jtu.tree_map(lambda x: x[0], states)
    check_vector_field(vector_field)
    check_scalars(step=step, above=0.0)
    if manifold is not None:
        check_manifold(manifold)
    step = float(flow_map.max_step if step is None else step)
    check_within("step", step, 0.0, float(flow_map.max_step))
    h = jnp.asarray(step, jnp.result_type(float))
    known = known_args(flow_map, args)
    term = dfx.ODETerm(vector_field)
    with one_of(states, args):
        check_output(flow_map, (y0, *known, h), y0, "flow_map")
        exact = _exact(term, states, h, args)
    unit = flatten(jtu.tree_map(lambda ys, y: jnp.full(y.shape, largest(ys)), exact, y0))

    def errors(solver: dfx.AbstractSolver, count: int) -> np.ndarray:
        found = _solved(solver, term, states, h, h / count, args)
        found = stacked_vectors(found) - stacked_vectors(exact)
        return np.asarray(jnp.max(jnp.abs(found) / unit, axis=1))

    methods: dict[str, dfx.AbstractSolver] = {
        "network": DeepONetSolver(flow_map, check_field=False),
        "RK4": RK4(),
        "Tsit5": dfx.Tsit5(),
        "Dopri8": dfx.Dopri8(),
    }
    goal, rows = float(np.median(errors(methods["network"], 1))), []
    for name, solver in methods.items():
        count, found = 1, errors(solver, 1)
        for count in _SUBSTEPS:
            found = errors(solver, count)
            if name == "network" or np.median(found) <= goal:
                break
        kinds = [solver] if manifold is None else [solver, ManifoldProjection(solver, manifold)]
        times = [
            _seconds(lambda y, k=k, n=count: _solved(k, term, y, _STEPS * h, h / n, args), batch)
            for k in kinds
            for batch in (jtu.tree_map(lambda x: x[:1], states), states)
        ]
        times = [*times, *[np.nan] * (4 - len(times))]
        shown = count if np.median(found) <= goal else 0
        rows.append((name, shown, np.median(found), np.quantile(found, 0.99), *times))
    names, *numbers = zip(*rows, strict=True)
    inside = eqx.filter_jit(jax.vmap(lambda y: flow_map.inside(y, *known, h)))(states)
    args_error, wrong = np.nan, np.nan
    if args_domain_of(flow_map) is not None:
        args_error, wrong = _derivatives(flow_map, term, states, h, args)
    outside = int(jnp.sum(~inside))
    found: Any = *map(np.array, numbers), outside, inside.size, args_error, wrong
    comparison = Comparison(names, *found)
    print(comparison)
    return comparison


@eqx.filter_jit
def _solved(
    solver: dfx.AbstractSolver, term: Any, y0s: Any, end: Array, dt0: Array, args: Args
) -> Any:
    def one(y0: Any) -> Any:
        steps = _STEPS * _SUBSTEPS[-1] + 2
        return dfx.diffeqsolve(
            term, solver, 0.0, end, dt0, y0, args, max_steps=steps, throw=False
        ).ys  # fmt: skip

    return jtu.tree_map(lambda x: x[:, 0], jax.vmap(one)(y0s))


@eqx.filter_jit
def _exact(term: Any, y0s: Any, h: Array, args: Args) -> Any:
    units = jtu.tree_map(largest, y0s)
    return jax.vmap(lambda y0: _reference(term, y0, h, args, units))(y0s)


def _reference(term: Any, y0: Any, h: Array, args: Args, units: Any) -> Any:
    eps = eps_of(h)

    def norm(error: Any) -> Array:
        scaled = jtu.tree_map(lambda e, u: jnp.max(jnp.abs(e), initial=0) / u, error, units)
        return jnp.max(jnp.stack(jtu.tree_leaves(scaled)))

    # Its own tolerances are in units of the state.
    controller = dfx.PIDController(rtol=0, atol=100 * eps, norm=norm)
    found = dfx.diffeqsolve(
        term, dfx.Dopri8(), 0.0, h, None, y0, args, stepsize_controller=controller,
        adjoint=dfx.ForwardMode(), max_steps=100_000, throw=False,
    )  # fmt: skip
    return jtu.tree_map(lambda x: x[-1], found.ys)


@eqx.filter_jit
def _jacobians(flow_map: Any, term: Any, y0s: Any, h: Array, args: Args) -> tuple[Array, Array]:
    vector, restore = ravel_pytree(args)
    flat, units = lambda y: ravel_pytree(y)[0], jtu.tree_map(largest, y0s)

    def both(y0: Any) -> tuple[Array, Array]:
        learned = lambda a: flat(flow_map(y0, *known_args(flow_map, restore(a)), h))  # noqa: E731
        exact = lambda a: flat(_reference(term, y0, h, restore(a), units))  # noqa: E731
        return jax.jacfwd(learned)(vector), jax.jacfwd(exact)(vector)

    return jax.vmap(both)(y0s)


def _derivatives(
    flow_map: Any, term: Any, states: Any, h: Array, args: Args
) -> tuple[float, float]:
    """The median relative error of the derivatives by each of `args`, and the share of them whose
    angle with the exact ones is obtuse."""
    few = jtu.tree_map(lambda x: x[:100], states)
    args = jtu.tree_map(lambda x: jnp.asarray(x, float), args)
    found, exact = (np.asarray(x) for x in _jacobians(flow_map, term, few, h, args))
    size = np.linalg.norm(exact, axis=1)
    error = np.linalg.norm(found - exact, axis=1) / np.where(size > 0, size, 1)
    return float(np.median(error)), float(np.mean(np.sum(found * exact, axis=1) < 0))


def _seconds(run: Callable[[Any], Any], batch: Any) -> float:
    """The time for a step of one state, the shortest of some."""
    jax.block_until_ready(run(batch))
    spent = []
    for _ in range(_REPEATS):
        begun = time.perf_counter()
        jax.block_until_ready(run(batch))
        spent.append(time.perf_counter() - begun)
    return min(spent) / (_STEPS * jtu.tree_leaves(batch)[0].shape[0])
