"""Policies for steps that a flow map cannot be trusted with."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, final

import diffrax as dfx
import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from ..._custom_types import Args, BoolScalarLike, RealScalarLike, Y
from ..._options import check_number, check_solution
from ..._printing import is_traced, printed
from ..._solver.diffrax_private import member, register
from .chebyshev import series

_OUTSIDE = register(
    "a step starts outside the domain of the flow map. "
    "`diffrax_conserve.learned.domain_statistics` tells at which time. Train the flow map on "
    "states from there, or let a classical solver take such steps, by "
    "`outside=diffrax_conserve.learned.Replace(diffrax.Tsit5())`."
)
_INACCURATE = register(
    "the estimated error of a step is above `max_error`. "
    "`diffrax_conserve.learned.domain_statistics` tells at which time. Take shorter steps, correct "
    "them by `corrections=...`, or let a classical solver take such steps, by "
    "`outside=diffrax_conserve.learned.Replace(diffrax.Tsit5())`."
)


@final
class DomainStatistics(eqx.Module):
    """The number of accepted steps outside the range that the flow map has learned.

    A step is outside if it starts outside the flow map's `domain`, or if its estimated error is
    above `max_error`. See the option `outside` of [`diffrax_conserve.DeepONetSolver`][].

    **Attributes:**

    - `num_steps`: the number of steps.
    - `num_outside`: the number of them that were outside.
    - `first_outside`: the time at which the first of them started; infinity if there is none.
    """

    num_steps: Int[Array, "..."]
    num_outside: Int[Array, "..."]
    first_outside: Float[Array, "..."]

    @property
    def fraction_outside(self) -> Float[Array, "..."]:
        """`num_outside / num_steps`."""
        return self.num_outside / jnp.maximum(self.num_steps, 1)

    def __str__(self) -> str:
        if is_traced(self):
            return repr(self)
        rows = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return printed("steps of a learned solver", rows)

    @classmethod
    def zero(cls, t0: RealScalarLike) -> "DomainStatistics":
        never = jnp.full((), jnp.inf, jnp.result_type(t0, np.float16))
        return cls(jnp.asarray(0), jnp.asarray(0), never)

    def add(self, t0: RealScalarLike, trusted: BoolScalarLike) -> "DomainStatistics":
        time = jnp.where(trusted, jnp.inf, t0).astype(self.first_outside.dtype)
        return DomainStatistics(
            self.num_steps + 1,
            self.num_outside + jnp.where(trusted, 0, 1),
            jnp.minimum(self.first_outside, time),
        )


class StepResult(eqx.Module):
    """The result of a step, except for the solver state."""

    y1: Y
    error: Y
    coefficients: PyTree[Array]
    result: dfx.RESULTS


# The same step by another solver.
TakeStep = Callable[[dfx.AbstractSolver], StepResult]


class AbstractPolicy(eqx.Module):
    """The treatment of a step that starts outside the domain, or is not accurate enough."""

    @abc.abstractmethod
    def __call__(
        self, step: StepResult, inside: Array, accurate: Array, take: TakeStep
    ) -> StepResult:
        """The result of the step, given that of the flow map."""


@final
class Report(AbstractPolicy):
    """Counts such steps, for [`diffrax_conserve.learned.domain_statistics`][]."""

    def __call__(
        self, step: StepResult, inside: Array, accurate: Array, take: TakeStep
    ) -> StepResult:
        del inside, accurate, take
        return step


@final
class Refuse(AbstractPolicy):
    """Fails at the first such step.

    A step that is not accurate enough is first rejected by an adaptive controller.
    """

    def __call__(
        self, step: StepResult, inside: Array, accurate: Array, take: TakeStep
    ) -> StepResult:
        del take
        index = jnp.where(inside, _INACCURATE, _OUTSIDE)
        result = dfx.RESULTS.where(inside & accurate, step.result, member(index))
        # The error is infinite only for an inaccurate step: a smaller step may be more accurate,
        # but it starts at the same state.
        error = jtu.tree_map(lambda e: jnp.where(accurate, e, jnp.inf), step.error)
        return StepResult(step.y1, error, step.coefficients, result)


@final
class Replace(AbstractPolicy):
    """Takes such steps with another solver.

    In a batch (`jax.vmap`) both solvers compute every step. Adaptive steps need a solver with an
    error estimate.
    """

    solver: dfx.AbstractSolver

    def __check_init__(self):
        solver, name = self.solver, type(self.solver).__name__
        if not isinstance(solver, dfx.AbstractSolver):
            raise TypeError(f"`solver` is {solver!r}, which is not a diffrax solver.")
        if solver.term_structure is not dfx.AbstractTerm:
            raise ValueError(
                f"`solver` is a {name}, which needs several terms, but a learned solver has one. "
                "Pass a solver of one, for example `diffrax.Tsit5()`."
            )
        root_finder = getattr(solver, "root_finder", None)
        if root_finder is not None and not eqx.is_array_like(getattr(root_finder, "rtol", 0.0)):
            raise ValueError(
                f"`solver` is a {name}, whose root finder takes its tolerances from the step-size "
                "controller; diffrax does not pass these to a nested solver. Give them explicitly, "
                f"for example `{name}(root_finder=diffrax.VeryChord(rtol=1e-8, atol=1e-8, "
                "norm=optimistix.max_norm))`."
            )

    def __call__(
        self, step: StepResult, inside: Array, accurate: Array, take: TakeStep
    ) -> StepResult:
        def other() -> StepResult:
            taken = take(self.solver)
            return jtu.tree_map(lambda a, b: jnp.asarray(a, jnp.result_type(b)), taken, step)

        return lax.cond(inside & accurate, lambda: jtu.tree_map(jnp.asarray, step), other)


Replace.__init__.__doc__ = """**Arguments:**

