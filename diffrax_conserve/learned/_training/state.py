"""The state of a training, from which another call of `fit` or another process can continue it, and
its log."""

import dataclasses
import hashlib
import json
import re
import zipfile
from pathlib import Path
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np

from ..._replace_file import replace_file
from .objective import Carry


@final
class FitState(eqx.Module):
    """The state of a training, `log.state` of [`diffrax_conserve.learned.FitLog`][].

    Pass it to [`diffrax_conserve.fit`][] as `state`. Its contents are not part of the interface.
    """

    model: Any  # as it was given
    carry: Carry  # of the present network
    checked: np.ndarray  # of that network
    criteria: np.ndarray
    past: "Past"
    trained: int = 0  # number of trainings that have ended
    finished: int = 0
    windows: "Windows | None" = None  # of a PINN

    @property
    def done(self) -> int:
        """The number of epochs of the present network."""
        return int(self.checked[-1]) if self.checked.size else 0


@final
class Windows(eqx.Module):
    """The windows of a PINN in training, stacked in numpy arrays, because their number may
    change."""

    nets: Any
    y0s: Any
    edges: np.ndarray
    errors: np.ndarray  # of each window alone; infinity if it is not trained
    halvings: np.ndarray  # how often each one's original window was cut
    slope: float  # of the first weights; 0 for none
    present: int = 0  # index of the one in training
    attempt: int = 0  # number of its earlier trainings
    given_up: int = 0  # whether a window has finally failed
    passes: int = 0  # number of earlier passes over the windows, each with a smaller limit
    tightening: float = 1.0  # by which the limit of a window's error is divided


@final
class Past(eqx.Module):
    """The records of the networks before the present one, and the values of the worst of them."""

    losses: np.ndarray
    checked: np.ndarray
    criteria: np.ndarray
    best_epoch: int = 0
    best: float = -1.0
    skipped: int = 0

    @classmethod
    def empty(cls) -> "Past":
        return cls(np.zeros(0), np.zeros(0, int), np.zeros(0))

    def and_then(self, carry: Carry, checked: np.ndarray, criteria: np.ndarray) -> "Past":
        """These records with that of one more network."""
        before = self.losses.size
        worse = float(carry.best) > self.best
        return Past(
            np.concatenate([self.losses, np.asarray(carry.losses)]),
            np.concatenate([self.checked, before + checked]),
            np.concatenate([self.criteria, criteria]),
            before + int(carry.best_epoch) if worse else self.best_epoch,
            max(float(carry.best), self.best),
            self.skipped + int(carry.skipped),
        )


def continued(state: FitState, epochs: int, first: FitState) -> FitState:
    """The given `state`, if a training can be continued from it; `first` is that of a new
    training."""
    if jtu.tree_structure(state.carry.weights) != jtu.tree_structure(first.carry.weights):
        raise ValueError("`state` is that of a training of another kind of network.")
    if state.done < epochs and (state.windows is None or state.windows.errors.size == 1):
        return dataclasses.replace(state, finished=0)
    if state.finished or state.done >= epochs:
        raise ValueError(
            f"The training whose `state` was given has made all its {state.done} epochs, and the "
            f"recipe has {epochs}. Give one with more, such as "
            "`dataclasses.replace(recipe, epochs=...)`; a `PINN` of several windows cannot go on."
        )
    return state


def fingerprint(given: Any, recipe: Any) -> str:
    """A hash of the arrays in what was given to `fit` and of the recipe as it prints, which
    identifies a training. It may be continued with more epochs."""
    digest = hashlib.sha256()
    for leaf in jtu.tree_leaves(eqx.filter(given, eqx.is_array)):
        digest.update(_plain(leaf).tobytes())
    printed = eqx.tree_pformat(dataclasses.replace(recipe, epochs=1))
    digest.update(re.sub(" at 0x[0-9a-f]+", "", printed).encode())
    return digest.hexdigest()


def write_checkpoint(path: Path, state: FitState, mark: str) -> None:
    """Writes `state` atomically."""
    leaves = jtu.tree_leaves(state)
    header = json.dumps({"format": _FORMAT, "mark": mark, "leaves": len(leaves)})
    arrays: dict[str, Any] = {f"x{i}": _plain(leaf) for i, leaf in enumerate(leaves)}

    def write(path: Path) -> None:
        with path.open("wb") as file:
            np.savez(file, header=np.array(header), **arrays)

    replace_file(path, write)


def read_checkpoint(path: Path, like: FitState, mark: str) -> FitState:
    """The state in a file; `like` is the first state of the same training."""
    try:
        with np.load(path, allow_pickle=False) as file:
            header = json.loads(str(file["header"]))
            found = [file[f"x{i}"] for i in range(header["leaves"])]
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"The file {path} holds no checkpoint of a training: {error}.") from error
    if header.get("format") != _FORMAT or header.get("mark") != mark:
        raise ValueError(
            f"The checkpoint {path} is of another training: its network, its key or its recipe "
            "differs. Give the same arguments, or another file."
        )
    leaves, treedef = jtu.tree_flatten(like)
    return treedef.unflatten([_as(x, y) for x, y in zip(found, leaves, strict=True)])


_FORMAT = 1


def _is_key(x: Any) -> bool:
    return isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def _plain(leaf: Any) -> np.ndarray:
    return np.asarray(jr.key_data(leaf) if _is_key(leaf) else leaf)


def _as(found: np.ndarray, like: Any) -> Any:
    """A leaf of a file, converted to the type of `like`."""
    if isinstance(like, int | float):
        return type(like)(found)
    if isinstance(like, np.ndarray):
        return found
    if _is_key(like):
        return jr.wrap_key_data(jnp.asarray(found))
    if found.dtype.kind == "V":  # numpy does not know bfloat16
        found = found.view(like.dtype)
    return jnp.asarray(found)


@final
class FitLog(eqx.Module):
    """The record of a training.

    **Attributes:**

    - `error`: the estimated error of the solution, for each leaf of the state relative to its
        largest component. For a `PINN` it is the largest error in the whole interval; for a flow
        map the root mean square error of its longest step, over states from `sample`. The estimate
        solves the differential equation of the error, driven by the defect. Infinity if no estimate
        is possible or a window was not trained.
    - `errors`: for each window of a `PINN`, the error that this window alone causes.
    - `losses`: the training loss at each epoch, before its update.
    - `checked`, `criteria`: the epochs at which the model was compared with the best so far, and
        the compared values: the loss on the first collocation points with all iterations of the
        conservative layer, so that epochs with different numbers of iterations are comparable. With
        a [`diffrax_conserve.learned.Pool`][] it is the loss on its states for the next epoch, the
        same states for both models.
    - `best_epoch`, `best`: the epoch of the returned model, and its criterion; for several windows
        those of the worst.
    - `skipped`: the number of updates that were not finite. Each was replaced by a return to the
        best model so far, with a new state of the optimiser.
    - `ended`: the reason why the training ended: `"epochs"`, `"target"`, `"seconds"` or
        `"interrupt"`.
    - `seconds`, `compile_seconds`: the wall times of the training and of the compilation.
    - `state`: the state of the training, to continue it by `fit(..., state=log.state)`.
    """

    error: float
    errors: np.ndarray
    losses: np.ndarray
    checked: np.ndarray
    criteria: np.ndarray
    best_epoch: int
    best: float
    skipped: int
    ended: str
    seconds: float
    compile_seconds: float
    state: Any
