"""The comparison of every solver with the reference."""

import dataclasses
from typing import Any

import equinox as eqx
import jax.tree_util as jtu
import numpy as np

from ..systems import AbstractSystem
from ._solve import Run

# The largest number of times at which solvers are compared. The largest drift is that of all times.
COMPARED_MAX = 2000


@dataclasses.dataclass(frozen=True)
class Comparison:
    """The error of each solver at some of its times."""

    index: np.ndarray  # of these times
    errors: dict[str, np.ndarray]  # by solver, `(states, times)`; empty without a reference
    failure: str | None = None


def compare(system: AbstractSystem, y0s: Any, runs: dict[str, Run]) -> Comparison:
    succeeded = {name: run for name, run in runs.items() if run.failure is None}
    if not succeeded:
        return Comparison(np.zeros(0, int), {})
    # Every solver takes the same steps.
    ts = next(iter(succeeded.values())).ts
    index = np.unique(np.linspace(0, len(ts) - 1, COMPARED_MAX + 1).round().astype(int))
    try:
        exact = eqx.filter_vmap(lambda y0: system.reference(ts[index], y0))(y0s)
    except RuntimeError as error:  # raised by diffrax and `equinox.error_if`
        return Comparison(index, {}, f"the reference failed: {str(error).splitlines()[0]}")
    errors = {name: _distance(take(run.ys, index, 1), exact) for name, run in succeeded.items()}
    return Comparison(index, errors)


def take(ys: Any, index: Any, axis: int = 0) -> Any:
    return jtu.tree_map(lambda y: np.take(y, index, axis), ys)


def _distance(ys: Any, exact: Any) -> np.ndarray:
    squares = jtu.tree_map(
        lambda a, b: np.sum((a - np.asarray(b)).reshape(*a.shape[:2], -1) ** 2, axis=2), ys, exact
    )
    return np.sqrt(sum(jtu.tree_leaves(squares)))
