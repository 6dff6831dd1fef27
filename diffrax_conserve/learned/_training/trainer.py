"""The rounds of a training: epochs, time limit, progress line, checkpoint."""

import dataclasses
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import PRNGKeyArray

from ..._custom_types import Args
from .._networks.trainable import AbstractTrainable, Sampler
from .data import Data
from .defect import VectorField
from .objective import Carry, Objective, advance, start
from .recipe import Recipe
from .state import FitState, write_checkpoint

# Called with the number of epochs done, the total number, the last loss and the best criterion.
Progress = Callable[[int, int, float, float], None]


def report(
    progress: bool | Progress,
    state: FitState,
    epochs: int,
    first: int,
    elapsed: float,
    estimate: Callable[[], float],
) -> None:
    """Calls the function `progress`, or prints a line."""
    if progress is False:
        return
    windows = state.windows
    networks = 1 if windows is None else windows.errors.size - windows.present
    done, total = state.done + state.trained * epochs, (state.trained + networks) * epochs
    # Before the first epoch there is no loss yet.
    loss = float(state.carry.losses[state.done - 1]) if state.done else float(state.criteria[0])
    best = float(state.carry.best)
    if progress is not True:
        progress(done, total, loss, best)
        return
    # On a terminal one line is overwritten; in a file there is one line for each tenth of the
    # epochs.
    terminal = sys.stderr.isatty()
    if terminal or done == total or done % max(total // 10, 1) == 0:
        end = "\r" if terminal and done < total else "\n"
        parts = [f"epoch {done:>{len(str(total))}} of {total}: loss {loss:.3e}, best {best:.3e}"]
        error = estimate() if done else 0
        if error:
            parts.append(f"estimated error {error:.1e}")
        if done > first:
            parts.append(f"{elapsed / (done - first) * (total - done):.0f} s left")
        print(", ".join(parts), end=end, file=sys.stderr, flush=True)


@final
@dataclasses.dataclass
class Trainer:
    """Trains several networks of the same shape in turn, with one compilation."""

    vector_field: VectorField | None
    sample: Sampler | None
    data: Data | None
    args: Args
    recipe: Recipe
    key: PRNGKeyArray
    target: float | None
    seconds: float
    progress: bool | Progress
    checkpoint: Path | None
    mark: str
    begun: float = dataclasses.field(default_factory=time.perf_counter)
    compiled: Any = None
    compile_seconds: float = 0.0
    first: int | None = None  # the first epoch of this call of `fit`
    saved: float = -np.inf  # time of the last save; `saving` is its duration
    saving: float = 0.0

    def network_key(self, state: FitState) -> PRNGKeyArray:
        return self.key if state.trained == 0 else jr.fold_in(self.key, state.trained)

    def start(self, model: AbstractTrainable, state: FitState | None) -> tuple[Objective, Carry]:
        """The constants of the training of the present network, and its first carry."""
        key = self.key if state is None else self.network_key(state)
        field, data = self.vector_field, self.data
        return start(model, field, key, self.sample, self.args, self.recipe, data)

    @property
    def substeps(self) -> int:
        """The number of steps for the error of a window."""
        return 2 * self.recipe.points

    def rounds(
        self,
        objective: Objective,
        state: FitState,
        close_enough: Callable[[Objective, FitState], bool],
        estimate: Callable[[Objective, FitState], float],
    ) -> tuple[FitState, str]:
        """Trains one network to its last epoch, or until the training ends earlier."""
        epochs, ended = self.recipe.epochs, ""
        state = _resized(state, epochs)
        try:
            self._compile(objective, state)
            while not ended:
                # The first round has no epochs: it only evaluates the given model.
                stop = min(state.done + self.recipe.check_every, epochs)
                stop = stop if state.checked.size else 0
                carry, criterion = self.compiled(
                    objective, state.carry, jnp.asarray(state.done), jnp.asarray(stop)
                )
                state = dataclasses.replace(
                    state,
                    carry=carry,
                    checked=np.append(state.checked, stop),
                    criteria=np.append(state.criteria, float(criterion)),
                )
                self._report(state, lambda s=state: estimate(objective, s))
                if close_enough(objective, state):
                    ended = "target"
                elif state.done >= epochs:
                    ended = "epochs"
                elif time.perf_counter() - self.begun > self.seconds:
                    ended = "seconds"
                else:
                    self.save(state)
        except KeyboardInterrupt:
            if not state.checked.size and not state.trained:
                raise
            ended = "interrupt"
        _refuse_nothing(state)
        return state, ended

    def save(self, state: FitState, always: bool = False) -> None:
        """Writes a checkpoint, unless the time since the last one is short compared with its
        duration."""
        begun = time.perf_counter()
        if self.checkpoint is None or not (always or begun - self.saved > 20 * self.saving):
            return
        write_checkpoint(self.checkpoint, state, self.mark)
        self.saved = time.perf_counter()
        self.saving = self.saved - begun

    def _report(self, state: FitState, estimate: Callable[[], float]) -> None:
        epochs = self.recipe.epochs
        self.first = state.trained * epochs + state.done if self.first is None else self.first
        report(self.progress, state, epochs, self.first, time.perf_counter() - self.begun, estimate)

    def _compile(self, objective: Objective, state: FitState) -> None:
        if self.compiled is None:
            begun = time.perf_counter()
            arguments = (objective, state.carry, jnp.asarray(0), jnp.asarray(0))
            compilable = eqx.filter_jit(advance)
            lowered = compilable.lower(*arguments)  # pyright: ignore[reportFunctionMemberAccess]
            self.compiled = lowered.compile()
            self.compile_seconds = time.perf_counter() - begun


def _resized(state: FitState, epochs: int) -> FitState:
    """`state` with an array of losses for this many epochs."""
    losses = state.carry.losses[:epochs]
    losses = jnp.concatenate([losses, jnp.full(epochs - losses.size, jnp.nan, losses.dtype)])
    return dataclasses.replace(state, carry=state.carry._replace(losses=losses))


def _refuse_nothing(state: FitState) -> None:
    """Raises if every update was skipped."""
    skipped = int(state.carry.skipped)
    if skipped and skipped == state.done:
        raise FloatingPointError(
            f"None of the {skipped} updates was finite, so nothing was learned, although the "
            "vector field is finite at the initial states. It may not be finite where the network "
            "leads, or the updates are too long: lower the learning rate."
        )
