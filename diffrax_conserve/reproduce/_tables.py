"""The output: the metrics, the table and the figures."""

import platform
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import __version__
from ..systems import AbstractSystem
from ._compare import COMPARED_MAX, Comparison, take
from ._solve import Run
from ._trained import Learned

FOOTER = """\
state error: Euclidean norm of the solution minus the reference, over all components of the state.
drift: the largest over all steps of |I(t, y) - I(t0, y0)|, relative to the scale of I at (t0, y0),
    |I| + sum_i |y_i dI/dy_i|; for a constraint g, of |g| relative to sum_i |y_i dg/dy_i|; for an
    array the largest of its components. Roundoff is 2.2e-16.
run, compile: wall time of the second run of the compiled solve, and of its compilation."""

_MANY = """\
State errors are medians over {states} initial states, drifts the largest over all of them; the
    picture of the trajectory is that of the first one."""


def metrics(
    system: AbstractSystem,
    runs: dict[str, Run],
    comparison: Comparison,
    t1: float,
    dt: float,
    states: int,
) -> dict[str, Any]:
    def row(name: str, run: Run) -> dict[str, Any]:
        ok = run.failure is None
        errors = comparison.errors.get(name)
        return {
            "state_error": None if errors is None else float(np.median(errors[:, -1])),
            "largest_state_error": (
                None if errors is None else float(np.median(np.max(errors, axis=1)))
            ),
            "drift": {
                integral: float(np.max(run.drift[integral])) if ok else None
                for integral in system.manifold
            },
            "seconds": run.seconds,
            "compile_seconds": run.compile_seconds,
            "steps": run.steps,
            **({} if ok else {"failure": run.failure}),
        }

    return {
        "system": system.name,
        "solvers": {name: row(name, run) for name, run in runs.items()},
        "t1": t1,
        "dt": dt,
        "initial_states": states,
        **({} if comparison.failure is None else {"failure": comparison.failure}),
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
    if "failure" in metrics:
        failures.append(metrics["failure"])
    if failures:
        failures.append("")
    heading = f"{system.title}: 0 <= t <= {metrics['t1']:g}, steps of {metrics['dt']:g}"
    many = [_MANY.format(states=states)] if states > 1 else []
    return "\n".join([heading, "", *text, "", *failures, FOOTER, *many])


def _number(x: float | None) -> str:
    return "-" if x is None else f"{x:.2e}"


def figures(
    plot: Any,
    system: AbstractSystem,
    runs: dict[str, Run],
    comparison: Comparison,
    networks: dict[str, Learned],
) -> dict[str, Any]:
    out = {}
    if networks:
        out["loss"] = plot.loss({kind: found[1:] for kind, found in networks.items()})
    index = comparison.index
    succeeded = {name: run for name, run in runs.items() if run.failure is None}
    if not succeeded:
        return out
    times = next(iter(succeeded.values())).ts[index]
    paths = {name: _paths(system, take(take(r.ys, 0), index)) for name, r in succeeded.items()}
    reference = None
    if comparison.failure is None:
        fine = np.linspace(times[0], times[-1], COMPARED_MAX + 1)
        reference = _paths(system, system.reference(fine))
    out["trajectory"] = plot.trajectory(paths, reference, system.axes)
    # The initial state has neither error nor drift.
    drifts = {
        integral: {
            name: np.max(run.drift[integral], axis=0)[index][1:] for name, run in succeeded.items()
        }
        for integral in system.manifold
    }
    out["drift"] = plot.drift(times[1:], drifts)
    if comparison.errors:
        errors = {name: np.median(values, axis=0)[1:] for name, values in comparison.errors.items()}
        out["state_error"] = plot.state_error(times[1:], errors)
    return out


def _paths(system: AbstractSystem, ys: Any) -> dict[str, np.ndarray]:
    paths = system.trajectories(jtu.tree_map(jnp.asarray, ys))
    return {name: np.asarray(path) for name, path in paths.items()}
