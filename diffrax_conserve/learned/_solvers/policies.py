"""Policies for steps that a flow map cannot be trusted with."""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, final

import diffrax as dfx
import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, Int, PyTree

from ..._custom_types import BoolScalarLike, RealScalarLike, Y
from ..._options import found_in
from ..._solver.diffrax_private import register, result_at
from .collocation import series

_OUTSIDE = register(
    "a step starts outside the domain of the flow map. `diffrax_conserve.learned.steps_outside` "
    "tells at which time. Train the flow map on states from there, or let a classical solver take "
    "such steps, by `outside=diffrax.Tsit5()`."
)


class StepsOutside(NamedTuple):
    """What `steps_outside` returns."""

    number: Int[Array, "..."]
    first_time: Float[Array, "..."]

    @classmethod
    def zero(cls, t0: RealScalarLike) -> "StepsOutside":
        return cls(jnp.asarray(0), jnp.full((), jnp.inf, jnp.result_type(t0, float)))

    def add(self, t0: RealScalarLike, trusted: BoolScalarLike) -> "StepsOutside":
        time = jnp.where(trusted, jnp.inf, t0).astype(self.first_time.dtype)
        number = self.number + jnp.where(trusted, 0, 1)
        return StepsOutside(number, jnp.minimum(self.first_time, time))


class StepResult(eqx.Module):
    """The result of a step, except for the solver state."""

    y1: Y
    error: Y
    coefficients: PyTree[Array]
    result: dfx.RESULTS


@final
class _Word(eqx.Module):
    """Such steps are counted, or the first fails. A module, because a string would be a leaf."""

    word: Literal["count", "fail"] = eqx.field(static=True)

    def __repr__(self) -> str:
        return repr(self.word)


_COUNT, _FAIL = _Word("count"), _Word("fail")
# A solver takes the step itself.
Policy = _Word | dfx.AbstractSolver


def as_policy(policy: Any) -> Policy:
    """The policy with this name, or a solver; raises if it is neither."""
    found = dict(count=_COUNT, fail=_FAIL).get(policy) if isinstance(policy, str) else policy
    if not isinstance(found, Policy):
        raise TypeError(
            f"`outside` is {policy!r}, but it must be 'count', 'fail', or a solver: "
            "`diffrax.Tsit5()`."
        )
    return found


def outcome(
    policy: Policy,
    step: StepResult,
    inside: Array,
    take: Callable[[dfx.AbstractSolver], StepResult],
) -> StepResult:
    """The result of a step, given that of the flow map, and `take`, the same step by a solver."""
    if policy == _COUNT:
        return step
    if isinstance(policy, _Word):
        # The error stays finite: a smaller step starts at the same state.
        result = dfx.RESULTS.where(inside, step.result, result_at(_OUTSIDE))
        return StepResult(step.y1, step.error, step.coefficients, result)

    def other() -> StepResult:
        like = lambda a, b: jnp.asarray(a, jnp.result_type(b))  # noqa: E731
        return jtu.tree_map(like, take(policy), step)

    return lax.cond(inside, lambda: jtu.tree_map(jnp.asarray, step), other)


def step_of(solver: dfx.AbstractSolver, nodes: int, *given: Any) -> StepResult:
    """A single step by a solver, `given` the terms, both times, the state and `args`."""
    terms, t0, t1, y0, args = given
    state = solver.init(terms, t0, t1, y0, args)
    y1, error, dense_info, _, result = solver.step(terms, t0, t1, y0, args, state, False)
    inner = solver.interpolation_cls(t0=t0, t1=t1, **dense_info)
    dtype = jnp.result_type(t1 - t0)
    coefficients = series(lambda c: inner.evaluate(t0 + c * (t1 - t0)), nodes, dtype)
    if error is None:  # a controller must not accept the step
        error = jtu.tree_map(lambda x: jnp.full_like(x, jnp.inf), y1)
    return StepResult(y1, error, coefficients, result)


def check_policy(policy: Policy, has_domain: bool) -> None:
    if not has_domain and policy != _COUNT:
        raise ValueError(
            f"`outside` is {policy!r}, but the flow map cannot tell: it has no `domain`. "
            "Give it `diffrax_conserve.learned.Box.around(states)`, with the states that it was "
            "trained on."
        )
    if getattr(policy, "term_structure", dfx.AbstractTerm) is not dfx.AbstractTerm:
        raise ValueError(
            f"`outside` is {policy!r}, which needs several terms, but a learned solver has one. "
            "Pass a solver of one, for example `diffrax.Tsit5()`."
        )
    root_finder = getattr(policy, "root_finder", None)
    if root_finder is not None and not eqx.is_array_like(getattr(root_finder, "rtol", 0.0)):
        raise ValueError(
            f"`outside` is {policy!r}, whose root finder takes its tolerances from the step-size "
            "controller; diffrax does not pass these to a nested solver. Give them explicitly: "
            "`root_finder=diffrax.VeryChord(rtol=1e-8, atol=1e-8, norm=optimistix.max_norm)`."
        )


def steps_outside(sol: dfx.Solution) -> StepsOutside:
    """The number of steps of a learned solver outside its flow map's domain.

    **Arguments:**

    - `sol`: the solution of a [`diffrax_conserve.DeepONetSolver`][] whose flow map has a `domain`,
        solved with `saveat=SaveAt(..., solver_state=True)`; or a batch of them from `jax.vmap`.

    **Returns:**

    A named tuple of `number`, how many accepted steps count as outside, and `first_time`, the time
    at which the first of them started; infinity if there is none. Raises a `ValueError` if `sol`
    does not hold them.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc

        system = dfc.systems.get("conservative-lorenz")
        solver = dfc.DeepONetSolver(dfc.load_pretrained("conservative-lorenz"))
        term = diffrax.ODETerm(system.vector_field)
        saveat = diffrax.SaveAt(t1=True, solver_state=True)
        sol = diffrax.diffeqsolve(term, solver, 0.0, 5.0, 0.25, system.y0, saveat=saveat)
        assert dfc.learned.steps_outside(sol).number == 0
        ```
    """
    solver = "a `DeepONetSolver` whose flow map has a `domain`"
    return found_in(sol, StepsOutside, "steps_outside", solver)
