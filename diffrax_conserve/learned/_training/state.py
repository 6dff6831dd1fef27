"""The state of a training, from which another call of `fit` or another process can continue it."""

import dataclasses
import hashlib
import json
import re
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

    networks: tuple[Any, ...]  # the flow map as it was given, or the windows of a PINN
    errors: tuple[float, ...]  # of each window alone; infinity if it is not trained
    carry: Carry  # of the present network
    present: int = 0  # its index
    done: int = -1  # its epochs; -1 if it was not evaluated
    trained: int = 0  # number of trainings that have ended
    finished: int = 0
    passes: int = 0  # number of earlier passes over the windows, each with a smaller limit
    tightening: float = 1.0  # by which the limit of a window's error is divided
    # The records of all networks; in `losses` and `skipped` without the present one.
    losses: np.ndarray = eqx.field(default_factory=lambda: np.zeros(0))
    checked: np.ndarray = eqx.field(default_factory=lambda: np.zeros(0, int))
    criteria: np.ndarray = eqx.field(default_factory=lambda: np.zeros(0))
    skipped: int = 0

    def compared(self, criterion: float) -> "FitState":
        """This state with one more comparison in its records."""
        checked = np.append(self.checked, self.losses.size + self.done)
        criteria = np.append(self.criteria, criterion)
        return dataclasses.replace(self, checked=checked, criteria=criteria)

    def closed(self) -> "FitState":
        """This state with all of its present network in the records."""
        return dataclasses.replace(
            self,
            losses=np.concatenate([self.losses, np.asarray(self.carry.losses)]),
            skipped=self.skipped + int(self.carry.skipped),
            done=-1,
            trained=self.trained + 1,
        )

    def continued(self, epochs: int, first: "FitState") -> "FitState":
        """This state, if a training of so many epochs can go on from it; `first` is that of a new
        training."""
        if jtu.tree_structure(self.carry.weights) != jtu.tree_structure(first.carry.weights):
            raise ValueError("`state` is that of a training of another kind of network.")
        if self.done >= epochs or (self.finished and len(self.networks) > 1):
            raise ValueError(
                f"The training of `state` has made all its {self.done} epochs. Give a recipe with "
                "more: `dataclasses.replace(recipe, epochs=...)`; several windows cannot go on."
            )
        losses = self.carry.losses[:epochs]
        losses = jnp.concatenate([losses, jnp.full(epochs - losses.size, jnp.nan, losses.dtype)])
        return dataclasses.replace(self, finished=0, carry=self.carry._replace(losses=losses))


def fingerprint(given: Any, recipe: Any) -> str:
    """A hash of the arrays that were given to `fit` and of the recipe as it prints, up to its
    epochs, which identifies a training."""
    digest = hashlib.sha256()
    for leaf in jtu.tree_leaves(eqx.filter(given, eqx.is_array)):
        is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        digest.update(np.asarray(jr.key_data(leaf) if is_key else leaf).tobytes())
    printed = eqx.tree_pformat(dataclasses.replace(recipe, epochs=1))
    digest.update(re.sub(" at 0x[0-9a-f]+", "", printed).encode())
    return digest.hexdigest()


def write_checkpoint(path: Path, state: FitState, mark: str) -> None:
    """Writes `state` atomically: a line of JSON with what determines its shapes, and its leaves."""
    sizes = [len(state.networks), state.losses.size, state.checked.size, state.carry.losses.size]
    header = json.dumps({"format": _FORMAT, "mark": mark, "sizes": sizes})

    def write(path: Path) -> None:
        with path.open("wb") as file:
            file.write(header.encode() + b"\n")
            eqx.tree_serialise_leaves(file, state)

    replace_file(path, write)


def read_checkpoint(path: Path, like: FitState, mark: str) -> FitState:
    """The state in a file; `like` is the first state of the same training."""
    with path.open("rb") as file:
        try:
            header = json.loads(file.readline())
            if (header["format"], header["mark"]) != (_FORMAT, mark):
                raise ValueError("it is of another training, with other arguments")
            count, losses, checked, epochs = header["sizes"]
            like = dataclasses.replace(
                like,
                networks=like.networks[:1] * count,
                errors=(0.0,) * count,
                carry=like.carry._replace(losses=jnp.zeros(epochs, like.carry.losses.dtype)),
                losses=np.zeros(losses),
                checked=np.zeros(checked, int),
                criteria=np.zeros(checked),
            )
            return eqx.tree_deserialise_leaves(file, like)
        except (ValueError, KeyError, TypeError, RuntimeError) as error:
            raise ValueError(
                f"The file {path} holds no checkpoint of this training: {error}."
            ) from error


_FORMAT = 4
