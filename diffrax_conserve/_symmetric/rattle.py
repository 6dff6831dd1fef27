"""RATTLE: velocity Verlet for positions and velocities with constraints.

A step kicks the velocities by half of the forces, moves the positions such that the constraints
hold at the end (SHAKE), kicks the velocities again, and projects them to those that keep the
constraints.

The velocities at the end of a step belong to a linear system with the matrix `G M⁻¹ Gᵀ` there. The
multipliers of the positions in the next step are found by an iteration for which the same matrix is
good enough, because that is where the step starts. So the matrix is factored once in a step.
"""

import functools as ft
from collections.abc import Callable
from typing import Any, ClassVar, final

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from .._custom_types import VF, Args, BoolScalarLike, DenseInfo, Manifold, RealScalarLike, Values, Y
from .._interpolation import PackedTarget
from .._manifold import Constraint, check_manifold, conserved_values, evaluate, named_entries
from .._options import check_counts, check_number
from .._projection.base import Target
from .._projection.chord import FROZEN_STEPS, after_test, counter
from .._projection.elimination import (
    WRITTEN_OUT_MAX,
    by_triangle,
    combined,
    eliminated,
    gram_matrix,
    gram_solve,
    inverse_triangle,
    times,
)
from .._projection.equations import ON, Equations, Jacobian, any_lane, length, shown_terms
from .._projection.metric import spread
from .._projection.options import MAX_STEPS, check_state, option
from .._projection.simplified_newton import SimplifiedNewton
from .._projection.sparse import BlockGram, SparseRows
from .._solver.diffrax_private import member
from .._solver.state import FIRST, cause_of_failure, started, violated
from .._solver.terms import is_backsolve, is_ode, time_direction
from .._tree import ravel, tree_shapes, tree_stop_gradient, unflatten, unravel
from .shorter_step import ShorterStep, StepOf, root

# For up to this many coordinates, sums over them are written out, so that XLA fuses them. Compile
# time grows with their number; the number is a choice.
_WRITTEN_OUT_COLUMNS = 32
# The linear system for the velocities is solved this many times: once, and then for what is left.
# Where constraints depend on each other, a solve leaves up to the fourth root of roundoff, because
# the inverse is as large as one over what was added to the matrix. Otherwise two would do, and the
# time of a step is the same.
_SOLVES = 4


class _Linear(eqx.Module):
    """The constraints at one position.

    - `jacobian`: `G`.
    - `inverse`: the inverse of `G M⁻¹ Gᵀ`, from five constraints on its triangle, or, with many
      constraints, the blocks of that matrix. By it both the velocities at this position and the
      positions of the next step are found.
    """

    jacobian: Jacobian
    inverse: Float[Array, "m m"] | BlockGram

    def factored(self) -> Callable[[Float[Array, " m"]], Float[Array, " m"]]:
        """The product with the inverse."""
        inverse = lax.stop_gradient(self.inverse)
        if isinstance(inverse, BlockGram):
            return inverse.factored()
        if len(inverse) > WRITTEN_OUT_MAX:
            return by_triangle(inverse)
        return lambda x: _combined(x, inverse)


class _State(eqx.Module):
    """What the next step needs.

    - `at`: the constraints at its start.
    - `slope`: the force divided by the masses, at its start.
    - `multiplier`: that of the last step, the first guess for the next.
    - `hidden`: the part of the scales that the gradients do not show.
    - `off`: whether the start of the solve was off the constraint, so that every step fails.
    """

    at: _Linear
    slope: PyTree[Array]
    multiplier: Float[Array, " m"]
    hidden: Float[Array, " m"]
    off: Bool[Array, ""]


