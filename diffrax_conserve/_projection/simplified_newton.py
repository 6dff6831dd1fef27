"""The simplified Newton iteration of Hairer, Lubich and Wanner, IV.4, with the constraint Jacobian
frozen at the candidate, for candidates as close as an integrator's local error."""

import dataclasses
import functools as ft
from collections.abc import Callable
from typing import ClassVar, final

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Int, Int8, PyTree

from .._custom_types import Y
from .._tree import (
    tree_add,
    tree_cancel,
    tree_scale,
    tree_size,
    tree_sub,
    working_dtype,
)
from .base import (
    NEWTON_OPTIONS,
    AbstractProjection,
    Problem,
    check_options,
    option,
    positive_weights,
)
from .bounded import box_of, check_bounds, project_into
from .elimination import Vector
from .equations import Equations, Outcome, ProjectionInfo
from .implicit import differentiated
from .iteration import Start, iterate
from .jacobian import AbstractJacobian
from .lanes import DONE, LOST, TRYING, continue_if_any
from .linearise import Converted, Joined, as_array, flattened, linearise, written_out
from .residual import ROUNDOFF_MULTIPLE, Tolerance, largest, relative, within


@final
class SimplifiedNewton(AbstractProjection):
    r"""Projects along the gradients at the candidate, with the constraint Jacobian frozen there.

    For the candidate $\hat y$, with $G = \partial g/\partial y\,(\hat y)$ and the metric $M$,
    solves $g(\hat y + M^{-1} G^\top \lambda) = 0$ for the multipliers $\lambda \in \mathbb{R}^m$.
    The first two iterations are

    $$\lambda \leftarrow \lambda - (G M^{-1} G^\top)^{-1} g(\hat y + M^{-1} G^\top \lambda),$$

    each of which gains as many digits as the step of the integrator has. This is enough for nearly
    every step. Otherwise each further iteration computes the Gram matrix again from the Jacobian at
    the last state, and damps a step that does not reduce the residual. For candidates far away use
    [`diffrax_conserve.Newton`][].

    Success is judged at the returned state, relative to the scale of the constraints there.

    The result is differentiated by the implicit function theorem for $\lambda$. The derivative is
    exact for the returned state, independent of the number of iterations. It is NaN where the
    gradients of the constraints are so nearly parallel that roundoff would dominate it.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        energy = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))
        projection = dfc.SimplifiedNewton(max_steps=10)
        solver = dfc.ManifoldProjection(diffrax.Tsit5(), energy, projection=projection)
        ```

    ??? cite "Reference"

        E. Hairer, C. Lubich and G. Wanner, *Geometric Numerical Integration*, 2nd ed., Springer
        2006, Section IV.4, equations (4.4) to (4.6).
    """

    rtol: float | Array | None = option(None)
    atol: float | Array | None = option(None)
    max_steps: int = option(20, static=True)
    metric: PyTree[ArrayLike] | None = option(None, converter=positive_weights)
    lower: PyTree[ArrayLike] | None = option(None)
    upper: PyTree[ArrayLike] | None = option(None)
    linear_solver: lx.AbstractLinearSolver | None = option(None, static=True)
    sees_step: ClassVar[bool] = False

    def __check_init__(self):
        check_options(self)
        check_bounds(self.lower, self.upper)

    def solve(self, problem: Problem, candidate: Y) -> tuple[Y, ProjectionInfo]:
        tolerance = Tolerance(self.rtol, self.atol)
        equations = problem.equations(candidate, tolerance, self.linear_solver)
        box = box_of(self.lower, self.upper, candidate)
        steps = self.max_steps
        if box is None:
            y, _, info = _project(equations, problem.anchor, max_steps=steps)
        else:
            unbounded = ft.partial(_project_alone, max_steps=steps)
            y, _, info = project_into(
                equations, box, unbounded=unbounded, frozen=True, max_steps=steps
            )
        return y, info


SimplifiedNewton.__init__.__doc__ = NEWTON_OPTIONS


def _project_alone(equations: Equations, *, max_steps: int) -> tuple[Y, Vector, ProjectionInfo]:
    return _project(equations, None, max_steps=max_steps)


# The state, the multipliers, the number of iterations and the verdict.
_State = tuple[Y, Vector, Int[Array, ""], Outcome]
# Up to this many products in a Gram matrix, further iterations are computed in scalars too. They
# are then 1.6 to 7 times as fast (rigid bodies, a busy machine), but compile time grows with this
# number.
_RARE_SCALARS_MAX = 64
# Iterations converge if each reduces the largest relative residual to this fraction.
_NEAR = 0.05
# From this many unknowns evaluations cost more than tests.
_LARGE = 512
# The number of starts between the candidate and the anchor that are tried. They approach the anchor
# faster and faster; the last is the anchor.
_STARTS = 12


