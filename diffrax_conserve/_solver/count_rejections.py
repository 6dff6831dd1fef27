"""A step-size controller that counts the steps rejected because a projection failed."""

from collections.abc import Callable
from typing import Any, final

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Int, PyTree

from .._custom_types import VF, Args, IntScalarLike, RealScalarLike, Y

# The error estimate of a step whose projection failed. Controllers treat it like infinity.
FAILED_PROJECTION = -jnp.inf


@final
class CountRejections(dfx.AbstractAdaptiveStepSizeController[Any, Any]):
    """Counts the steps that an adaptive controller rejects because a projection failed.

    diffrax discards the solver state of a rejected step, but not the controller state, so these
    steps are counted in the latter. [`diffrax_conserve.statistics`][] reports the count if that
    state is saved. Everything else is done by the wrapped controller.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        square = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))
        sol = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, args: jnp.array([-y[1], y[0]])),
            dfc.ManifoldProjection(diffrax.Tsit5(), square),
            t0=0,
            t1=9,
            dt0=0.1,
            y0=jnp.array([1.0, 0.0]),
            stepsize_controller=dfc.CountRejections(diffrax.PIDController(rtol=1e-6, atol=1e-6)),
            saveat=diffrax.SaveAt(t1=True, solver_state=True, controller_state=True),
        )
        print(dfc.statistics(sol).num_rejected)
        ```

        ```text
        0
        ```
    """

    controller: dfx.AbstractAdaptiveStepSizeController[Any, Any]

    def __check_init__(self):
        if not isinstance(self.controller, dfx.AbstractAdaptiveStepSizeController):
            raise TypeError(
                f"`controller` is {self.controller!r}, which never rejects a step. Pass an "
                "adaptive one, for example `diffrax.PIDController(rtol=1e-6, atol=1e-6)`."
            )

    @property
    def rtol(self) -> Any:  # pyright: ignore
        return self.controller.rtol

    @property
    def atol(self) -> Any:  # pyright: ignore
        return self.controller.atol

    @property
    def norm(self) -> Any:  # pyright: ignore
        return self.controller.norm

    def wrap(self, direction: IntScalarLike) -> "CountRejections":
        return CountRejections(self.controller.wrap(direction))  # pyright: ignore

    def init(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        dt0: Any,
        args: Args,
        func: Callable[..., VF],
        error_order: RealScalarLike | None,
    ) -> tuple[RealScalarLike, "RejectionCount"]:
        end, state = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        return end, RejectionCount(state, jnp.asarray(0))

    def adapt_step_size(
        self,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        y1_candidate: Y,
        args: Args,
        y_error: Y | None,
        error_order: RealScalarLike,
        controller_state: "RejectionCount",
    ) -> tuple[Any, Any, Any, Any, "RejectionCount", dfx.RESULTS]:
        marks = [jnp.any(e == FAILED_PROJECTION) for e in jtu.tree_leaves(y_error)]
        failed = jnp.any(jnp.stack(marks)) if marks else jnp.asarray(False)
        keep, start, end, jump, state, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state.inner
        )
        count = controller_state.count + failed.astype(int)
        return keep, start, end, jump, RejectionCount(state, count), result


CountRejections.__init__.__doc__ = """**Arguments:**

- `controller`: the adaptive controller to wrap.

**Raises:**

`TypeError` if `controller` is not adaptive.
"""


class RejectionCount(eqx.Module):
    """The state of a `CountRejections`: that of the wrapped controller, and the count."""

    inner: Any
    count: Int[Array, "..."]
