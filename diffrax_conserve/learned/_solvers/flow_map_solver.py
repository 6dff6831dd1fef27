"""A learned flow map as a diffrax solver."""

from collections.abc import Callable
from typing import ClassVar, NamedTuple, final

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from ..._custom_types import VF, Args, BoolScalarLike, DenseInfo, RealScalarLike, Y
from ..._hashable import Hashable
from ..._projection.options import option
from ..._time import traced_once
from .._networks.flow_map import AbstractFlowMap, args_domain_of, as_flow_map, known_args
from .checks import Refused, check_learned_terms, check_output, refused_from_start, with_result
from .collocation import (
    ChebyshevInterpolation,
    Increment,
    coefficients,
    correct,
    estimate,
    fractions,
    increment,
)
from .policies import Policy, StepResult, StepsOutside, as_policy, check_policy, outcome, step_of

# The points of a step for sweeps and dense output.
_NODES = 12


class _State(NamedTuple):
    refused: Refused  # why the solve was refused from the start
    outside: StepsOutside | None  # None if there is nothing to tell them by


@final
class DeepONetSolver(Hashable, dfx.AbstractSolver[_State]):
    r"""Steps a learned flow map: $y_{n+1} = \Phi(y_n, h)$.

    Steps may have any length up to `flow_map.max_step`. A longer one is rejected by an adaptive
    controller (pass it `dtmax=flow_map.max_step`) and fails with fixed steps, as does a solve
    backwards in time.

    With `corrections=k` the flow map only predicts. Its path $u$ at 12 Chebyshev points of
    the step is corrected by `k` Picard sweeps with the vector field of the term,

    $$u \leftarrow y_n + h \int f(t, u, args),$$

    at all points in parallel. The $j$-th sweep multiplies the error by about
    $h \|\partial f\| / j$.

    The error estimate without sweeps solves the differential equation of the error, driven by the
    defect $u' - f(u)$, by 28 evaluations of $f$; with sweeps it is the change by the last one. With
    fixed steps it is not computed. Smaller steps reduce the error of a solve with sweeps, or with a
    flow map of order 1 or more.

    Dense output is the polynomial through the (corrected) states at these points, which are
    computed only if something needs them. Derivatives are those of the computed solution.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc

        system = dfc.systems.get("conservative-lorenz")
        flow_map = dfc.load_pretrained("conservative-lorenz-standard")
        solver = dfc.DeepONetSolver(flow_map, corrections=4)
        solver = dfc.ManifoldProjection(solver, system.manifold)
        term = diffrax.ODETerm(system.vector_field)
        solution = diffrax.diffeqsolve(term, solver, 0.0, 5.0, 0.25, system.y0)
        ```

    ??? cite "Reference"

        S. Wang and P. Perdikaris, J. Comput. Phys. 475 (2023), for the steps; A. Dutt, L. Greengard
        and V. Rokhlin, BIT 40 (2000), for correction by sweeps.
    """

    flow_map: AbstractFlowMap = eqx.field(converter=as_flow_map)
    corrections: int = option(0, static=True)
    outside: Policy = option("count", converter=as_policy)
    check_field: bool = option(True, static=True)

    evaluates_vector_field: ClassVar[bool] = False
    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., ChebyshevInterpolation]] = ChebyshevInterpolation

    def __check_init__(self):
        if not isinstance(self.corrections, int) or self.corrections < 0:
            raise ValueError(
                f"`corrections` is {self.corrections!r}, but must be an integer from 0 on."
            )
        check_policy(self.outside, self._has_domain)

    @property
    def _has_domain(self) -> bool:
        domains = self.flow_map.domain, args_domain_of(self.flow_map)
        return any(domain is not None for domain in domains)

    def order(self, terms: dfx.AbstractTerm) -> int | None:
        del terms
        return self._local_order(self.corrections) - 1 or None  # 0 is no convergence

    def error_order(self, terms: dfx.AbstractTerm) -> int:
        del terms
        # The change by the last sweep estimates the error before it.
        return self._local_order(max(self.corrections - 1, 0))

    def _local_order(self, sweeps: int) -> int:
        """The power of the step size in the error of one step after this many sweeps."""
        power = self.flow_map.order + 1 + sweeps
        # The error of the collocation polynomial has this power.
        return min(power, _NODES + 1) if sweeps else power

    def init(
        self, terms: dfx.AbstractTerm, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args
    ) -> _State:
        check_learned_terms(terms, "DeepONetSolver")
        known = known_args(self.flow_map, args)
        check_output(self.flow_map, (y0, *known, t1 - t0), y0, "flow_map")
        given = terms, t0, t1, y0, args
        refused = refused_from_start(self.flow_map, known, self.check_field, *given)
        return _State(refused, StepsOutside.zero(t0) if self._has_domain else None)

    @traced_once  # with a traced length, one that is too long is told by the result
    def step(
        self,
        terms: dfx.AbstractTerm,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: _State,
        made_jump: BoolScalarLike,
    ) -> tuple[Y, Y, DenseInfo, _State, dfx.RESULTS]:
        del made_jump
        flow_map, known = self.flow_map, known_args(self.flow_map, args)
        h, (refused, counted) = jnp.asarray(t1 - t0), solver_state
        step = self._learned(known, h, y0, increment(terms, t0, t1, y0, args))
        if counted is not None:
            inside = flow_map.inside(y0, *known, h)
            if (box := args_domain_of(flow_map)) is not None:
                inside &= box.contains(*known)
            counted = counted.add(t0, inside)
            by = lambda solver: step_of(solver, _NODES, terms, t0, t1, y0, args)  # noqa: E731
            step = outcome(self.outside, step, inside, by)
        step = with_result(step, refused, h, t1, flow_map.max_step)
        dense_info = dict(coefficients=step.coefficients)
        return step.y1, step.error, dense_info, _State(refused, counted), step.result

    def func(self, terms: dfx.AbstractTerm, t0: RealScalarLike, y0: Y, args: Args) -> VF:
        return terms.vf(t0, y0, args)

    def _learned(self, known: tuple, h: Array, y0: Y, increment: Increment) -> StepResult:
        start, unravel = ravel_pytree(y0)

        def state(fraction: Array) -> Array:
            return ravel_pytree(self.flow_map(y0, *known, fraction * h))[0].astype(start.dtype)

        rows = jax.vmap(state)(fractions(_NODES, h.dtype)[1:])
        path = jnp.concatenate([start[None], rows])
        if self.corrections == 0:
            y1 = self.flow_map(y0, *known, h)
            y1 = jtu.tree_map(lambda a, b: a.astype(jnp.result_type(b)), y1, y0)
            error = estimate(increment, path)
        else:
            path, error = correct(increment, path, self.corrections)
            y1 = unravel(path[-1])
        states = jax.vmap(unravel)(path)
        return StepResult(y1, unravel(error), coefficients(states), dfx.RESULTS.successful)


DeepONetSolver.__init__.__doc__ = r"""**Arguments:**

- `flow_map`: a [`diffrax_conserve.learned.AbstractFlowMap`][] such as
    [`diffrax_conserve.DeepONet`][], or a Module `(y0, h) -> y` with an attribute `max_step`.
- `corrections`: the number $k$ of correction sweeps.
- `outside`: what is done with steps that start outside `flow_map.domain`, or with `args` outside
    its `args_domain`. `"count"`: they are counted, for
    [`diffrax_conserve.learned.steps_outside`][], the default; `"fail"`: the solve fails at the
    first; a diffrax solver takes them itself (in a batch of lanes both compute every step).
- `check_field`: whether to fail if the vector field at the initial state, and at no other, differs
    from the slope of the flow map for $h \to 0$ by more than 0.1 % if that slope is exact (`order`
    at least 1). A learned slope may differ by 75 %, and by more where the field changes much within
    `max_step`, as in stiff equations.

**Raises:**

`TypeError` or `ValueError` if the flow map does not map states to states, a number is invalid, or
`outside` needs a domain. A solve backwards in time or of another equation, a step that is too long
and a state that is not finite end with a failed [`result`][diffrax.RESULTS].
"""