@eqx.filter_custom_jvp
def _project(
    equations: Equations, anchor: Y | None, *, max_steps: int
) -> tuple[Y, Vector, ProjectionInfo]:
    inline, _, join = _converted(equations)
    before, jacobian = at_candidate = linearise(inline.residual, inline.candidate)
    count = min(jacobian.inline_steps, max_steps)
    start = inline.candidate, jtu.tree_map(jnp.zeros_like, before)
    large = count > 1 and tree_size(inline.candidate) >= _LARGE
    if large:
        taken = _tested(inline, at_candidate, start, count)
    else:
        taken = _iterations(inline, at_candidate, start, at_candidate, count)
    y, multiplier, num_steps, measured, done = taken
    # The few steps that need more iterations linearise again: sharing the values known here would
    # write them to memory at every step of the solve.
    state = join(y), as_array(multiplier), num_steps, Outcome.success()
    finish = ft.partial(_finish, max_steps)
    rounds = max_steps - count if count > 0 else 0
    y, multiplier, num_steps, outcome = continue_if_any(
        finish, ~done, state, (equations, anchor), crowd=_once_more, rounds=rounds
    )
    # The rest is computed only if the report is used.
    if large:
        g, scale = map(as_array, measured)
        measured = lax.cond(done, lambda: (g, scale), lambda: equations.measure(y))
    else:
        measured = equations.measure(y)
    rank = inline.gram_solver(jacobian).rank
    return y, multiplier, equations.report(y, as_array(before), measured, num_steps, rank, outcome)


_Linearised = tuple[Vector, AbstractJacobian]
# The state, the multipliers, the number of iterations, the residual there and its scale, and
# whether they are enough.
_Iterations = tuple[Y, Vector, Int[Array, ""], tuple[Vector, Vector], Bool[Array, ""]]


def _iterations(
    equations: Equations,
    at_candidate: _Linearised,
    start: tuple[Y, Vector],
    at_start: _Linearised,
    count: int,
) -> _Iterations:
    """`count` iterations with the Gram matrix at the start."""
    (before, base), (g, jacobian) = at_candidate, at_start
    gram_solver = equations.gram_solver(jacobian, None if jacobian is base else base)
    y, multiplier = start
    last = g
    for step in range(count):
        change = gram_solver.solve(g)
        subtract = tree_cancel if step == count - 1 else tree_sub
        y = subtract(y, equations.correction(base, change))
        multiplier = tree_sub(multiplier, change)
        last = g
        g, jacobian = linearise(equations.residual, y)
    scale = equations.scale(jacobian, y)
    # XLA may compute `y` twice, for `g` and for the result, with different rounding. After a large
    # correction whose terms cancel, these would be different states.
    roundoff = ROUNDOFF_MULTIPLE * float(jnp.finfo(working_dtype(y)).eps)
    small = equations.tolerance(
        jtu.tree_map(lambda s, b: jnp.where(s > 0, s, jnp.abs(b)), scale, before)
    )
    close = within(last, tree_scale(roundoff ** (-2 / 3), small))
    done = close & equations.safely_satisfied(g, scale)
    return y, multiplier, jnp.asarray(count), (g, scale), done


def _tested(
    equations: Equations, at_candidate: _Linearised, start: tuple[Y, Vector], count: int
) -> _Iterations:
    """As `_iterations` from the candidate, but no more than the first if that is enough."""
    first = _iterations(equations, at_candidate, start, at_candidate, 1)
    y, multiplier, _, (g, _), done = first

    def others() -> _Iterations:
        now = g, at_candidate[1]
        end = _iterations(equations, at_candidate, (y, multiplier), now, count - 1)
        return end[0], end[1], jnp.asarray(count), end[3], end[4]

    return lax.cond(done, lambda: first, others)


