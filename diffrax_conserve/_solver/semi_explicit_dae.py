"""Differential-algebraic equations of index 1: the algebraic unknowns are solved for in each
evaluation of the vector field, and only carried along as a guess."""

import functools as ft
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, final

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.scipy as jsp
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from .._constants import ROUNDOFF, SHORTER
from .._custom_types import Args, RealScalarLike, State, Values, Y
from .._manifold import Constraint, exactly, slope_like
from .._options import check_function
from .._projection.base import AbstractProjection, Problem, ProjectionInfo
from .._projection.options import check_state
from .._step.equations import shown_terms
from .._step.implicit import root
from .._step.iterate import Solved, after_step, any_lane, iterate, keep_done
from .._step.roundoff import hidden_terms
from .._tree import ravel, tree_shapes, unravel
from .manifold_projection import ManifoldProjection

Algebraic = Callable[[RealScalarLike, Any, Any, Args], Values]

# Newton's method ends after this many attempts at a correction. In a solve it needs a few. From a
# rough guess it may need many: if the voltage at a diode is guessed too large, each correction
# lowers it by one thermal voltage, of 0.025 V, because the current is exponential.
_MAX_STEPS = 500


@final
class SemiExplicitDAE(eqx.Module):
    r"""A differential-algebraic equation of index 1 for a pair $(x, z)$ of PyTrees,

    $$x' = f(t, x, z, args), \qquad 0 = g(t, x, z, args), \qquad \det \partial g/\partial z \ne 0.$$

    Wherever a solver evaluates the vector field, $z$ is first solved for by Newton's method, from
    the $z$ of the stage as a guess. So $x$ is the solution of $x' = f(t, x, Z(t, x))$ by any solver
    of diffrax, with its order and its stability, as if $Z$ were known as a formula. The guess
    follows $z' = -g_z^{-1} (g_t + g_x f)$, by which $z$ has an error estimate too. `wrap` solves
    for $z$ at the end of each step, at saved times, in dense output and at events.

    Derivatives in both modes follow from the implicit function theorem. Where $g_z$ is singular, or
    Newton's method finds no root, the vector field is NaN: a solve with fixed steps then fails, one
    with adaptive steps tries shorter ones first, and is never successful.

    Equations of index 2 or 3, such as those of mechanisms, have a singular $g_z$: see
    [Differential-algebraic equations][differential-algebraic-equations].

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        # A condenser at x volts discharges through a resistor and a diode with z volts.
        def current(z):
            return 1e-9 * jnp.expm1(z / 0.025)

        dae = dfc.SemiExplicitDAE(
            lambda t, x, z, args: -current(z) / 1e-6,
            lambda t, x, z, args: x - z - 1e3 * current(z),
        )
        y0 = dae.consistent(jnp.array(5.0), jnp.array(0.5))
        print(f"{y0[1]:.3f}")
        solver, steps = dae.wrap(diffrax.Kvaerno3()), diffrax.PIDController(rtol=1e-5, atol=1e-8)
        sol = diffrax.diffeqsolve(
            dae.term, solver, 0, 1e-3, 1e-5, y0, stepsize_controller=steps
        )
        ```

        ```text
        0.383
        ```

    ??? cite "Reference"

        Hairer and Wanner, *Solving Ordinary Differential Equations II*, Springer 1996, VI.1, the
        "state space form method"; P. Deuflhard, *Newton Methods for Nonlinear Problems*, Springer
        2004, Section 3.3, for the damping.
    """

    f: Callable[[RealScalarLike, Any, Any, Args], Any]
    g: Algebraic

    def __check_init__(self):
        for name, returns in (("f", "the slope of `x`"), ("g", "as many numbers as `z` has")):
            check_function(
                f"`{name}` of a `SemiExplicitDAE`",
                getattr(self, name),
                f"{name}(t, x, z, args)",
                returns,
            )

    @property
    def term(self) -> dfx.ODETerm[Any]:
        """The term for [`diffrax.diffeqsolve`][], whose state is the pair $(x, z)$."""
        return dfx.ODETerm(self._vector_field)

    def wrap(self, solver: dfx.AbstractSolver[Any]) -> ManifoldProjection:
        """A solver whose steps and dense output keep $0 = g$ to roundoff.

        **Arguments:**

        - `solver`: any solver of diffrax for ordinary differential equations; an implicit one if
            the equation without $z$ is stiff.

        **Returns:**

        A [`diffrax_conserve.ManifoldProjection`][] whose projection moves only $z$.

        **Raises:**

        `TypeError` if `solver` is none.
        """
        constraint = Constraint(_OfPair(self.g))
        return ManifoldProjection(solver, {"g": constraint}, projection=_Root(g=self.g))

    def consistent(
        self, x: State, z: Any, *, t: RealScalarLike = 0.0, args: Args = None
    ) -> tuple[State, Any]:
        """The state $(x, z)$ with the given $x$, and the $z$ that solves $g = 0$.

        Use it at the start, and after an event that changes $x$, `args` or the equations. Newton's
        method is damped, and may start from a rough guess.

        **Arguments:**

        - `x`: the differential part, which is kept.
        - `z`: a guess of the algebraic part, with its structure, shapes and dtype.
        - `t`, `args`: passed to `g`.

        **Returns:**

        The pair, as `y0` of [`diffrax.diffeqsolve`][].

        **Raises:**

        `ValueError` or `TypeError` if the states or the value of `g` do not fit; at run time, an
        error if Newton's method finds no root, or if $g_z$ is singular there.
        """
        x, z = jtu.tree_map(jnp.asarray, (x, z))
        t = jnp.asarray(t, jnp.result_type(float, t))  # not a constant of what is compiled
        return x, unravel(_consistent(self.g, t, x, z, args), z)

    def _vector_field(self, t: RealScalarLike, y: Y, args: Args) -> Y:
        x, guess = jtu.tree_map(jnp.asarray, _pair(y))
        t = jnp.asarray(t, jnp.result_type(float, t))
        root = _solved(self.g, t, x, guess, args)
        z = unravel(root, guess)
        slope = slope_like(x, self.f(t, x, z, args))
        residual = lambda t, x, z: _residual(self.g, t, x, z, guess, args)  # noqa: E731
        along = jax.jvp(lambda t, x: residual(t, x, root), (t, x), (jnp.ones_like(t), slope))[1]
        jacobian = jax.jacfwd(lambda z: residual(t, x, z))(root)
        return slope, unravel(_divided(jacobian, -along), guess)


