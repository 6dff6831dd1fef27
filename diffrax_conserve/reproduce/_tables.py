"""The metrics and their table."""

import platform
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import jax
import numpy as np

from .. import __version__
from ..systems import AbstractSystem
from ._solve import Run, is_stiff

_FOOTER = """\
state error: Euclidean norm of the solution minus the reference, over all components of the state.
drift: the largest over all steps of |I(t, y) - I(t0, y0)|, relative to the scale of I at (t0, y0),
    |I| + sum_i |y_i dI/dy_i|; for a constraint g, of |g| relative to sum_i |y_i dg/dy_i|; for an
    array the largest of its components. Roundoff is 2.2e-16.
run, compile: processor time of the fastest of up to five runs of the compiled solve, and of its
    compilation."""

_MANY = """
State errors are medians over {states} initial states, drifts the largest over all of them; the
    picture of the trajectory is that of the first one."""


def metrics(
    system: AbstractSystem,
    runs: dict[str, Run],
    errors: dict[str, np.ndarray],
    t1: float,
    dt: float,
    states: int,
) -> dict[str, Any]:
    def row(name: str, run: Run) -> dict[str, Any]:
        error = errors.get(name)
        return {
            "state_error": None if error is None else float(np.median(error[:, -1])),
            "largest_state_error": None if error is None else float(np.median(error.max(axis=1))),
            "drift": {integral: run.largest_drift.get(integral) for integral in system.manifold},
            "seconds": run.seconds,
            "compile_seconds": run.compile_seconds,
            "steps": run.steps,
            **({} if run.failure is None else {"failure": run.failure}),
        }

    return {
        "system": system.name,
        "solvers": {name: row(name, run) for name, run in runs.items()},
        "t1": t1,
        "dt": dt,
        "initial_states": states,
        "versions": {
            "diffrax-conserve": __version__,
            "diffrax": dfx.__version__,
            "jax": jax.__version__,
            "python": platform.python_version(),
        },
        "device": jax.devices()[0].device_kind,
    }


def table(system: AbstractSystem, metrics: dict[str, Any]) -> str:
    rows, states = metrics["solvers"], metrics["initial_states"]

    def line(label: str, cell: Callable[[dict[str, Any]], str]) -> list[str]:
        return [label, *(cell(row) for row in rows.values())]

    lines = [
        ["", *rows],
        line(f"state error at t = {metrics['t1']:g}", lambda r: _number(r["state_error"])),
        line("state error, largest", lambda r: _number(r["largest_state_error"])),
        *(
            line(f"drift of {integral}", lambda r, i=integral: _number(r["drift"][i]))
            for integral in system.manifold
        ),
        line("steps", lambda r: str(r["steps"])),
        line("run", lambda r: f"{1e3 * r['seconds']:.3g} ms"),
        line("compile", lambda r: f"{r['compile_seconds']:.2g} s"),
    ]
    label, *columns = (max(map(len, column)) for column in zip(*lines, strict=True))
    text = [
        "   ".join([f"{x[0]:{label}}", *(f"{c:>{w}}" for c, w in zip(x[1:], columns, strict=True))])
        for x in lines
    ]
    failures = [f"{name} FAILED {r['failure']}" for name, r in rows.items() if "failure" in r]
    steps = "adaptive steps, saved every" if is_stiff(system) else "steps of"
    heading = f"{system.title}: 0 <= t <= {metrics['t1']:g}, {steps} {metrics['dt']:g}"
    footer = _FOOTER + (_MANY.format(states=states) if states > 1 else "")
    paragraphs = [heading, "\n".join(text), "\n".join(failures), footer]
    return "\n\n".join(filter(None, paragraphs))


def _number(x: float | None) -> str:
    return "-" if x is None else f"{x:.2e}"
