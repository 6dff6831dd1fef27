"""A learned flow map as a diffrax solver."""

from collections.abc import Callable
from typing import Any, ClassVar, final

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from .._custom_types import VF, Args, BoolScalarLike, DenseInfo, RealScalarLike, Y
from ._chebyshev import ChebyshevInterpolation, coefficients, fractions
from ._error_estimate import estimate
from ._learned import check_learned_terms, check_nodes, check_output
from ._outside import (
    DomainStatistics,
    Taken,
    check_policy,
    choose,
    failure,
    small_enough,
    taken_by,
)
from ._step_length import refuse_backwards, reject_too_long
from ._sweeps import SWEEPS, Increment, Path, correct, increment

# `(y0, h) ↦ y` with an attribute `max_step`: a `DeepONet`, or a Module of the user's own. It may
# have an integer attribute `order` and an attribute `domain`, with a method `contains(y)`.
FlowMap = Any


@final
class DeepONetSolver(dfx.AbstractSolver[DomainStatistics | None]):
    r"""Steps a learned flow map: $y_{n+1} = \Phi(y_n, h)$.

    Steps may have any length up to `flow_map.max_step`. A longer one is rejected by an adaptive
    controller (give that `dtmax=flow_map.max_step`, so that it does not try) and fails with fixed
    steps; a solve backwards in time is refused at run time.

    **Correction sweeps.** With `corrections=k` the flow map only predicts. Its path
    $u$ at the `nodes` Chebyshev points of the step is corrected by `k` sweeps of

    $$u \leftarrow y_n + h \int f(t, u, args) \quad \text{(Picard)}$$

    with the vector field of the term, at all points in parallel, or by as many Newton iterations
    for the fixed point, each with a dense linear system of the size of the state times `nodes`.
    A Picard sweep multiplies the error by about $h \|\partial f\|$ over the number of the sweep
    and makes a flow map of order $q$ a method of order $q + k$; a Newton iteration squares it.

    **Error estimate.** Without sweeps it is the solution of the error's own differential equation,
    driven by the defect $u' - f(u)$: 12 states of the flow map and 28 evaluations of $f$, none of
    which is computed with fixed steps. With sweeps it is what the last one changed, for nothing.
    So [`diffrax.PIDController`][] can drive a learned solver. Smaller steps help if the error falls
    with them faster than the step: with sweeps, or with a flow map of order 1 or more.

    **Leaving the domain.** A flow map is wrong, without a sign of it, for states that it has not
    learned. `outside` says what becomes of a step that starts outside `flow_map.domain`, or whose
    estimated error has a component larger than `max_error`:

    - `"ignore"`: nothing, the default.
    - `"report"`: it is counted; [`diffrax_conserve.statistics`][] tells.
    - `"fail"`: the solve fails, with a message that names the time. An adaptive controller
        rejects a step because of `max_error` first.
    - a diffrax solver: that takes the step, and it is counted. In a batch (`jax.vmap`) both are
        computed for every step. With adaptive steps it needs an error estimate of its own.

    Dense output follows the (corrected) path inside the step: it is the polynomial through its
    states at the `nodes` points, which without sweeps are computed only where dense output, saved
    times or an event ask for them. The weights are not copied.

    Derivatives with respect to the initial state and the weights are those of what is computed. The
    `args` of the solve are seen by the sweeps, the error estimate and the solver `outside`, not by
    the flow map; inside [`diffrax_conserve.ManifoldProjection`][] by the manifold too.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc

        system = dfc.systems.get("conservative-lorenz")
        flow_map = dfc.load_pretrained("conservative-lorenz-standard")
        solver = dfc.DeepONetSolver(flow_map, corrections=4)
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(system.vector_field),
            dfc.ManifoldProjection(solver, system.manifold, projection=dfc.Newton()),
            t0=0.0,
            t1=5.0,
            dt0=0.25,
            y0=system.y0,
        )
        ```

    ??? cite "Reference"

        S. Wang and P. Perdikaris, "Long-time integration of parametric evolution equations with
        physics-informed DeepONets", J. Comput. Phys. 475 (2023), for the steps; A. Dutt, L.
        Greengard and V. Rokhlin, "Spectral deferred correction methods for ordinary differential
        equations", BIT 40 (2000), for correction by sweeps.
    """

    flow_map: FlowMap
    outside: dfx.AbstractSolver | None  # the solver that takes steps outside
    max_error: RealScalarLike | None
    policy: str = eqx.field(static=True)
    nodes: int = eqx.field(static=True)
    corrections: int = eqx.field(static=True)
    sweep: str = eqx.field(static=True)

    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., ChebyshevInterpolation]] = ChebyshevInterpolation

    def __init__(
        self,
        flow_map: FlowMap,
        *,
        nodes: int = 12,
        corrections: int = 0,
        sweep: str = "picard",
        outside: str | dfx.AbstractSolver = "ignore",
        max_error: RealScalarLike | None = None,
    ):
        check_policy(outside, max_error, getattr(flow_map, "domain", None))
        self.flow_map = flow_map
        self.nodes = nodes
        self.corrections = corrections
        self.sweep = sweep
        self.outside = outside if isinstance(outside, dfx.AbstractSolver) else None
        self.policy = outside if isinstance(outside, str) else "replace"
        self.max_error = max_error

    def __check_init__(self):
        check_nodes(self.nodes)
        if not isinstance(self.corrections, int) or self.corrections < 0:
            raise ValueError(
                f"`corrections` is {self.corrections!r}, but it must be a number of sweeps: zero "
                "or a positive integer."
            )
        if self.sweep not in SWEEPS:
            raise ValueError(f'`sweep` is {self.sweep!r}, but it must be "picard" or "newton".')
        if not (callable(self.flow_map) and hasattr(self.flow_map, "max_step")):
            raise TypeError(
                f"`flow_map` is {self.flow_map!r}, which is no flow map. Pass a `DeepONet`, or a "
                "Module that is called as `(y0, h) -> y` and has an attribute `max_step`, the "
                "longest step that it was trained for."
            )

    def order(self, terms: dfx.AbstractTerm) -> int | None:
        del terms
        # Of order zero nothing follows for smaller steps.
        return self._local_order(self.corrections) - 1 or None

    def error_order(self, terms: dfx.AbstractTerm) -> int:
        del terms
        # The change by the last sweep is the error before it.
        return self._local_order(max(self.corrections - 1, 0))

    def _local_order(self, sweeps: int) -> int:
        """The power of the step in the error of one step after so many sweeps."""
        power = getattr(self.flow_map, "order", 0) + 1
        for _ in range(sweeps):
            power = power + 1 if self.sweep == "picard" else 2 * power + 1
        # Beyond that it is the collocation that is wrong.
        return min(power, self.nodes + 1) if sweeps else power

    def init(
        self,
        terms: dfx.AbstractTerm,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
    ) -> DomainStatistics | None:
        del args
        check_learned_terms(terms, "DeepONetSolver")
        check_output(self.flow_map, (y0, t1 - t0), y0, "flow_map")
        return None if self.policy == "ignore" else DomainStatistics.zero(t0)

    def step(
        self,
        terms: dfx.AbstractTerm,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: DomainStatistics | None,
        made_jump: BoolScalarLike,
    ) -> tuple[Y, Y, DenseInfo, DomainStatistics | None, dfx.RESULTS]:
        del made_jump
        h = refuse_backwards(jnp.asarray(t1 - t0), terms, self.flow_map.max_step)
        taken = self._learned(h, y0, increment(terms, t0, t1, y0, args))
        if solver_state is not None:
            trusted = self._inside(y0) & self._accurate(taken.error)
            solver_state = solver_state.add(t0, trusted)
            if self.policy == "fail":
                taken = self._fail(taken, t0, y0)
            if self.outside is not None:
                solver, nodes = self.outside, self.nodes
                taken = choose(
                    trusted, taken, lambda: taken_by(solver, terms, t0, t1, y0, args, nodes)
                )
        taken = reject_too_long(taken, h, t1, self.flow_map.max_step)
        dense_info = dict(coefficients=taken.coefficients)
        return taken.y1, taken.error, dense_info, solver_state, taken.result

    def func(self, terms: dfx.AbstractTerm, t0: RealScalarLike, y0: Y, args: Args) -> VF:
        return terms.vf(t0, y0, args)

    def _learned(self, h: Array, y0: Y, increment: Increment) -> Taken:
        """The step of the flow map, corrected."""
        _, unravel = ravel_pytree(y0)
        path = self._path(h, y0)
        if self.corrections == 0:
            y1 = jtu.tree_map(lambda a, b: a.astype(jnp.result_type(b)), self.flow_map(y0, h), y0)
            error = estimate(increment, path)
        else:
            path, error = correct(SWEEPS[self.sweep], increment, path, self.corrections)
            y1 = unravel(path[-1])
        states = jax.vmap(unravel)(path)
        return Taken(y1, unravel(error), coefficients(states), dfx.RESULTS.successful)

    def _path(self, h: Array, y0: Y) -> Path:
        """The states of the flow map at the nodes; the first is the initial state."""
        start, _ = ravel_pytree(y0)

        def state(fraction: Array) -> Array:
            return ravel_pytree(self.flow_map(y0, fraction * h))[0].astype(start.dtype)

        rows = jax.vmap(state)(fractions(self.nodes, h.dtype)[1:])
        return jnp.concatenate([start[None], rows])

    def _inside(self, y0: Y) -> Array:
        domain = getattr(self.flow_map, "domain", None)
        return jnp.asarray(True if domain is None else domain.contains(y0))

    def _accurate(self, error: Y) -> Array:
        return jnp.asarray(True if self.max_error is None else small_enough(error, self.max_error))

    def _fail(self, taken: Taken, t0: RealScalarLike, y0: Y) -> Taken:
        inside, accurate = self._inside(y0), self._accurate(taken.error)
        result = dfx.RESULTS.where(inside & accurate, taken.result, failure(t0, inside))
        # No smaller step would start elsewhere, but it may be more accurate.
        error = jtu.tree_map(lambda e: jnp.where(accurate, e, jnp.inf), taken.error)
        return Taken(taken.y1, error, taken.coefficients, result)


DeepONetSolver.__init__.__doc__ = r"""**Arguments:**

- `flow_map`: a [`diffrax_conserve.DeepONet`][], or any Module that is called as `(y0, h) -> y` and
    has an attribute `max_step`. It may have an integer `order` $q$ (its error in one step falls as
    $h^{q+1}$; default 0) and a `domain` with a method `contains(y)`, such as a
    [`diffrax_conserve.Box`][].
- `nodes`: how many states of a step sweeps and dense output go through.
- `corrections`: the number $k$ of correction sweeps.
- `sweep`: `"picard"` or `"newton"`.
- `outside`: `"ignore"`, `"report"`, `"fail"`, or the solver for steps that are outside.
- `max_error`: the largest error of a component, in its own units, that makes a step count as
    inside. Default: only the domain decides.

**Raises:**

`TypeError` or `ValueError` if the flow map cannot be called so or returns another structure than
the state's, if a number is not what it must be, or if `outside` asks about a domain that the flow
map does not have. At run time an error that names the length of a step that is negative; a failed
result that names that of one which is too long.
"""
