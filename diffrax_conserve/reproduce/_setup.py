"""Checks before the work starts."""

import tempfile
from pathlib import Path
from typing import Any

import jax.tree_util as jtu

from ..systems import AbstractSystem

# The largest size of the states of all steps, which are kept in memory.
_BYTES_MAX = 2**29


class SetupError(Exception):
    """The job cannot start; the message gives the reason and a remedy."""


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