- `solver`: a diffrax solver.

**Raises:**

`TypeError` or `ValueError` if it is not a solver, or cannot take a step inside another solver.
"""


def step_of(
    solver: dfx.AbstractSolver,
    nodes: int,
    terms: PyTree[dfx.AbstractTerm],
    t0: RealScalarLike,
    t1: RealScalarLike,
    y0: Y,
    args: Args,
) -> StepResult:
    """A step of a classical solver, which has no memory of earlier ones."""
    state = solver.init(terms, t0, t1, y0, args)
    y1, error, dense_info, _, result = solver.step(terms, t0, t1, y0, args, state, False)
    inner = solver.interpolation_cls(t0=t0, t1=t1, **dense_info)
    dtype = jnp.result_type(t1 - t0)
    coefficients = series(lambda c: inner.evaluate(t0 + c * (t1 - t0)), nodes, dtype)
    if error is None:  # a controller must not accept the step
        error = jtu.tree_map(lambda x: jnp.full_like(x, jnp.inf), y1)
    return StepResult(y1, error, coefficients, result)


def as_policy(outside: AbstractPolicy | dfx.AbstractSolver | None) -> AbstractPolicy | None:
    """`outside` as a policy; a diffrax solver becomes `Replace(solver)`."""
    if isinstance(outside, dfx.AbstractSolver):
        return Replace(outside)
    if outside is not None and not isinstance(outside, AbstractPolicy):
        raise TypeError(
            f"`outside` is {outside!r}, but it must be `None`, "
            "`diffrax_conserve.learned.Report()`, `Refuse()`, or `Replace(solver)` with a diffrax "
            "solver that takes the steps that the flow map cannot, such as `diffrax.Tsit5()`."
        )
    return outside


def check_policy(outside: AbstractPolicy | None, max_error: Any, domain: Any) -> None:
    """Raises if a policy is given without a domain or an error bound, or an error bound without a
    policy."""
    check_number("max_error", max_error, above=0.0)
    if outside is None and max_error is not None:
        raise ValueError(
            "`max_error` says which steps count as outside, but these are ignored. Pass `outside="
            "diffrax_conserve.learned.Report()`, `Refuse()` or `Replace(diffrax.Tsit5())` too."
        )
    if outside is not None and max_error is None and domain is None:
        raise ValueError(
            f"`outside` is {outside!r}, but the flow map does not say what is outside: it has no "
            "`domain`. Give it one, for example `diffrax_conserve.learned.Box.around(states)` with "
            "the states that it was trained on, or pass `max_error`."
        )


def domain_statistics(sol: dfx.Solution) -> DomainStatistics:
    """The number of steps of a learned solver outside its flow map's domain.

    It is part of the state of a solver with a policy `outside`, so `diffeqsolve` must return that
    state, by `SaveAt(solver_state=True)`.

    **Arguments:**

    - `sol`: the solution from `diffrax.diffeqsolve` with `saveat=SaveAt(..., solver_state=True)`,
        or a batch of them from `jax.vmap`.

    **Returns:**

    A [`diffrax_conserve.learned.DomainStatistics`][].

    **Raises:**

    `ValueError` if `sol` holds no such state.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc

        system = dfc.systems.get("conservative-lorenz")
        flow_map = dfc.load_pretrained("conservative-lorenz")
        sol = diffrax.diffeqsolve(
            diffrax.ODETerm(system.vector_field),
            dfc.DeepONetSolver(flow_map, outside=dfc.learned.Report()),
            t0=0.0,
            t1=5.0,
            dt0=0.25,
            y0=system.y0,
            saveat=diffrax.SaveAt(t1=True, solver_state=True),
        )
        print(dfc.learned.domain_statistics(sol).fraction_outside)
        ```

        ```text
        0.0
        ```
    """

    check_solution(sol, "domain_statistics")

    def is_found(x: Any) -> bool:
        return isinstance(x, DomainStatistics)

    found = [x for x in jtu.tree_leaves(sol.solver_state, is_leaf=is_found) if is_found(x)]
    if not found:
        raise ValueError(
            "`sol` holds no statistics of a domain. Solve with a learned solver that has "
            "`outside=`, for example `outside=diffrax_conserve.learned.Report()`, and with "
            "`saveat=SaveAt(..., solver_state=True)`."
        )
    return found[0]
