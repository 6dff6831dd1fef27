"""The loop of a training: its state, its epochs, its clock, what it shows, and its log."""

import dataclasses
import math
import sys
import time
from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from ..._tree import tree_shapes
from .objective import Carry, Objective, Problem, advance, start
from .second_order import SecondOrder

# Called with the number of epochs done, the total number, the last loss and the best criterion. If
# it returns `True` the training ends.
Progress = Callable[[int, int, float, float], bool | None]


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
            raise ValueError(
                "`state` is that of a training of another network, or by another recipe."
            )
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


@final
class FitLog(eqx.Module):
    """The record of a training.

    **Attributes:**

    - `error`: the estimated error, for each leaf of the state relative to its largest component: of
        a `PINN` the largest in the interval, of a flow map the root mean square for its longest
        step, over states from `sample`. Infinity if it is unknown, or a window was not trained.
    - `errors`: for each window of a `PINN`, the error that this window alone causes.
    - `losses`: the training loss at each epoch, before its update.
    - `checked`, `criteria`: the epochs at which the model was compared with the best so far, and
        what was compared: the loss on the first collocation points, with the complete layer.
    - `skipped`: the number of updates that were not finite. Each was replaced by a return to the
        best model so far, with a new state of the optimiser.
    - `ended`: why the training ended: `"epochs"`, `"target"`, `"seconds"`, `"interrupt"`, or
        `"progress"` if that function returned `True`.
    - `seconds`, `compile_seconds`: the wall times of the training, and of all before its first
        epoch.
    - `state`: the state of the training, to continue it by `fit(..., state=log.state)`.
    """

    error: float
    errors: np.ndarray
    losses: np.ndarray
    checked: np.ndarray
    criteria: np.ndarray
    skipped: int
    ended: str
    seconds: float
    compile_seconds: float
    state: Any


