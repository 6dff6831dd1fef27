"""The output: the metrics, the table and the figures."""

import json
import platform
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import __version__
from .._tree import tree_scale
from ..systems import AbstractSystem
from ._compare import Comparison, take, thinned
from ._solve import Run
from ._trained import Learned

# The labels of systems with units: the unit of time, its length in the system's own unit, and the
# unit of the error.
_UNITS = {"outer-solar-system": ("years", 365.25, "AU, AU/day")}

FOOTER = """\
state error: Euclidean norm of the solution minus the reference, over all components of the state.
drift: the largest over all steps of |I(t, y) - I(t0, y0)|, relative to the scale of I at (t0, y0),
    |I| + sum_i |y_i dI/dy_i|; for a constraint g, of |g| relative to sum_i |y_i dg/dy_i|; for an
    array the largest of its components. Roundoff is 2.2e-16.
run, compile: wall time of the second run of the compiled solve, and of its compilation."""

_MANY = """\
State errors are medians over {states} initial states, drifts the largest over all of them; the
    picture of the trajectory is that of the first one."""


def json_text(numbers: dict[str, Any]) -> str:
    return json.dumps(numbers, indent=2, allow_nan=False) + "\n"


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


def table(
    system: AbstractSystem, metrics: dict[str, Any], t1: float, dt: float, states: int
) -> str:
    rows = metrics["solvers"]

    def line(label: str, cell: Callable[[dict[str, Any]], str]) -> list[str]:
        return [label, *(cell(row) for row in rows.values())]

    lines = [
        ["", *rows],
        line(f"state error at t = {t1:g}", lambda r: _number(r["state_error"])),
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
    heading = f"{system.title}: 0 <= t <= {t1:g}, steps of {dt:g}"
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
        curves = {kind: (found.epochs, found.losses) for kind, found in networks.items()}
        out["loss"] = plot.loss(curves)
    stride = comparison.stride
    succeeded = {name: run for name, run in runs.items() if run.failure is None}
    if not succeeded:
        return out
    index = {name: thinned(len(run.ts), stride) for name, run in succeeded.items()}
    paths = {
        name: _paths(system, take(run.ys, (0, index[name]))) for name, run in succeeded.items()
    }
    reference = None if comparison.reference is None else _paths(system, comparison.reference)

    time_unit, time_scale, error_unit = _UNITS.get(system.name, ("", 1.0, ""))
    # The initial state has neither error nor drift.
    times = {name: run.ts[index[name]][1:] / time_scale for name, run in succeeded.items()}
    drifts = {
        integral: {
            name: np.maximum.reduceat(np.max(run.drift[integral], axis=0)[1:], index[name][:-1])
            for name, run in succeeded.items()
        }
        for integral in system.manifold
    }
    lines = {}
    if plot.shows_lines(paths, system.axes):
        lines = {name: _line(system, run.ts, take(run.ys, 0)) for name, run in succeeded.items()}
    out["trajectory"] = plot.trajectory(paths, lines, reference, system.axes)
    out["drift"] = plot.drift(times, drifts, time_unit)
    if comparison.errors:
        errors = {name: np.median(values, axis=0)[1:] for name, values in comparison.errors.items()}
        out["state_error"] = plot.state_error(times, errors, time_unit, error_unit)
    return out


def _paths(system: AbstractSystem, ys: Any) -> dict[str, np.ndarray]:
    paths = system.trajectories(jtu.tree_map(jnp.asarray, ys))
    return {name: np.asarray(path) for name, path in paths.items()}


# The number of points that are drawn for each step.
_POINTS = 8


def _line(system: AbstractSystem, ts: np.ndarray, ys: Any) -> dict[str, np.ndarray]:
    """The path between the steps too, by cubic Hermite interpolation."""
    ts, ys = jtu.tree_map(jnp.asarray, (ts, ys))

    @jax.vmap
    def state(t: jax.Array) -> Any:
        k = jnp.clip(jnp.searchsorted(ts, t, side="right"), 1, ts.size - 1)
        (t0, y0), (t1, y1) = take((ts, ys), k - 1), take((ts, ys), k)
        k0 = tree_scale(t1 - t0, system.vector_field(t0, y0, system.args))
        k1 = tree_scale(t1 - t0, system.vector_field(t1, y1, system.args))
        path = dfx.ThirdOrderHermitePolynomialInterpolation(
            t0=t0, t1=t1, y0=y0, y1=y1, k0=k0, k1=k1
        )
        return path.evaluate(t)

    return _paths(system, state(jnp.linspace(ts[0], ts[-1], _POINTS * (ts.size - 1) + 1)))
