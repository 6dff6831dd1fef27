"""References where no closed form is known."""

from typing import Any

import diffrax as dfx
from jaxtyping import Array, Float

from ._base import AbstractSystem


class AbstractIntegratedSystem(AbstractSystem):
    """A system without a solution in closed form: its reference is computed numerically."""

    def solution(self, ts: Float[Array, " times"], y0: Any) -> Any:
        return integrate(self, ts, y0)

    def period(self, y0: Any = None) -> None:
        del y0

    @property
    def metric(self) -> None:
        return None


def integrate(
    system: AbstractSystem,
    ts: Float[Array, " times"],
    y0: Any,
    *,
    rtol: float = 1e-13,
    atol: float = 1e-13,
) -> Any:
    """The states at `ts` by the eighth-order method of Dormand and Prince, in float64.

    The solver steps exactly onto `ts`: dense output at these tolerances is off by 1e-10, four
    orders more than the steps themselves.
    """
    controller = dfx.ClipStepSizeController(dfx.PIDController(rtol=rtol, atol=atol), step_ts=ts)
    sol = dfx.diffeqsolve(
        dfx.ODETerm(system.vector_field),
        dfx.Dopri8(),
        t0=0.0,
        t1=ts[-1],
        dt0=None,
        y0=y0,
        args=system.args,
        saveat=dfx.SaveAt(ts=ts),
        stepsize_controller=controller,
        max_steps=None,
    )
    return sol.ys
