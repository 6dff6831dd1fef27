"""The main job: a system of the catalogue, solved with and without projection, and compared."""

import dataclasses
import json
import math
import os
import platform
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from . import __version__
from ._diagnostics import drift
from ._solver import RK4, ManifoldProjection
from .systems import AbstractSystem

# The figures show no more times than this. The largest drift is over all of them.
_PLOTTED_MAX = 2000
# The states of all steps are held in memory.
_BYTES_MAX = 2**29

# For the labels of systems with units: that of time, how many of the system's own it is, and that
# of the error.
_UNITS = {"outer-solar-system": ("years", 365.25, "AU, AU/day")}

FOOTER = """\
state error: Euclidean norm of the solution minus the reference, over all components of the state.
drift: the largest over all steps of |I(t, y) - I(t0, y0)|, relative to the scale of I at (t0, y0),
    |I| + sum_i |y_i dI/dy_i|; for a constraint g, of |g| relative to sum_i |y_i dg/dy_i|; for an
    array the largest of its components. Roundoff is 2.2e-16.
run, compile: wall time of the second run of the compiled solve, and of its compilation."""


class SetupError(Exception):
    """The job cannot start; the message says why, and what to do."""


@dataclasses.dataclass(frozen=True)
class Run:
    """What one solver did: its states at `ts`, from the initial time, or why there are none."""

    ts: np.ndarray
    ys: Any
    drift: dict[str, np.ndarray]  # by integral, at each of `ts`
    steps: int
    seconds: float
    compile_seconds: float
    failure: str | None = None


def solvers(system: AbstractSystem) -> dict[str, dfx.AbstractSolver]:
    """What is compared, in the order of the table and of the legends."""
    return {
        "rk4": RK4(),
        "projected rk4": ManifoldProjection(RK4(), system.manifold),
    }


def reproduce(
    system: AbstractSystem,
    out: Path,
    *,
    t1: float,
    dt: float,
    write: Callable[[str], None] = print,
) -> bool:
    """Compares the `solvers` on `system` from 0 to `t1`; writes a table, figures, `metrics.json`.

    Returns whether every solver succeeded. Raises `SetupError` before any work is done.
    """
    _check(system, t1, dt)
    plot = _import_plot()
    _make_writable(out)
    runs = {name: _run(system, solver, t1, dt) for name, solver in solvers(system).items()}
    comparison = _compare(system, runs)
    metrics = _metrics(system, runs, comparison, t1, dt)
    for name, figure in _figures(plot, system, runs, comparison).items():
        for suffix in ("png", "pdf"):
            _write(out / f"{name}.{suffix}", lambda path, f=figure: plot.save(f, path))
    text = json.dumps(metrics, indent=2, allow_nan=False) + "\n"
    _write(out / "metrics.json", lambda path: path.write_text(text, encoding="utf-8"))
    write(_table(system, metrics, t1, dt))
    write(f"\nThe figures and metrics.json are in {out}")
    return comparison.failure is None and all(run.failure is None for run in runs.values())


# ---- What can be wrong before the work starts ----


def _check(system: AbstractSystem, t1: float, dt: float) -> None:
    for name, value in {"t1": t1, "dt": dt}.items():
        if not 0 < value < math.inf:
            raise SetupError(f"{name} must be a positive number, but is {value}.")
    if dt > t1:
        raise SetupError(
            f"dt = {dt:g} is longer than the whole solve, t1 = {t1:g}. Take at most dt = {t1:g}."
        )
    unknowns = sum(x.size for x in jtu.tree_leaves(system.y0))
    steps_max = _BYTES_MAX // (8 * unknowns)
    if t1 / dt > steps_max:
        raise SetupError(
            f"{t1 / dt:.3g} steps are too many to hold in memory; {system.name} can have "
            f"{steps_max:.3g}. Choose a smaller t1 or a larger dt."
        )


def _import_plot() -> Any:
    try:
        from . import _plot
    except ImportError as error:
        raise SetupError(
            "the figures need matplotlib, which is not installed. Install it by "
            f"`pip install diffrax-conserve[plots]`. ({error})"
        ) from error
    return _plot