@final
@dataclasses.dataclass
class Loop:
    """Trains several networks of the same shape in turn, with one compilation."""

    problem: Problem
    key: PRNGKeyArray
    target: float | None
    seconds: float
    progress: bool | Progress
    created: float  # the beginning of `fit`
    compile_seconds: float = 0.0
    compiled: Any = None
    pace: float = 0.0  # seconds for an epoch; 0 if that is not known

    def begin(self, networks: tuple[Any, ...], given: FitState | None) -> FitState:
        """The first state of the training: the given one, or a new one."""
        _, carry = start(self.problem, networks[0], self.key)
        first = FitState(networks, (math.inf,) * len(networks), carry)
        return first if given is None else given.continued(self.problem.recipe.epochs, first)

    def start(self, state: FitState) -> tuple[Objective, FitState]:
        """The constants of the training of the present network, and its first state."""
        model, key = state.networks[state.present], self.network_key(state)
        objective, carry = start(self.problem, model, key)
        return objective, dataclasses.replace(state, carry=carry) if state.done < 0 else state

    def network_key(self, state: FitState) -> PRNGKeyArray:
        return self.key if state.trained == 0 else jr.fold_in(self.key, state.trained)

    def train(
        self,
        objective: Objective,
        state: FitState,
        close_enough: Callable[[Carry], bool],
        estimate: Callable[[Any], float],
    ) -> tuple[FitState, Carry, str]:
        """Trains one network. Returns the state to go on from, the carry with the best model, and
        why it ended. The first two differ if the time is over between two comparisons: a training
        that goes on must not make one more."""
        recipe, ended = self.problem.recipe, ""
        self._compile(objective, state, estimate)
        try:
            while not ended:
                # At first the model is only evaluated.
                following = (state.done // recipe.check_every + 1) * recipe.check_every
                goal = min(following, recipe.epochs) if state.done >= 0 else 0
                stop = self._affordable(max(state.done, 0), goal)
                if stop < goal and stop == state.done:
                    ended = "seconds"
                    break
                state = self._advanced(objective, state, stop, stop == goal)
                if stop < goal:
                    continue
                stopped = self._report(state, lambda s=state: estimate(objective.best(s.carry)))
                if stopped:
                    ended = "progress"
                elif close_enough(state.carry):
                    ended = "target"
                elif state.done >= recipe.epochs:
                    ended = "epochs"
        except KeyboardInterrupt:
            if state.done < 0 and not state.trained:
                raise
            ended = "interrupt"
        skipped = int(state.carry.skipped)
        if skipped and skipped == state.done:
            raise FloatingPointError(self._none_finite(skipped))
        shown = state if ended != "seconds" else self._advanced(objective, state, state.done, True)
        return state, shown.carry, ended

    def _none_finite(self, count: int) -> str:
        problem, parts = self.problem, []
        if problem.vector_field is not None:
            parts.append("the vector field may not be finite where the network leads")
        if problem.data is not None:
            parts.append("`data` may hold a state at which the loss has no derivative")
        if not isinstance(problem.recipe.method, SecondOrder):
            parts.append("the updates may be too long: lower the learning rate")
        reasons = "; ".join(parts)
        return f"None of the {count} updates was finite: {reasons}."

    def _affordable(self, done: int, goal: int) -> int:
        """The epoch up to which to train in one piece: `goal`, or less if the time is limited."""
        if math.isinf(self.seconds) or goal == 0:
            return goal
        if (left := self.seconds - self.elapsed) <= self.pace:
            return done
        # Half of the time, because the pace may change.
        return min(goal, done + max(1, int(left / (2 * self.pace)) if self.pace else 1))

    def _advanced(
        self, objective: Objective, state: FitState, stop: int, compare: bool
    ) -> FitState:
        begun, done = time.perf_counter(), max(state.done, 0)
        numbers = jnp.asarray(done), jnp.asarray(stop), jnp.asarray(compare)
        carry = jax.block_until_ready(self.compiled(objective, state.carry, *numbers))
        if stop > done:
            self.pace = (time.perf_counter() - begun) / (stop - done)
        return dataclasses.replace(state, carry=carry, done=stop)

    @property
    def elapsed(self) -> float:
        return time.perf_counter() - self.created - self.compile_seconds if self.compiled else 0.0

    def log(
        self, state: FitState, carry: Carry, ended: str, error: float, errors: Any = ()
    ) -> FitLog:
        found = dataclasses.replace(state, carry=carry).closed()
        return FitLog(
            error=error,
            errors=np.asarray(errors),
            losses=found.losses,
            checked=found.checked,
            criteria=found.criteria,
            skipped=found.skipped,
            ended=ended,
            seconds=self.elapsed,
            compile_seconds=self.compile_seconds,
            state=state,
        )

    def _compile(
        self, objective: Objective, state: FitState, estimate: Callable[[Any], float]
    ) -> None:
        if self.compiled is not None:
            return
        numbers = jnp.asarray(0), jnp.asarray(0), jnp.asarray(False)
        with jax.default_matmul_precision("highest"):  # on a GPU it is three digits in float32
            lowered = eqx.filter_jit(advance).lower(objective, state.carry, *numbers)  # pyright: ignore[reportFunctionMemberAccess]
        self.compiled = lowered.compile()
        estimate(objective.best(state.carry))
        self.compile_seconds = time.perf_counter() - self.created

    def _report(self, state: FitState, estimate: Callable[[], float]) -> bool:
        """Calls the function `progress`, or prints a line for each tenth of the epochs. Whether the
        function ends the training."""
        if self.progress is False:
            return False
        rest = (len(state.networks) - state.present) * self.problem.recipe.epochs
        done, total = state.losses.size + state.done, state.losses.size + rest
        # Before the first epoch there is no loss yet.
        carry = state.carry
        loss = float(carry.losses[state.done - 1] if state.done else carry.criteria[0])
        best = float(carry.best)
        if self.progress is not True:
            return self.progress(done, total, loss, best) is True
        if done == total or done % max(total // 10, 1) == 0:
            epoch = f"epoch {done:>{len(str(total))}} of {total}: loss {loss:.3e}, best {best:.3e}"
            spent = f"{self.elapsed:.0f} s after {self.compile_seconds:.0f} s to compile"
            error = f"estimated error {estimate():.1e}"
            print(epoch, error, spent, sep=", ", file=sys.stderr, flush=True)
        return False
