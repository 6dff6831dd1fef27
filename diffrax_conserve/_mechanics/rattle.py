"""RATTLE: velocity Verlet for positions and velocities with constraints.

A step kicks the velocities by half of the forces, moves the positions such that the constraints
hold at the end (SHAKE), kicks the velocities again, and projects them to those that keep the
constraints.

The velocities at the end of a step follow from a linear system with the matrix `G M⁻¹ Gᵀ` there.
The next step starts there, so the same matrix is good enough for the iteration that finds its
multipliers of the positions. So the matrix is factored once in a step.
"""

import dataclasses
import functools as ft
from typing import Any, ClassVar, final

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from .._constants import MAX_PIVOTED, MAX_STEPS
from .._custom_types import VF, Args, BoolScalarLike, DenseInfo, Manifold, RealScalarLike, Values, Y
from .._hashable import Hashable
from .._interpolation import AsArrays
from .._manifold import Constraint, check_manifold, conserved_values, evaluate, named_entries
from .._numerics.implicit import root
from .._numerics.iterate import Solved, iterate, remaining_after_test
from .._numerics.lanes import any_lane, where_active
from .._numerics.linear import Solve, iterative_refinement
from .._numerics.metric import Diagonal, broadcast_option
from .._numerics.problem import Problem, problem_of
from .._numerics.rows import AbstractGram, AbstractRows, solve_dense
from .._options import check_counts, check_number
from .._projection.options import check_state, option
from .._solver.failure import failure_cause, nan_if_failed, starts_off_manifold
from .._solver.state import StepFingerprint, initial_values
from .._solver.terms import in_field_time, is_backsolve, vector_fields
from .._time import nonzero_length, traced_once
from .._tree import eps_of, ravel, tree_shapes, unflatten, unravel
from .shorter_step import ShorterStep, StepOf


class _Linear(eqx.Module):
    """The constraints at one position.

    - `jacobian`: `G`.
    - `solve`: the solution of a system with the matrix `G M⁻¹ Gᵀ`, as a function of its right
      side. It gives both the velocities at this position and the positions of the next step.
    """

    jacobian: AbstractRows
    solve: Solve


class _State(eqx.Module):
    """What the next step needs.

    - `at`: the constraints, linearised at its start.
    - `slope`: the acceleration by the forces at its start, or with momenta the forces.
    - `multiplier`: the multiplier of the last step, the guess for the next.
    - `cancellation`: the part of the scales that the gradients do not show.
    - `off`: whether a start was off the constraint, so that every step fails.
    - `last_fingerprint`: the end of the last step.
    """

    at: _Linear
    slope: PyTree[Array]
    multiplier: Float[Array, " m"]
    cancellation: Float[Array, " m"]
    off: Bool[Array, ""]
    last_fingerprint: StepFingerprint