@final
class RATTLE(dfx.AbstractSolver[Any]):
    r"""Velocity Verlet with constraints on the positions: symplectic, symmetric, of second order.

    For $q' = v$, $m v' = F + G^\top \lambda$, $g(t, q) = 0$ with $G = \partial g/\partial q$:

    $$v_{n+1/2} = v_n + \tfrac{h}{2} m^{-1} (F(q_n) + G(q_n)^\top \lambda_n), \quad
    q_{n+1} = q_n + h v_{n+1/2}, \quad g(q_{n+1}) = 0,$$
    $$v_{n+1} = v_{n+1/2} + \tfrac{h}{2} m^{-1} (F(q_{n+1}) + G(q_{n+1})^\top \mu_n), \quad
    \tfrac{d}{dt} g = G(q_{n+1}) v_{n+1} = 0.$$

    The first multiplier is that of SHAKE. The matrix $G m^{-1} G^\top$ is factored once in a step,
    at its end: that gives the velocities there, and the positions of the next step, by an iteration
    that only evaluates $g$. The force is evaluated once in a step. The energy has no drift as long
    as the steps are short enough for the forces.

    The terms are those of `diffrax.SemiImplicitEuler`: for the state `(q, v)` the pair of
    `ODETerm(lambda t, v, args: v)` and `ODETerm(lambda t, q, args: force(q) / masses)`.
    With momenta $p$ in the place of $v$, the terms are $p/m$ and $F$, and `masses` is 1.

    Steps are fixed. A state at a saved time comes from a shorter step. Derivatives follow from the
    implicit function theorem. Redundant constraints, such as of a closed loop, do no harm. A step
    that fails is NaN, and the `diffrax.RESULTS` tells why, as with
    [`diffrax_conserve.ManifoldProjection`][]; so does a start that is off the constraint, in the
    positions or in the velocities, by more than the square root of roundoff.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        rod = dfc.Constraint(lambda t, q, args: jnp.sum(q**2) - 1)
        terms = (
            diffrax.ODETerm(lambda t, v, args: v),
            diffrax.ODETerm(lambda t, q, args: jnp.array([0.0, -9.81])),
        )
        y0 = jnp.array([1.0, 0.0]), jnp.array([0.0, 0.0])
        solver = dfc.RATTLE(rod, masses=1.0)
        q, v = diffrax.diffeqsolve(terms, solver, 0.0, 1.0, 0.01, y0).ys
        assert jnp.abs(jnp.sum(q**2) - 1) < 1e-6  # float32
        ```

    ??? cite "Reference"

        H. C. Andersen, "Rattle: a velocity version of the Shake algorithm for molecular dynamics
        calculations", *J. Comput. Phys.* 52 (1983), 24-34; Hairer, Lubich and Wanner, *Geometric
        Numerical Integration*, Springer 2006, VII.1.4.
    """

    constraint: Manifold
    masses: PyTree[ArrayLike]
    max_steps: int = option(MAX_STEPS, static=True)

    term_structure: ClassVar = (dfx.AbstractTerm, dfx.AbstractTerm)
    interpolation_cls: ClassVar = ShorterStep

    def __check_init__(self):
        check_manifold(self.constraint)
        for name, entry in named_entries(self.constraint):
            if not isinstance(entry, Constraint):
                raise TypeError(
                    f"`{name}` of `RATTLE` is a `FirstIntegral`, but positions have constraints: "
                    "pass `Constraint(lambda t, q, args: ...)`, a function of the positions alone."
                )
        for mass in jax.tree.leaves(self.masses):
            check_number("masses", mass, above=0.0, optional=False)
        check_counts(max_steps=self.max_steps)

    def order(self, terms: PyTree[dfx.AbstractTerm]) -> int:
        del terms
        return 2

    def func(self, terms: PyTree[dfx.AbstractTerm], t0: RealScalarLike, y0: Y, args: Args) -> VF:
        q, v = y0
        return terms[0].vf(t0, v, args), terms[1].vf(t0, q, args)

    def multipliers(
        self, terms: PyTree[dfx.AbstractTerm], t: RealScalarLike, y: Y, args: Args = None
    ) -> Values:
        r"""The multipliers $\lambda$ at a state, shaped like the values of the constraint.

        The forces of the constraints on the positions are $G^\top \lambda$. They follow from
        $d^2 g/dt^2 = 0$. For many states use `jax.vmap`.

        **Arguments:**

        - `terms`: the pair of terms of the solve.
        - `t`, `y`, `args`: the time, the pair of positions and velocities, and the parameters.
        """
        q, v = (jax.tree.map(jnp.asarray, x) for x in y)
        t = jnp.asarray(t, jnp.result_type(float, t))
        values = conserved_values(self.constraint, t, q, args)
        hidden = ravel(values).astype(ravel(q).dtype)
        equations = self._equations(t, q, args, hidden, jnp.asarray(1, t.dtype))
        drift, kick = terms[0].vf, terms[1].vf(t, q, args)

        def slope(t: Array, q: Y, v: Y) -> Values:
            fn = lambda t, q: ravel(evaluate(self.constraint, t, q, args))  # noqa: E731
            return jax.jvp(fn, (t, q), (jnp.ones_like(t), drift(t, v, args)))[1]

        start, along = (t, q, v), (jnp.ones_like(t), drift(t, v, args), kick)
        wrong = jax.jvp(slope, start, along)[1]
        _, jacobian = equations.linearise(ravel(q))
        gram = self._gram(equations, jacobian, self._drift(terms, t, v, args), ravel(v))
        return unflatten(gram_solve(gram, -wrong), values)

    def init(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
    ) -> _State:
        del t1
        if is_backsolve(terms) or not is_ode(terms):
            raise ValueError(
                "`RATTLE` solves ordinary differential equations forwards: its terms must be two "
                "`diffrax.ODETerm`s, and `BacksolveAdjoint` has others. Use "
                "`diffrax.RecursiveCheckpointAdjoint()`."
            )
        q, v = y0
        check_state(y0, "`RATTLE`")
        if tree_shapes(q) != tree_shapes(v):
            raise ValueError(
                f"The positions have the shapes {tree_shapes(q)}, the velocities "
                f"{tree_shapes(v)}. `RATTLE` needs a state `(q, v)` of two parts that are alike."
            )
        spread("masses", self.masses, q)
        direction = time_direction(terms, t0)
        values = conserved_values(self.constraint, t0 * direction, q, args)
        values, hidden = started(values, self.constraint, t0 * direction, q, args)
        equations = self._equations(t0, q, args, hidden, direction)
        drift = self._drift(terms, t0, v, args)
        at, rate = self._linear(equations, t0, q, args, direction, drift, ravel(v))
        # The constraint changes at the rate `∂_t g + G v`. It counts as zero if it is at most `√ε`
        # of the largest rate that velocities of this length can cause: by the inequality of Cauchy
        # and Schwarz that is the product of the lengths of a row of `G` and of `v`.
        squares = jax.tree.map(jnp.square, equations.scaled(at.jacobian))
        lengths = jnp.sqrt(_times(squares, jnp.ones_like(ravel(v))))
        limit = lengths * length(drift(ravel(v)), equations.units) + jnp.abs(rate)
        moves = rate + _times(at.jacobian, drift(ravel(v)))
        off = ~jnp.all(jnp.abs(moves) <= float(jnp.finfo(moves.dtype).eps) ** 0.5 * limit)
        off = off | violated(equations, self.constraint, ravel(q))
        slope = terms[1].vf(t0, q, args)
        return _State(at, slope, jnp.zeros_like(hidden), hidden, off)

    @eqx.filter_jit  # traced once; diffrax alone traces a step three times
    def step(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: _State,
        made_jump: BoolScalarLike,
    ) -> tuple[Y, None, DenseInfo, _State, dfx.RESULTS]:
        state, (q0, v0) = solver_state, y0
        q, v, at = ravel(q0), ravel(v0), state.at
        direction = time_direction(terms, t0)
        h = (t1 - t0) * direction
        per_step = jnp.where(h == 0, 0, 1 / jnp.where(h == 0, 1, h))
        middle = t0 + (t1 - t0) / 2
        drift = self._drift(terms, middle, v0, args)
        slope = lax.cond(
            jnp.asarray(made_jump), lambda: terms[1].vf(t0, q0, args), lambda: state.slope
        )

        equations = self._equations(t1, q0, args, state.hidden, direction)
        kicked = _once(v + h / 2 * ravel(slope))

        # The unknown is `h² λ / 2`, which a multiplier `λ` contributes to the positions. Unlike `λ`
        # itself it is well determined when the step is short.
        def halfway(displacement: Array) -> Array:
            force = _combined(displacement, at.jacobian)
            return kicked + per_step * equations.scaled(equations.scaled(force))

        def position(displacement: Array) -> Array:
            return q + h * drift(halfway(displacement))

        displacement, left = root(
            lambda x: equations.residual(position(x)),
            state.multiplier * (h * h / 2),
            ft.partial(_iterated, equations, position, tree_stop_gradient(at), q, self.max_steps),
            gram_solve,
        )
        half, q1 = _once((halfway(displacement), position(displacement)))
        y1 = unravel(q1, q0)
        slope = terms[1].vf(t1, y1, args)
        kicked = _once(half + h / 2 * ravel(slope))
        drift = self._drift(terms, t1, v0, args)
        at, rate = self._linear(equations, t1, y1, args, direction, drift, kicked)
        v1, settled = _on_tangent(equations, at, rate, drift, kicked)

        ok = (left != -1) & settled
        failed = cause_of_failure(ok, state.off, (q, q1, v1), None, None)
        y1 = y1, unravel(v1, v0)
        y1 = jax.tree.map(lambda y: jnp.where(failed > 0, jnp.nan, y), y1)
        result = dfx.RESULTS.where(failed == 0, dfx.RESULTS.successful, member(FIRST - 1 + failed))
        dense_info = dict(y0=y0, step=PackedTarget(StepOf(self, terms, args, state)))
        multiplier = 2 * displacement * per_step**2
        return y1, None, dense_info, _State(at, slope, multiplier, state.hidden, state.off), result

    def _equations(
        self, t: RealScalarLike, q: Y, args: Args, hidden: Array, direction: Array
    ) -> Equations:
        projection = SimplifiedNewton(metric=jax.tree.map(jnp.asarray, self.masses))
        values = jnp.zeros_like(hidden)
        target = Target(projection, self.constraint, values, hidden, None, args, direction)
        return target.equations(t, q)

    def _drift(self, terms: Any, t: RealScalarLike, v: Y, args: Args) -> Any:
        """The function from velocities `v`, or momenta, to `q'`, both as vectors."""
        return lambda p: ravel(terms[0].vf(t, unravel(p, v), args))

    def _gram(self, equations: Equations, jacobian: Jacobian, drift: Any, p: Array) -> Any:
        """`G M⁻¹ Gᵀ`. With momenta the masses are in `drift`, which is linear: so its derivative is
        applied to each row. With many constraints the derivative is taken as diagonal. If it is
        not, the matrix is only approximate, and the iterations converge more slowly, to the same
        result."""
        forces = equations.scaled(equations.scaled(jacobian))
        if isinstance(jacobian, SparseRows):
            speeds = jax.jvp(drift, (p,), (jnp.ones_like(p),))[1]
            return jacobian.gram(forces.times_columns(speeds))
        along = jax.vmap(lambda x: jax.jvp(drift, (p,), (x,))[1])(forces)
        return _gram_matrix(jacobian, along)

    def _linear(
        self,
        equations: Equations,
        t: RealScalarLike,
        q: Y,
        args: Args,
        direction: Array,
        drift: Any,
        p: Array,
    ) -> tuple[_Linear, Float[Array, " m"]]:
        """The constraints at a position, and their partial derivative `∂_t g`."""
        jacobian = _once(equations.linearise(ravel(q))[1])
        fn = lambda t: ravel(evaluate(self.constraint, t, q, args))  # noqa: E731
        t = t * direction
        rate = jax.jvp(fn, (t,), (jnp.ones_like(t),))[1].astype(p.dtype)
        gram = _once(lax.stop_gradient(self._gram(equations, jacobian, drift, p)))
        return _Linear(
            jacobian, gram if isinstance(gram, BlockGram) else _once(_inverse(gram))
        ), rate