def _once_more(
    state: _State, operands: tuple[Equations, Y | None]
) -> tuple[Int8[Array, ""], _State]:
    """One more iteration from `state`, and its status. It is lost if it may not converge to the
    same point as those of `iterate`, which are damped."""
    y, multiplier, count, outcome = state
    equations, split, join = _converted(operands[0])
    start = split(y), equations.as_vector(multiplier)
    candidate, here = (linearise(equations.residual, x) for x in (equations.candidate, start[0]))
    y, multiplier, _, (g, scale), done = _iterations(equations, candidate, start, here, 1)
    before, last, now = (largest(relative(x, scale)) for x in (candidate[0], here[0], g))
    converges = (last <= _NEAR * before) & (done | (now <= _NEAR * last))
    state = join(y), as_array(multiplier), count + 1, outcome
    status = jnp.where(converges, jnp.where(done, DONE, TRYING), LOST)
    return status.astype(jnp.int8), state


def _converted(
    equations: Equations, convert: Callable[[Joined, Y], Converted] = written_out
) -> tuple[Equations, Callable[[Y], Y], Callable[[Y], Y]]:
    """The same equations in another form, and the maps to the new form of the state and back."""
    assert isinstance(equations.residual, Joined)
    residual, split, join = convert(equations.residual, equations.candidate)
    candidate, weights = split(equations.candidate), split(equations.weights)
    changes = dict(residual=residual, candidate=candidate, weights=weights)
    converted = dataclasses.replace(equations, **changes)
    magnitude = converted.as_vector(as_array(equations.magnitude))
    return dataclasses.replace(converted, magnitude=magnitude), split, join


def _finish(
    max_steps: int,
    unfinished: Bool[Array, ""],
    state: _State,
    operands: tuple[Equations, Y | None],
) -> _State:
    """Further iterations from `state`, if `unfinished`.

    With an anchor, a state near the manifold, iterations that fail are restarted between the
    candidate and the anchor.
    """
    equations, anchor = operands

    def attempt(equations: Equations, start: Start, enabled: Bool[Array, ""]) -> _State:
        products = equations.magnitude.size**2 * tree_size(equations.candidate)
        convert = written_out if products <= _RARE_SCALARS_MAX else flattened
        equations, split, join = _converted(equations, convert)
        y, multiplier, count = start
        before, last = iterate(
            equations,
            frozen=True,
            max_steps=max_steps,
            start=Start(split(y), equations.as_vector(multiplier), count),
            enabled=enabled,
        )
        outcome = Outcome.of(before, last.g, last.scale, equations.tolerance)
        return join(last.y), as_array(last.multiplier), last.num_steps, outcome

    start = Start(*state[:3])
    if anchor is None:
        return attempt(equations, start, unfinished)
    return _from_between(attempt, equations, start, anchor, unfinished)


_Attempts = tuple[Bool[Array, ""], Int[Array, ""], _State]


def _from_between(
    attempt: Callable[[Equations, Start, Bool[Array, ""]], _State],
    equations: Equations,
    first: Start,
    anchor: Y,
    enabled: Bool[Array, ""],
) -> _State:
    def body(carry: _Attempts) -> _Attempts:
        unfinished, index, _ = carry
        share = jnp.asarray(0.5, working_dtype(anchor)) ** (index * (index + 1) // 2)
        offset = tree_scale(share, tree_sub(equations.candidate, anchor))

        def choose(flag: Array, a: Y, b: Y) -> Y:
            return jtu.tree_map(lambda a, b: jnp.where(flag, a, b), a, b)

        candidate = choose(index == 0, equations.candidate, tree_add(anchor, offset))
        candidate = choose(index == _STARTS - 1, anchor, candidate)
        zeros = jnp.zeros_like(first.multiplier), jnp.zeros_like(first.num_steps)
        start = choose(index == 0, first, Start(candidate, *zeros))
        y, multiplier, count, outcome = attempt(
            dataclasses.replace(equations, candidate=candidate), start, unfinished
        )
        # Only the projection of the original candidate has a derivative.
        multiplier = jnp.where(index == 0, multiplier, jnp.nan)
        failed = outcome.result != optx.RESULTS.successful
        state = y, multiplier, count, outcome
        return unfinished & failed & (index + 1 < _STARTS), index + 1, state

    like = eqx.filter_eval_shape(attempt, equations, first, enabled)
    zeros = jtu.tree_map(lambda x: jnp.zeros(x.shape, x.dtype), like)
    carry = (jnp.asarray(enabled), jnp.asarray(0), zeros)
    _, _, state = lax.while_loop(lambda carry: carry[0], body, carry)
    return state


@_project.def_jvp
def _project_jvp(primals, tangents, *, max_steps):
    solution = _project(*primals, max_steps=max_steps)
    (equations, _), (t_equations, _) = primals, tangents
    return differentiated(solution, (equations, None), (t_equations, None), frozen=True)