SemiExplicitDAE.__init__.__doc__ = r"""**Arguments:**

- `f`: the vector field of $x$, called as `f(t, x, z, args)`, with a value like `x`.
- `g`: the algebraic equations, called as `g(t, x, z, args)`: a PyTree of real arrays with as many
    numbers as `z` has. JAX differentiates it.

**Raises:**

`TypeError` if one cannot be called so. In a solve, before compilation, `ValueError` if the state is
no pair, or if the numbers of equations and unknowns differ.
"""


@final
class _OfPair(eqx.Module):
    """`g` as a function of the state. Not a closure, with which every `wrap` would compile anew."""

    g: Algebraic

    def __call__(self, t: RealScalarLike, y: Y, args: Args) -> Values:
        x, z = _pair(y)
        return self.g(t, x, z, args)


@final
class _Root(AbstractProjection):
    """The projection that keeps $x$, and solves for $z$."""

    g: Algebraic
    metric: PyTree[ArrayLike] = (jnp.inf, 1.0)
    sees_step: ClassVar[bool] = False

    def solve(
        self, problem: Problem, candidate: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], ProjectionInfo]:
        x, z = _pair(problem.state(candidate))
        root = _solved(self.g, problem.t, x, z, problem.args)
        y = jnp.concatenate([ravel(x), root])
        # Newton's method knows the roundoff of `g` at this state, and is NaN if it misses the root.
        return y, problem.report(candidate, y, ok=jnp.all(jnp.isfinite(y)))


def _pair(y: Any) -> tuple[Any, Any]:
    if not isinstance(y, tuple | list) or len(y) != 2:
        raise ValueError(
            f"The state of a `SemiExplicitDAE` must be a pair `(x, z)`, but it is {tree_shapes(y)}."
            " Pass `y0=dae.consistent(x, z)`."
        )
    return y[0], y[1]


def _residual(
    g: Algebraic, t: RealScalarLike, x: Y, z: Float[Array, " m"], like: Any, args: Args
) -> Float[Array, " m"]:
    return ravel(exactly(_OfPair(g), t, (x, unravel(z, like)), args)).astype(z.dtype)


def _solved(g: Algebraic, t: RealScalarLike, x: Y, z: Any, args: Args) -> Float[Array, " m"]:
    """The numbers of the `z` with `g = 0`, NaN if there is none."""
    check_state((x, z), "`SemiExplicitDAE`")
    found, wanted = eqx.filter_eval_shape(lambda: (ravel(g(t, x, z, args)), ravel(z)))
    if found.size != wanted.size:
        raise ValueError(
            f"`g` of a `SemiExplicitDAE` returns {found.size} numbers, but `z` has {wanted.size}: "
            "there must be as many equations as unknowns."
        )
    t = jnp.asarray(t, jnp.result_type(float, t))
    like = jax.eval_shape(lambda: z)
    residual = lambda z: _residual(g, t, x, z, like, args)  # noqa: E731
    return root(residual, ft.partial(_algebraic_newton, residual), ravel(z), _divided).y


@eqx.filter_jit
def _consistent(g: Algebraic, t: RealScalarLike, x: Y, z: Any, args: Args) -> Float[Array, " m"]:
    root = _solved(g, t, x, z, args)
    return eqx.error_if(
        root,
        ~jnp.all(jnp.isfinite(root)),
        "`consistent` found no `z` with `g(t, x, z, args) = 0` and an invertible `dg/dz`. "
        "Give a better guess `z`. If `dg/dz` is singular at every state, the index is not 1: "
        "for index 2 or 3 use `Constraint` and `tangent`.",
    )