@final
class RATTLE(Hashable, dfx.AbstractSolver[Any]):
    r"""Velocity Verlet with constraints on the positions: symplectic, symmetric, of second order.

    For $q' = v$, $m v' = F + G^\top \lambda$, $g(t, q) = 0$ with $G = \partial g/\partial q$:

    $$v_{n+1/2} = v_n + \tfrac{h}{2} m^{-1} (F(q_n) + G(q_n)^\top \lambda_n), \quad
    q_{n+1} = q_n + h v_{n+1/2}, \quad g(q_{n+1}) = 0,$$

    $$v_{n+1} = v_{n+1/2} + \tfrac{h}{2} m^{-1} (F(q_{n+1}) + G(q_{n+1})^\top \mu_n), \quad
    \tfrac{d}{dt} g = G(q_{n+1}) v_{n+1} = 0.$$

    The first multiplier is that of SHAKE. The matrix $G m^{-1} G^\top$ is factored, and the force
    evaluated, once in a step. The energy has no drift as long as the steps are short enough for the
    forces. See [Long runs][long-runs-rattle].

    The terms are those of `diffrax.SemiImplicitEuler`: for the state `(q, v)` the pair of
    `ODETerm(lambda t, v, args: v)` and `ODETerm(lambda t, q, args: force(q) / masses)`. The second
    is the acceleration: a force in its place is a solve with other masses, which no check can tell.
    With momenta $p$ in the place of $v$, the terms are $p/m$ and $F$, and `masses` is 1.

    Steps are fixed. A state at a saved time comes from a shorter step. Derivatives follow from the
    implicit function theorem. A step that fails is NaN, and the `diffrax.RESULTS` tells why, as
    with [`diffrax_conserve.ManifoldProjection`][]; so does a start that is off the constraint, in
    the positions or in the velocities, by more than the square root of roundoff.

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
        zeros = ravel(values).astype(ravel(q).dtype)
        problem = self._problem(t, q, args, zeros)
        drift, kick = terms[0].vf, terms[1].vf(t, q, args)

        def slope(t: Array, q: Y, v: Y) -> Values:
            fn = lambda t, q: ravel(evaluate(self.constraint, t, q, args))  # noqa: E731
            return jax.jvp(fn, (t, q), (jnp.ones_like(t), drift(t, v, args)))[1]

        start, along = (t, q, v), (jnp.ones_like(t), drift(t, v, args), kick)
        to_correct = jax.jvp(slope, start, along)[1]
        _, jacobian = problem.linearise(ravel(q))
        gram = self._gram(problem, jacobian, self._drift(terms, t, v, args), ravel(v))
        return unflatten(gram.solve(-to_correct), values)

    def init(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
    ) -> _State:
        del t1
        if is_backsolve(terms) or len(vector_fields(terms)) < 2:
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
        terms, t0 = in_field_time(terms, 1.0 * t0)
        _, cancellation = initial_values(self.constraint, t0, q, args)
        at, slope, off = self._started(terms, t0, y0, args, cancellation)
        end = StepFingerprint.before_first(self.constraint, cancellation.dtype)
        end = end.at(t0, ravel(y0), args, self.constraint)
        return _State(at, slope, jnp.zeros_like(cancellation), cancellation, off, end)

    def _started(
        self, terms: Any, t0: RealScalarLike, y0: Y, args: Args, cancellation: Array
    ) -> tuple[_Linear, PyTree[Array], Bool[Array, ""]]:
        """What a start determines of a state: `at`, `slope` and `off`."""
        q, v = y0
        problem = self._problem(t0, q, args, cancellation)
        drift = self._drift(terms, t0, v, args)
        at, rate = self._linear(problem, t0, q, args, drift, ravel(v))
        # The constraint changes at the rate `∂_t g + G v`. It counts as zero if it is at most `√ε`
        # of the largest rate that velocities of this length can cause: by the inequality of Cauchy
        # and Schwarz `|∂_t g|` plus the length of a row of `G S` times the length of `S⁻¹ v`.
        squares = jax.tree.map(jnp.square, problem.factor.scaled_rows(at.jacobian))
        lengths = jnp.sqrt(squares.matvec(jnp.ones_like(ravel(v))))
        limit = lengths * problem.factor.norm(drift(ravel(v))) + jnp.abs(rate)
        moves = rate + at.jacobian.matvec(drift(ravel(v)))
        off = ~jnp.all(jnp.abs(moves) <= eps_of(moves) ** 0.5 * limit)
        off = off | starts_off_manifold(problem, self.constraint, ravel(q))
        return at, terms[1].vf(t0, q, args), off

    @traced_once
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
        q, v = ravel(q0), ravel(v0)
        given_terms, (terms, t0, t1) = terms, in_field_time(terms, t0, t1)
        h, per_step = t1 - t0, 1 / nonzero_length(t0, t1)
        middle = t0 + (t1 - t0) / 2
        drift = self._drift(terms, middle, v0, args)
        old = state.at, state.slope, state.off
        last = state.last_fingerprint
        sums, sizes = last.checksums_of(t0, ravel(y0), args, self.constraint)
        changed = last.differs(sums, sizes, self.constraint) | made_jump

        def anew() -> Any:
            new = self._started(terms, t0, y0, args, state.cancellation)
            return jax.tree.map(ft.partial(jnp.where, changed), new, old)

        at, slope, off = lax.cond(any_lane(changed), anew, lambda: old)
        state = dataclasses.replace(state, at=at, slope=slope, off=off)  # for dense output too

        problem = self._problem(t1, q0, args, state.cancellation)
        kicked = _barrier(v + h / 2 * ravel(slope))

        # The unknown is `h² λ / 2`, which a multiplier `λ` contributes to the positions. Unlike `λ`
        # itself it is well determined when the step is short.
        def halfway(displacement: Array) -> Array:
            return kicked + per_step * _impulse(problem, displacement, at.jacobian)

        def largest(displacement: Array) -> Array:
            """By how much the multipliers move the positions, if their terms do not cancel."""
            terms = _largest_impulse(problem, displacement, at.jacobian)
            return jnp.abs(h * drift(per_step * terms))

        def position(displacement: Array) -> Array:
            return q + h * drift(halfway(displacement))

        displacement, found, _, _ = root(
            lambda x: problem.residual(position(x)),
            ft.partial(_shake, problem, position, largest, at, q, self.max_steps),
            state.multiplier * (h * h / 2),
            solve_dense,
        )
        half, q1 = _barrier((halfway(displacement), position(displacement)))
        y1 = unravel(q1, q0)
        slope = terms[1].vf(t1, y1, args)
        kicked = _barrier(half + h / 2 * ravel(slope))
        drift = self._drift(terms, t1, v0, args)
        at, rate = self._linear(problem, t1, y1, args, drift, kicked)
        v1, keeps = _on_tangent(problem, at, rate, drift, kicked)

        ok = found & keeps
        cause = failure_cause(ok, off, state.cancellation, jnp.concatenate([q1, v1]))
        (q1, v1), result = nan_if_failed(cause, (q1, v1), dfx.RESULTS.successful)
        dense_info = dict(y0=y0, step=AsArrays(StepOf(self, given_terms, args, state)))
        multiplier = 2 * displacement * per_step**2
        end = state.last_fingerprint.at(t1, jnp.concatenate([q1, v1]), args, self.constraint)
        state = _State(at, slope, multiplier, state.cancellation, off, end)
        return (unravel(q1, q0), unravel(v1, v0)), None, dense_info, state, result

    def _problem(self, t: RealScalarLike, q: Y, args: Args, cancellation: Array) -> Problem:
        values = jnp.zeros_like(cancellation)
        metric = Diagonal(lax.rsqrt(broadcast_option("masses", self.masses, q)))
        return problem_of(self.constraint, values, t, q, args, cancellation, factor=metric)

    def _drift(self, terms: Any, t: RealScalarLike, v: Y, args: Args) -> Any:
        """The function from velocities `v`, or momenta, to `q'`, both as vectors."""
        return lambda p: ravel(terms[0].vf(t, unravel(p, v), args))

    def _gram(self, problem: Problem, jacobian: AbstractRows, drift: Any, p: Array) -> AbstractGram:
        """`G M⁻¹ Gᵀ`. With momenta the masses are in `drift`, which is linear: so its derivative is
        applied to each row. With many constraints the derivative is taken as diagonal. If it is
        not, the matrix is only approximate, and the iterations converge more slowly, to the same
        result."""
        forces = problem.factor.scaled_rows(problem.factor.scaled_rows(jacobian))
        return jacobian.gram(forces.map_rows(lambda x: jax.jvp(drift, (p,), (x,))[1], p.size))

    def _linear(
        self,
        problem: Problem,
        t: RealScalarLike,
        q: Y,
        args: Args,
        drift: Any,
        p: Array,
    ) -> tuple[_Linear, Float[Array, " m"]]:
        """The constraints at a position, and their partial derivative `∂_t g`."""
        jacobian = _barrier(problem.linearise(ravel(q))[1])
        fn = lambda t: ravel(evaluate(self.constraint, t, q, args))  # noqa: E731
        rate = jax.jvp(fn, (t,), (jnp.ones_like(t),))[1].astype(p.dtype)
        gram = _barrier(lax.stop_gradient(self._gram(problem, jacobian, drift, p)))
        return _Linear(jacobian, _barrier(gram.factorise())), rate


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


# Without a barrier XLA would evaluate an expression once for each use of it.
_barrier = lax.optimization_barrier


def _impulse(problem: Problem, multiplier: Array, rows: Any) -> Float[Array, " n"]:
    """`M⁻¹ Gᵀ λ`."""
    return problem.factor.scaled_gradient(problem.factor.scaled_gradient(rows.rmatvec(multiplier)))


def _largest_impulse(problem: Problem, multiplier: Array, rows: Any) -> Float[Array, " n"]:
    """`M⁻¹ |G|ᵀ |λ|`: in a taut chain the multipliers of neighbours are large and cancel, and the
    roundoff of an impulse is that of its terms, and not of their sum."""
    return _impulse(problem, jnp.abs(multiplier), jax.tree.map(jnp.abs, rows))


def _shake(
    problem: Problem,
    position: Any,
    largest: Any,
    at: _Linear,
    q: Array,
    max_steps: int,
    guess: Array,
) -> Solved:
    """Simplified Newton's method for the multipliers of SHAKE, with the matrix at the start of the
    step of the solver: an iteration evaluates the constraint and nothing else."""
    # The residuals are compared with their scales at the start of the step, for coordinates as
    # large as at either end, and as what moves them: that of a node that is pinned at zero stays
    # zero up to the roundoff of multipliers that cancel.
    sizes = jnp.maximum(jnp.abs(q), jnp.abs(position(jnp.zeros_like(guess))))
    solve = lax.stop_gradient(at.solve)
    _, moves = jax.linearize(position, guess)

    def change(g: Array) -> Array:
        """Off the manifold, constraints that depend on each other contradict each other a little.
        Then the solution has a large part in the null space of `Gᵀ`, which moves nothing, but whose
        roundoff does. So we solve once more, with the change of the constraints that the solution
        causes as the right side, which has no contradiction. For up to four constraints the
        solution has no such part."""
        x = solve(g)
        return x if len(g) <= MAX_PIVOTED else solve(at.jacobian.matvec(moves(x)))

    def advance(x: Array, tests_left: Array) -> tuple[Array, Array]:
        g = _barrier(problem.residual(_barrier(position(x))))
        scale = problem.scale(at.jacobian, sizes + largest(x))
        status, _ = problem.status(g, scale)
        tests_left = remaining_after_test(status, tests_left)
        return where_active(tests_left, x - change(g), x), tests_left

    return iterate(advance, guess, max_steps=max_steps)


def _on_tangent(
    problem: Problem, at: _Linear, rate: Array, drift: Any, p: Array
) -> tuple[Float[Array, " n"], Bool[Array, ""]]:
    """The velocities nearest to `p` that keep the constraint, `∂_t g + G v = 0`, and whether they
    do so to roundoff. The multipliers solve a linear system, and have its derivative."""
    solve = lax.stop_gradient(at.solve)

    def product(x: Array) -> Array:
        """`G M⁻¹ Gᵀ x`, for momenta with the masses in `drift`, which is linear."""
        change = _impulse(problem, x, at.jacobian)
        return at.jacobian.matvec(jax.jvp(drift, (p,), (change,))[1])

    def iterated(product: Any, b: Array) -> Array:
        return iterative_refinement(solve, product, b)

    to_correct = rate + at.jacobian.matvec(drift(p))
    x = lax.custom_linear_solve(product, -to_correct, iterated, iterated, symmetric=True)
    v = p + _impulse(problem, x, at.jacobian)
    sizes = jnp.abs(drift(p)) + jnp.abs(drift(_largest_impulse(problem, x, at.jacobian)))
    limit = problem.tolerance(jnp.abs(rate) + at.jacobian.absolute_matvec(sizes))
    return v, jnp.all(jnp.abs(rate + at.jacobian.matvec(drift(v))) <= limit)
