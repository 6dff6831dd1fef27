"""Printing of records of numbers."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.core
import jax.tree_util as jtu
import numpy as np


def printed(title: str, rows: Mapping[str, Any]) -> str:
    """`title`, and a line for each row with its name and its number, or the range over a batch."""
    width = max(map(len, rows), default=0)
    return "\n".join([title, *(f"  {name:{width}}  {_text(x)}" for name, x in rows.items())])


def names_at(positions: Any, names: Sequence[str]) -> str:
    """The names at one position, or at those of a batch, each once; a negative one has none."""
    return ", ".join(names[int(i)] for i in np.unique(positions) if i >= 0)


def is_traced(tree: Any) -> bool:
    """Whether a leaf is a tracer, as inside `jax.jit`, so that there is no number to print."""
    return any(isinstance(x, jax.core.Tracer) for x in jtu.tree_leaves(tree))


def _text(value: Any) -> str:
    if isinstance(value, str):
        return value
    array = np.asarray(value)
    if array.ndim == 0:
        integer = np.issubdtype(array.dtype, np.integer)
        return f"{int(array):,}" if integer else f"{float(array):.1e}"
    if array.size == 0:
        return "none"
    lowest, highest = _text(array.min()), _text(array.max())
    return lowest if lowest == highest else f"{lowest} to {highest}"
