"""The main job: a system of the catalogue, solved with and without projection, and compared."""

import json
import math
import sys
import tempfile
from pathlib import Path
from typing import Any

import diffrax as dfx
import jax.tree_util as jtu

from .._projection.simplified_newton import SimplifiedNewton
from .._solver.manifold_projection import ManifoldProjection
from .._solver.unrolled import RK4
from .._tree import tree_size
from ..learned._replace_file import replace_file
from ..systems import AbstractSystem
from ..systems._chemistry import AbstractChemistry
from ._solve import reason, run, state_errors
from ._tables import metrics, table
from ._trained import (
    Learned,
    initial_states,
    is_learned,
    learned_solvers,
    pretrained,
    projection_schedule,
    trained,
)

# The largest size of the states of all steps, which are kept in memory.
_BYTES_MAX = 2**29


class SetupError(Exception):
    """The job cannot start; the message gives the reason and a remedy."""


def solvers(system: AbstractSystem, networks: dict[str, Any]) -> dict[str, dfx.AbstractSolver]:
    """The solvers to compare, in the order of the table and the legends."""
    if isinstance(system, AbstractChemistry):
        projection = system.mechanism.positive_projection()
        kept = ManifoldProjection(dfx.Kvaerno5(), system.manifold, projection=projection)
        return {"kvaerno5": dfx.Kvaerno5(), "projected kvaerno5": kept}
    # The paper knows the Euclidean distance only, so its systems are projected in that metric.
    projection = SimplifiedNewton(metric=1.0 if is_learned(system) else None)
    projected = ManifoldProjection(RK4(), system.manifold, projection=projection)
    classical = {"rk4": RK4(), "projected rk4": projected}
    return classical | (learned_solvers(system, networks) if networks else {})


def reproduce(
    system: AbstractSystem,
    out: Path,
    *,
    t1: float,
    dt: float,
    anew: bool = False,
    seed: int = 0,
    epochs: int = 5000,
) -> bool:
    """Compares the `solvers` on `system` from 0 to `t1`; writes a table, figures, `metrics.json`.

    With `anew` the networks of the paper's systems are trained first; otherwise the pretrained ones
    are used. Returns whether every solver succeeded. Raises `SetupError` before the work starts.
    """
    y0s = initial_states(system)
    states = jtu.tree_leaves(y0s)[0].shape[0]
    check_times(system, t1, dt, states)
    if anew and not is_learned(system):
        raise SetupError(
            f"--train: there are no learned solvers for {system.name}. The paper has them for the "
            "first five systems that `list` names."
        )
    plot = import_plot()
    make_writable(out)
    networks: dict[str, Learned] = {}
    if is_learned(system):
        networks = trained(system, out, seed, epochs) if anew else pretrained(system)
    chosen = solvers(system, {kind: network for kind, (network, *_) in networks.items()})
    runs = {}
    for i, (name, solver) in enumerate(chosen.items(), start=1):
        _say(f"[{i}/{len(chosen)}] {name}: compiles and solves")
        runs[name] = run(system, solver, y0s, t1, dt)
    _say("reference and figures")
    try:
        errors = state_errors(system, y0s, runs)
    except RuntimeError as error:  # raised by diffrax and `equinox.error_if`
        errors = {}
        _say(f"the reference failed: {reason(error)}")
    numbers = metrics(system, runs, errors, t1, dt, states)
    if plot is not None:
        schedule = projection_schedule(networks["conservative"][0], epochs) if anew else {}
        plot.draw(out, system, runs, errors, networks, schedule)
    text = json.dumps(numbers, indent=2, allow_nan=False) + "\n"
    replace_file(out / "metrics.json", lambda path: path.write_text(text, encoding="utf-8"))
    print(table(system, numbers))
    if plot is None:
        where = "in the folder of diffrax-conserve"
        print(f"\nThe figures need matplotlib: pip install '.[plots]' {where}")
    print(f"\nWhat is written is in {out}")
    return len(errors) == len(runs)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


# ---- Before the work starts ----


def check_times(system: AbstractSystem, t1: float, dt: float, states: int) -> None:
    """Raises unless the solve from 0 to `t1` in steps of `dt` is valid and fits into memory."""
    if not 0 < dt <= t1 < math.inf:
        raise SetupError(f"--t1 {t1:g} and --dt {dt:g} must be positive, and dt at most t1.")
    steps_max = _BYTES_MAX // (8 * states * tree_size(system.y0))
    if t1 / dt > steps_max:
        raise SetupError(
            f"{t1 / dt:.3g} steps are too many to hold in memory; {system.name} can have "
            f"{steps_max:.3g}. Choose a smaller t1 or a larger dt."
        )


def import_plot() -> Any | None:
    """The module that draws the figures, or `None` without matplotlib."""
    try:
        from . import _plot as _plot
    except ImportError:
        return None
    return _plot


def make_writable(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()
    except OSError as error:
        raise SetupError(
            f"cannot write to the folder {out}: {error.strerror}. Name another one by `--out DIR`."
        ) from error