def _make_writable(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise SetupError(
            f"cannot write to the folder {out}: {error.strerror}. Name another one by `--out DIR`."
        ) from error


# ---- The solves ----


@eqx.filter_jit
def _solve(
    system: AbstractSystem, solver: dfx.AbstractSolver, t1: jax.Array, dt: jax.Array, max_steps: int
) -> dfx.Solution:
    return dfx.diffeqsolve(
        dfx.ODETerm(system.vector_field),
        solver,
        t0=0.0,
        t1=t1,
        dt0=dt,
        y0=system.y0,
        args=system.args,
        saveat=dfx.SaveAt(t0=True, steps=True),
        stepsize_controller=dfx.ConstantStepSize(),
        max_steps=max_steps,
        throw=False,
    )


def _run(system: AbstractSystem, solver: dfx.AbstractSolver, t1: float, dt: float) -> Run:
    try:
        return _timed_run(system, solver, t1, dt)
    except (RuntimeError, TypeError, ValueError) as error:
        # One solver that cannot start must not cost the results of the others.
        nothing = np.zeros(0)
        return Run(nothing, nothing, {}, 0, 0.0, 0.0, f"at the start: {error}")


def _timed_run(system: AbstractSystem, solver: dfx.AbstractSolver, t1: float, dt: float) -> Run:
    arguments = (system, solver, jnp.asarray(t1), jnp.asarray(dt), math.ceil(t1 / dt) + 1)
    started = time.perf_counter()
    compiled = _solve.lower(*arguments).compile()  # pyright: ignore[reportFunctionMemberAccess]
    compile_seconds = time.perf_counter() - started
    jax.block_until_ready(compiled(*arguments).ys)
    started = time.perf_counter()
    solution = compiled(*arguments)
    jax.block_until_ready(solution.ys)
    seconds = time.perf_counter() - started

    drifts = eqx.filter_jit(drift)(solution, system.manifold, system.args)
    count = int(np.sum(np.isfinite(solution.ts)))  # the rest is padding
    ts = np.asarray(solution.ts)[:count]
    ys = jtu.tree_map(lambda y: np.asarray(y)[:count], solution.ys)
    largest = {name: _largest_component(drifts[name])[:count] for name in system.manifold}
    return Run(
        ts,
        ys,
        largest,
        int(solution.stats["num_steps"]),
        seconds,
        compile_seconds,
        _failure(solution.result, ts, ys, largest),
    )


def _largest_component(values: Any) -> np.ndarray:
    leaves = [np.abs(np.asarray(x)) for x in jtu.tree_leaves(values)]
    return np.max(np.concatenate([x.reshape(x.shape[0], -1) for x in leaves], axis=1), axis=1)


def _failure(
    result: dfx.RESULTS, ts: np.ndarray, ys: Any, drifts: dict[str, np.ndarray]
) -> str | None:
    if result != dfx.RESULTS.successful:
        reason = " ".join(dfx.RESULTS[result].split())
        return f"after t = {ts[-1]:.6g}: {reason}"
    values = [*jtu.tree_leaves(ys), *drifts.values()]
    finite = np.all([np.isfinite(x).reshape(len(ts), -1).all(axis=1) for x in values], axis=0)
    if not finite.all():
        first = ts[np.argmin(finite)]
        return f"at t = {first:.6g}: the state is not finite any more. Choose a smaller dt."
    return None


# ---- The comparison with the reference ----


@dataclasses.dataclass(frozen=True)
class Comparison:
    """The reference on a fine grid for the pictures, and each solver's distance from it."""

    reference: Any  # states, None where there are none
    stride: int  # the errors are at every `stride`-th saved time
    errors: dict[str, np.ndarray]  # by solver; empty without a reference
    failure: str | None = None


def _compare(system: AbstractSystem, runs: dict[str, Run]) -> Comparison:
    succeeded = {name: run for name, run in runs.items() if run.failure is None}
    if not succeeded:
        return Comparison(None, 1, {})
    # Every solver takes the same steps.
    ts = next(iter(succeeded.values())).ts
    stride = math.ceil((len(ts) - 1) / _PLOTTED_MAX)
    times = ts[_thinned(len(ts), stride)]
    refinement = math.ceil(1000 / (len(times) - 1))
    fine = np.interp(
        np.arange((len(times) - 1) * refinement + 1) / refinement, np.arange(len(times)), times
    )
    fine[::refinement] = times
    try:
        reference = jtu.tree_map(np.asarray, system.reference(fine))
    except RuntimeError as error:  # what diffrax and `equinox.error_if` raise
        return Comparison(None, stride, {}, f"the reference failed: {str(error).splitlines()[0]}")
    at_times = jtu.tree_map(lambda y: y[::refinement], reference)
    errors = {
        name: _distance(_take(run.ys, _thinned(len(run.ts), stride)), at_times)
        for name, run in succeeded.items()
    }
    return Comparison(reference, stride, errors)


def _thinned(count: int, stride: int) -> np.ndarray:
    """Every `stride`-th index, counted back from the last."""
    return np.unique(np.append(np.arange(count - 1, -1, -stride), 0))


def _take(ys: Any, index: np.ndarray) -> Any:
    return jtu.tree_map(lambda y: y[index], ys)


def _distance(ys: Any, reference: Any) -> np.ndarray:
    squares = jtu.tree_map(
        lambda a, b: np.sum(((a - b) ** 2).reshape(len(a), -1), axis=1), ys, reference
    )
    return np.sqrt(sum(jtu.tree_leaves(squares)))


# ---- What is written ----


def _metrics(
    system: AbstractSystem, runs: dict[str, Run], comparison: Comparison, t1: float, dt: float
) -> dict[str, Any]:
    def row(name: str, run: Run) -> dict[str, Any]:
        ok = run.failure is None
        errors = comparison.errors.get(name)
        return {
            "state_error": None if errors is None else float(errors[-1]),
            "largest_state_error": None if errors is None else float(np.max(errors)),
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
        **({} if comparison.failure is None else {"failure": comparison.failure}),
        "versions": {
            "diffrax-conserve": __version__,
            "diffrax": dfx.__version__,
            "jax": jax.__version__,
            "python": platform.python_version(),
        },
        "device": jax.devices()[0].device_kind,
    }


def _table(system: AbstractSystem, metrics: dict[str, Any], t1: float, dt: float) -> str:
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
    return "\n".join([heading, "", *text, "", *failures, FOOTER])


def _number(x: float | None) -> str:
    return "-" if x is None else f"{x:.2e}"


def _figures(
    plot: Any, system: AbstractSystem, runs: dict[str, Run], comparison: Comparison
) -> dict[str, Any]:
    stride = comparison.stride
    succeeded = {name: run for name, run in runs.items() if run.failure is None}
    if not succeeded:
        return {}
    index = {name: _thinned(len(run.ts), stride) for name, run in succeeded.items()}
    paths = {name: _paths(system, _take(run.ys, index[name])) for name, run in succeeded.items()}
    reference = None if comparison.reference is None else _paths(system, comparison.reference)

    time_unit, time_scale, error_unit = _UNITS.get(system.name, ("", 1.0, ""))
    # The initial state has neither error nor drift.
    times = {name: run.ts[index[name]][1:] / time_scale for name, run in succeeded.items()}
    drifts = {
        integral: {
            name: np.maximum.reduceat(run.drift[integral][1:], index[name][:-1])
            for name, run in succeeded.items()
        }
        for integral in system.manifold
    }
    figures = {
        "trajectory": plot.trajectory(paths, reference, system.axes),
        "drift": plot.drift(times, drifts, time_unit),
    }
    if comparison.errors:
        errors = {name: values[1:] for name, values in comparison.errors.items()}
        figures["state_error"] = plot.state_error(times, errors, time_unit, error_unit)
    return figures


def _paths(system: AbstractSystem, ys: Any) -> dict[str, np.ndarray]:
    paths = system.trajectories(jtu.tree_map(jnp.asarray, ys))
    return {name: np.asarray(path) for name, path in paths.items()}


def _write(path: Path, write: Callable[[Path], Any]) -> None:
    """`write(path)`, such that no reader ever sees a part of the file."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        temporary.chmod(0o644)  # `mkstemp` makes it private
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