RATTLE.__init__.__doc__ = r"""**Arguments:**

- `constraint`: a [`diffrax_conserve.Constraint`][], or a PyTree of them, on the positions alone:
    `fn(t, q, args)`.
- `masses`: positive numbers or arrays that broadcast against the positions, or a PyTree of them for
    the parts of the positions. An infinite mass is never moved by a constraint.
- `max_steps`: the largest number of iterations of a step.

**Raises:**

`TypeError` or `ValueError` if an argument is none of these, or, in use, if `masses` does not
broadcast, the state is no pair of positions and velocities that are alike, or a term is no
`diffrax.ODETerm`.
"""


def _inverse(gram: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """The inverse of a Gram matrix, or its triangle. If constraints depend on each other, it does
    not exist, and what is returned solves consistent systems with small multipliers."""
    sizes = jnp.sqrt(jnp.where(jnp.diagonal(gram) > 0, jnp.diagonal(gram), 1))
    unit = gram / sizes[:, None] / sizes
    if len(gram) > WRITTEN_OUT_MAX:
        return inverse_triangle(unit, sizes)
    one = jnp.eye(len(gram), dtype=gram.dtype)
    left, right = eliminated(unit, one, one)
    return jnp.sum(right[:, :, None] * left[:, None, :], axis=0) / sizes[:, None] / sizes


# Without a barrier XLA would evaluate an expression once for each use of it.
_once = lax.optimization_barrier


def _combined(multiplier: Float[Array, " m"], rows: Any) -> Float[Array, " n"]:
    """`rowsᵀ multiplier`. XLA is fastest in a batch of small systems if short sums are written
    out."""
    if len(rows) > WRITTEN_OUT_MAX:
        return combined(multiplier, rows)
    return sum(x * row for x, row in zip(multiplier, rows, strict=True))  # pyright: ignore


def _times(rows: Any, x: Float[Array, " n"]) -> Float[Array, " m"]:
    """`rows x`."""
    if len(rows) > WRITTEN_OUT_MAX:
        return times(rows, x)
    return jnp.sum(rows * x, axis=1)


def _gram_matrix(rows: Float[Array, "m n"], others: Float[Array, "m n"]) -> Float[Array, "m m"]:
    """`rows othersᵀ`, written out if it is small."""
    if len(rows) > WRITTEN_OUT_MAX or rows.shape[1] > _WRITTEN_OUT_COLUMNS:
        return gram_matrix(rows, others)
    return sum(a[:, None] * b[None] for a, b in zip(rows.T, others.T, strict=True))  # pyright: ignore


def _iterated(
    equations: Equations, position: Any, at: _Linear, q: Array, max_steps: int, guess: Array
) -> tuple[Float[Array, " m"], Array]:
    """Simplified Newton's method for the multipliers of SHAKE, with the matrix at the start of the
    step: an iteration evaluates the constraint and nothing else. Returns the multipliers and what
    `counter` has left, from a `guess`."""
    # The residuals are compared with their scales at the start of the step, for coordinates as
    # large as at either end.
    sizes = jnp.maximum(jnp.abs(q), jnp.abs(position(jnp.zeros_like(guess))))
    scale, solve = equations.scale(at.jacobian, sizes), at.factored()

    def attempt(solve: Callable[[Array], Array], max_steps: int) -> tuple[Array, Array]:
        def body(carry: tuple[Array, Array]) -> tuple[Array, Array]:
            x, left = carry
            g = _once(equations.residual(_once(position(x))))
            level, _ = equations.level(g, scale)
            # The iteration ends with one more than needed, which is cheap and leaves only roundoff:
            # so after the first test a state does not count as settled. At the first test it may.
            # Then the guess is a solution, and in a step of hardly any length, such as to a saved
            # time just after the start, a correction of roundoff of the positions would be a large
            # velocity.
            level = jnp.where(left > max_steps, level, jnp.minimum(level, ON))
            left = after_test(level, left, extra=1, gives_up=left > 0)
            return jnp.where(left > 0, x - solve(g), x), left

        carry = guess, counter(max_steps)
        return lax.while_loop(lambda carry: any_lane(carry[1] > 0), body, carry)

    if guess.size <= WRITTEN_OUT_MAX:  # constraints that depend on others have the multiplier zero
        return attempt(solve, max_steps)

    def consistent() -> tuple[Array, Array]:
        """Off the manifold the constraints may contradict each other a little, as do those of a
        body with one rod too many. Then the solution of the linear system has a large part that
        moves nothing, but whose roundoff does. So we solve once more, for the change of the
        constraints that the solution causes: in that there is no contradiction."""
        _, moves = jax.linearize(position, guess)
        return attempt(lambda g: solve(_times(at.jacobian, moves(solve(g)))), max_steps)

    first = attempt(solve, min(max_steps, FROZEN_STEPS))
    failed = first[1] == -1
    second = lax.cond(any_lane(failed), consistent, lambda: first)
    return jax.tree.map(lambda a, b: jnp.where(failed, b, a), first, second)


def _on_tangent(
    equations: Equations, at: _Linear, rate: Array, drift: Any, p: Array
) -> tuple[Float[Array, " n"], Bool[Array, ""]]:
    """The velocities nearest to `p` that keep the constraint, `∂_t g + G v = 0`, and whether they
    do so to roundoff."""
    solve = at.factored()

    def moved(x: Array) -> Array:
        return p + equations.scaled(equations.scaled(_combined(x, at.jacobian)))

    def residual(x: Array) -> Array:
        return rate + _times(at.jacobian, drift(moved(x)))

    def iterate(x: Array) -> tuple[Array, None]:
        for _ in range(_SOLVES):
            x = _once(x - solve(residual(x)))
        return x, None

    x, _ = root(residual, jnp.zeros_like(rate), iterate, gram_solve)
    # In a taut chain the multipliers of neighbours are large and cancel. So the roundoff of the
    # velocities is that of the terms, and not of their sum.
    terms = equations.scaled(
        equations.scaled(_combined(jnp.abs(x), jax.tree.map(jnp.abs, at.jacobian)))
    )
    sizes = jnp.abs(drift(p)) + jnp.abs(drift(terms))
    limit = equations.tolerance(jnp.abs(rate) + shown_terms(at.jacobian, sizes))
    return moved(x), jnp.all(jnp.abs(residual(x)) <= limit)
