"""The state of a training, from which another call of `fit` can continue it."""

import dataclasses
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._tree import tree_shapes
from .objective import Carry


@final
class FitState(eqx.Module):
    """The state of a training, `log.state` of [`diffrax_conserve.learned.FitLog`][].

    Pass it to [`diffrax_conserve.fit`][] as `state`. Its contents are not part of the interface.
    For a flow map the shapes of its arrays follow from the model and the recipe alone, so that
    `equinox.tree_deserialise_leaves` can read it.
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
    first: Any = None  # the first window of a PINN as it was given
    # The records of all networks without the present one.
    losses: np.ndarray = eqx.field(default_factory=lambda: np.zeros(0))
    criteria: np.ndarray = eqx.field(default_factory=lambda: np.zeros(0))
    checked: np.ndarray = eqx.field(default_factory=lambda: np.zeros(0, int))  # epochs of these
    skipped: int = 0

    def closed(self) -> "FitState":
        """This state with its present network in the records."""
        # Without what is reserved for epochs that were not made.
        losses = np.asarray(self.carry.losses)[: max(self.done, 0)]
        criteria = np.asarray(self.carry.criteria)[: self.done + 1]
        compared = np.flatnonzero(~np.isnan(criteria))
        return dataclasses.replace(
            self,
            losses=np.concatenate([self.losses, losses]),
            criteria=np.concatenate([self.criteria, criteria[compared]]),
            checked=np.concatenate([self.checked, self.losses.size + compared]),
            skipped=self.skipped + int(self.carry.skipped),
            done=-1,
            trained=self.trained + 1,
        )

    def continued(self, epochs: int, first: "FitState") -> "FitState":
        """This state, if a training of so many epochs can go on from it; `first` is that of a new
        training."""
        # All but the records, whose length is that of the training.
        own, new = (carry._replace(losses=0, criteria=0) for carry in (self.carry, first.carry))
        if tree_shapes(own.weights) != tree_shapes(new.weights):
            raise ValueError("`state` is that of a training of another network.")
        if tree_shapes(own) != tree_shapes(new):
            raise ValueError("`state` is that of a training with another optimiser.")
        if self.done >= epochs or (self.finished and len(self.networks) > 1):
            raise ValueError(
                f"The training of `state` has made all its {self.done} epochs. Give a recipe with "
                "more: `dataclasses.replace(recipe, epochs=...)`; several windows cannot go on."
            )
        losses, criteria = self.carry.losses, self.carry.criteria
        carry = self.carry._replace(
            losses=_resized(losses, epochs), criteria=_resized(criteria, epochs + 1)
        )
        return dataclasses.replace(self, finished=0, carry=carry)


def _resized(record: Array, size: int) -> Array:
    record = record[:size]
    return jnp.pad(record, (0, size - record.size), constant_values=jnp.nan)
