"""The comparison of every solver with the reference."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax.tree_util as jtu
import numpy as np

from ..systems import AbstractSystem
from ._solve import Run

# The largest number of times in the figures. The largest drift is taken over all times.
PLOTTED_MAX = 2000


@dataclasses.dataclass(frozen=True)
class Comparison:
    """The reference on a fine grid for the figures, and the error of each solver."""

    reference: Any  # from the first initial state; None if there is no reference
    stride: int  # the errors are at every `stride`-th saved time
    errors: dict[str, np.ndarray]  # by solver, `(states, times)`; empty without a reference
    failure: str | None = None


def compare(system: AbstractSystem, y0s: Any, runs: dict[str, Run]) -> Comparison:
    succeeded = {name: run for name, run in runs.items() if run.failure is None}
    if not succeeded:
        return Comparison(None, 1, {})
    # Every solver takes the same steps.
    ts = next(iter(succeeded.values())).ts
    stride = math.ceil((len(ts) - 1) / PLOTTED_MAX)
    times = ts[thinned(len(ts), stride)]
    refinement = math.ceil(1000 / (len(times) - 1))
    fine = np.interp(
        np.arange((len(times) - 1) * refinement + 1) / refinement, np.arange(len(times)), times
    )
    fine[::refinement] = times
    try:
        first = _reference(system, fine, take(y0s, slice(1)))
        others = _reference(system, times, take(y0s, slice(1, None)))
    except RuntimeError as error:  # raised by diffrax and `equinox.error_if`
        return Comparison(None, stride, {}, f"the reference failed: {str(error).splitlines()[0]}")
    at_times = jtu.tree_map(lambda y: y[:, ::refinement], first)
    if others is not None:
        at_times = jtu.tree_map(lambda a, b: np.concatenate([a, b]), at_times, others)
    errors = {
        name: _distance(
            jtu.tree_map(lambda y: y[:, thinned(y.shape[1], stride)], run.ys),
            at_times,
        )
        for name, run in succeeded.items()
    }
    return Comparison(jtu.tree_map(lambda y: y[0], first), stride, errors)


def thinned(count: int, stride: int) -> np.ndarray:
    """Every `stride`-th index, counted back from the last."""
    return np.unique(np.append(np.arange(count - 1, -1, -stride), 0))


def take(ys: Any, index: Any) -> Any:
    return jtu.tree_map(lambda y: y[index], ys)


def _reference(system: AbstractSystem, times: np.ndarray, y0s: Any) -> Any:
    """The reference through each of `y0s`, with a leading axis; `None` if `y0s` is empty."""
    if jtu.tree_leaves(y0s)[0].shape[0] == 0:
        return None
    return jtu.tree_map(np.asarray, eqx.filter_vmap(lambda y0: system.reference(times, y0))(y0s))


def _distance(ys: Any, reference: Any) -> np.ndarray:
    squares = jtu.tree_map(
        lambda a, b: np.sum(((a - b) ** 2).reshape(*a.shape[:2], -1), axis=2), ys, reference
    )
    return np.sqrt(sum(jtu.tree_leaves(squares)))
