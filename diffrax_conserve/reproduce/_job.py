"""The main job: a system of the catalogue, solved with and without projection, and compared."""

import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import diffrax as dfx
import jax.tree_util as jtu

from .._replace_file import replace_file
from .._solver.manifold_projection import ManifoldProjection
from .._solver.rk4 import RK4
from ..learned._files import save
from ..systems import AbstractSystem
from ._compare import compare
from ._solve import run
from ._tables import figures, metrics, table
from ._trained import (
    KINDS,
    Learned,
    history,
    initial_states,
    is_learned,
    learned_solvers,
    pretrained,
    train,
)

# The largest size of the states of all steps, which are kept in memory.
_BYTES_MAX = 2**29


class SetupError(Exception):
    """The job cannot start; the message gives the reason and a remedy."""


def solvers(system: AbstractSystem, networks: dict[str, Any]) -> dict[str, dfx.AbstractSolver]:
    """The solvers to compare, in the order of the table and the legends."""
    classical = {
        "rk4": RK4(),
        "projected rk4": ManifoldProjection(RK4(), system.manifold),
    }
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
    progress: Callable[[str], None] = lambda _: None,
) -> bool:
    """Compares the `solvers` on `system` from 0 to `t1`; writes a table, figures, `metrics.json`.

    With `anew` the networks of the paper's systems are trained first; otherwise the pretrained ones
    are used. `progress` is called with each stage. Returns whether every solver succeeded. Raises
    `SetupError` before the work starts.
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
        networks = _train(system, out, seed, epochs) if anew else pretrained(system)
    chosen = solvers(system, {kind: network for kind, (network, *_) in networks.items()})
    runs = {}
    for i, (name, solver) in enumerate(chosen.items(), start=1):
        progress(f"[{i}/{len(chosen)}] {name}: compiles and solves")
        runs[name] = run(system, solver, y0s, t1, dt)
    progress("reference and figures")
    comparison = compare(system, y0s, runs)
    numbers = metrics(system, runs, comparison, t1, dt, states)
    drawn = {} if plot is None else figures(plot, system, runs, comparison, networks)
    for name, figure in drawn.items():
        assert plot is not None
        for suffix in ("png", "pdf"):
            replace_file(out / f"{name}.{suffix}", lambda path, f=figure: plot.save(f, path))
    text = json.dumps(numbers, indent=2, allow_nan=False) + "\n"
    replace_file(out / "metrics.json", lambda path: path.write_text(text, encoding="utf-8"))
    print(table(system, numbers))
    if plot is None:
        print("\nThere are no figures: they need matplotlib. Install it by")
        print("    pip install 'diffrax-conserve[plots]'")
    print(f"\n{'metrics.json is' if plot is None else 'The figures and metrics.json are'} in {out}")
    return comparison.failure is None and all(run.failure is None for run in runs.values())


def _train(system: AbstractSystem, out: Path, seed: int, epochs: int) -> dict[str, Learned]:
    """Trains the standard and the conservative network, and saves them beside the figures."""
    networks: dict[str, Learned] = {}
    for kind in KINDS:
        print(f"Training the {kind} network: {epochs} epochs, seed {seed}")
        network, log = train(system, kind, seed=seed, epochs=epochs, progress=True)
        print(
            f"  {log.seconds:.0f} s after {log.compile_seconds:.0f} s of compilation; "
            f"loss {log.criteria.min():.3g} at epoch {log.checked[log.criteria.argmin()]}"
        )
        info = {"system": system.name, "kind": kind, "seed": seed, "epochs": epochs}
        save(out / f"{kind}.network", network, info=info)
        networks[kind] = network, *history(log)
    return networks


# ---- Before the work starts ----


def check_times(system: AbstractSystem, t1: float, dt: float, states: int) -> None:
    """Raises unless the solve from 0 to `t1` in steps of `dt` is valid and fits into memory."""
    if dt > t1:
        raise SetupError(
            f"dt = {dt:g} is longer than the whole solve, t1 = {t1:g}. Take at most dt = {t1:g}."
        )
    unknowns = states * sum(x.size for x in jtu.tree_leaves(system.y0))
    steps_max = _BYTES_MAX // (8 * unknowns)
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
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise SetupError(
            f"cannot write to the folder {out}: {error.strerror}. Name another one by `--out DIR`."
        ) from error