def _divided(jacobian: Float[Array, "m m"], b: Float[Array, " m"]) -> Float[Array, " m"]:
    """`jacobian⁻¹ b`, computed in units in which all elements are about one."""
    if b.size == 1:
        return b / jacobian[0]
    rows, columns = lax.stop_gradient(_sizes(jacobian))
    return jnp.linalg.solve(jacobian / rows[:, None] / columns, b / rows) / columns


def _sizes(jacobian: Float[Array, "m m"]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """The units of equations and unknowns, in which no entry is larger than one."""
    rows = jnp.max(jnp.abs(jacobian), axis=1)
    return rows, jnp.max(jnp.abs(jacobian) / rows[:, None], axis=0)


class _Factored(NamedTuple):
    """The LU decomposition of a Jacobian in the units of its rows and columns. A single number is
    its own: a call of LAPACK would take most of the time of a small solve."""

    lu: tuple[Float[Array, "m m"], Int[Array, " m"]]
    rows: Float[Array, " m"]
    columns: Float[Array, " m"]

    @classmethod
    def of(cls, jacobian: Float[Array, "m m"]) -> "_Factored":
        rows, columns = _sizes(jacobian)
        scaled = jacobian / rows[:, None] / columns
        one = scaled, jnp.zeros(1, jnp.int32)
        return cls(one if rows.size == 1 else jsp.linalg.lu_factor(scaled), rows, columns)

    def correction(self, residual: Float[Array, " m"]) -> Float[Array, " m"]:
        right = residual / self.rows
        one = right.size == 1
        return (
            -(right / self.lu[0][0] if one else jsp.linalg.lu_solve(self.lu, right)) / self.columns
        )

    def regular(self) -> Bool[Array, ""]:
        pivots = jnp.abs(jnp.diagonal(self.lu[0]))  # of columns whose largest entry was one
        return jnp.all(pivots > ROUNDOFF * float(jnp.finfo(pivots.dtype).eps))


def _algebraic_newton(residual: Callable[[Array], Array], z: Float[Array, " m"]) -> Solved:
    """Damped Newton's method with the natural monotonicity test (P. Deuflhard, *Newton Methods for
    Nonlinear Problems*, Springer 2004, 3.3).

    A correction is accepted if the one after it, computed with the same Jacobian, is shorter. So
    the test compares changes of `z`, and does not depend on the units of the equations. A
    correction that is NaN is not accepted. The iteration ends with NaN if there is no root.
    """
    eps = float(jnp.finfo(z.dtype).eps)

    def advance(now: tuple[Array, Array], counter: Array) -> tuple[tuple[Array, Array], Array]:
        z, share = now  # the unknowns, and the share of the correction to try next
        jacobian = jax.jacfwd(residual)(z)
        factored = _Factored.of(jacobian)
        step = factored.correction(residual(z))
        trial = z + share * step
        after = factored.correction(residual(trial))
        size = jnp.maximum(jnp.abs(z), jnp.abs(trial))
        # An unknown near zero is compared with the change that the largest term of one of its
        # equations stands for, whatever the units of the others are.
        slopes = jnp.abs(jacobian)
        terms = jnp.max(slopes * size, axis=1, keepdims=True, initial=0)
        least = jnp.where(slopes > 0, terms / jnp.where(slopes > 0, slopes, 1), jnp.inf)
        size = size + eps**0.5 * jnp.min(least, axis=0, initial=jnp.inf)
        size = jnp.where(size > 0, size, 1)
        before, then = (jnp.max(jnp.abs(d) / size, initial=0) for d in (step, after))
        # Where the linear model is exact, the next correction is `1 - share` times as long. We ask
        # for half of that gain.
        better = then <= (1 - share / 2) * before
        # The later corrections shrink at least by the same ratio, `then / before`. So the one that
        # would follow both is at most `then² / before`, which is roundoff here.
        settled = better & (share == 1) & (then * then <= eps * before) & factored.regular()
        # If a correction of at most `√ε` does not help, it is probably roundoff that keeps it from
        # helping. Whether it is, we ask once, at the end.
        stuck = ~better & (before <= eps**0.5)
        # A share of the root of roundoff still changes half of the digits of the unknown.
        going = ~stuck & (before < jnp.inf) & (better | (share * SHORTER > eps**0.5))
        z = jnp.where(better, trial, z) + jnp.where(settled, after, 0)
        share = jnp.where(better, jnp.minimum(share / SHORTER, 1), share * SHORTER)
        return keep_done(counter, (z, share), now), after_step(settled, going, counter)

    start = z, jnp.ones((), z.dtype)
    (z, _), settled, num_steps, _ = iterate(advance, start, max_steps=_MAX_STEPS)

    def at_roundoff() -> Bool[Array, ""]:
        """Whether the state where the iteration ended is a root as far as rounding lets us see."""
        g, jacobian, hidden = hidden_terms(residual, z)
        limit = ROUNDOFF * eps * (shown_terms(jacobian, jnp.abs(z)) + hidden)
        return jnp.all(jnp.abs(g) <= limit) & _Factored.of(jacobian).regular()

    found = settled | lax.cond(any_lane(~settled), at_roundoff, lambda: jnp.asarray(True))
    return Solved(jnp.where(found, z, jnp.nan), found, num_steps)
