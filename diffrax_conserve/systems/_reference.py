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
    system: AbstractSystem, ts: Float[Array, " times"], y0: Any, *, atol: float = 1e-15
) -> Any:
    """The states at `ts` by the eighth-order method of Dormand and Prince, in float64.

    The solver steps exactly onto `ts`: dense output is off by 1e-10 even at tolerances near
    roundoff. These are at roundoff because the local errors add up: over the default horizons a
    tolerance of 1e-13 leaves errors of 1e-12 to 5e-9, one of 1e-15 errors of 1e-13 to 4e-11, for
    1.6 times the steps (measured against closed forms, and against a tolerance of 1e-16).
    """
    controller = dfx.ClipStepSizeController(dfx.PIDController(rtol=1e-15, atol=atol), step_ts=ts)
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
        max_steps=10**7,
    )
    return sol.ys
