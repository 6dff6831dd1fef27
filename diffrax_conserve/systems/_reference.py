"""Numerical references for systems without a known solution in closed form."""

from typing import Any

import diffrax as dfx
from jaxtyping import Array, Float

from ._base import AbstractSystem


class AbstractIntegratedSystem(AbstractSystem):
    """A system without a known solution in closed form: its reference is computed numerically."""

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
    solver: dfx.AbstractSolver = dfx.Dopri8(),
    rtol: float = 1e-15,
    atol: float = 1e-15,
    max_steps: int = 10**7,
) -> Any:
    """The states at `ts`, in float64 and by default by the eighth-order method of Dormand and
    Prince.

    The solver steps exactly to `ts`, because dense output has errors of 1e-10 even at tolerances
    near roundoff. The tolerances are at roundoff because local errors add up: over the default time
    spans, a tolerance of 1e-13 leads to errors of 1e-12 to 5e-9, and one of 1e-15 to errors of
    1e-13 to 4e-11, with 1.6 times the steps (compared with closed forms, and with a tolerance of
    1e-16).
    """
    controller = dfx.ClipStepSizeController(dfx.PIDController(rtol, atol), step_ts=ts)
    sol = dfx.diffeqsolve(
        dfx.ODETerm(system.vector_field),
        solver,
        t0=0.0,
        t1=ts[-1],
        dt0=None,
        y0=y0,
        args=system.args,
        saveat=dfx.SaveAt(ts=ts),
        stepsize_controller=controller,
        max_steps=max_steps,
    )
    return sol.ys
