"""The windows of a PINN: each starts at the end of the previous one, and has an error of its own.

A window whose error is too large is cut in halves, which are trained from new weights. So the
windows become short where the solution changes fast, as the steps of an adaptive solver do.
"""

import dataclasses
import warnings
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
import optimistix as optx
from jaxtyping import Array, PRNGKeyArray

from ..._custom_types import Manifold
from ..._manifold import conserved_values
from ..._projection.project import project
from .._networks.cores import fresh, initial_slope
from .._networks.flat import flatten
from .._networks.pinn import PINN, Window
from .._networks.trainable import Points
from .errors import relative, roundoff, warn_off_manifold, window_errors
from .loop import FitLog, FitState, Loop

# Without a `target`: the error above which a solution is wrong, relative to its largest component,
# and the one that is aimed at in double precision.
_WRONG, _AIM = 1e-4, 1e-7
# A safety factor: errors of windows add up, and later windows may amplify them.
_GROWTH = 20
# The number of times that all windows may be trained again, to smaller errors.
_PASSES = 3


def train_windows(
    loop: Loop, pinn: PINN, manifold: Manifold | None, given: FitState | None
) -> tuple[Any, FitLog]:
    """Trains the windows one after the other, and estimates the error of the whole solution."""
    windows = _Windows(loop, pinn, manifold)
    state = loop.begin(tuple(map(pinn.window, range(pinn.windows))), given)
    state = state if given else dataclasses.replace(state, first=pinn.window(0))
    # Compiled here, so that it takes no time of the training.
    windows.errors_along(windows.halved(state))
    shown, carry, ended = state, state.carry, "epochs"
    try:
        while not state.finished:
            objective, state = loop.start(state)
            limit = windows.limits(state)[state.present]
            state, carry, ended = loop.train(
                objective,
                state,
                lambda carry, of=objective, limit=limit: windows.own_error(of.best(carry)) <= limit,
                windows.own_error,
            )
            shown = windows.improved(state, objective.best(carry))
            if ended in ("seconds", "interrupt", "progress"):
                # A continued training decides about the window at its end.
                break
            state, ended = windows.next(shown), "epochs"
            shown = state
    except KeyboardInterrupt:
        if not state.trained:
            raise
        ended = "interrupt"
    along = windows.errors_along(shown)
    for window in shown.networks if pinn.layer is not None else ():
        ts = jnp.linspace(window.start, window.start + window.length, loop.problem.recipe.points)
        warn_off_manifold(window, Points(ts, None))
    if not max(along) <= windows.wrong:
        windows.warn(shown, along)
    if ended == "epochs" and loop.target is not None and max(along) <= loop.target:
        ended = "target"
    nets, y0s = jtu.tree_map(
        lambda *xs: jnp.stack(xs), *[(window.net, window.y0) for window in shown.networks]
    )
    trained = pinn.cut(windows.edges(shown).tolist(), nets, y0s)
    return trained, loop.log(state, carry, ended, max(along), shown.errors)


@final
@dataclasses.dataclass
class _Windows:
    """What is done with the windows of `pinn`, which are the networks of a state."""

    loop: Loop
    pinn: PINN
    manifold: Manifold | None

    def __post_init__(self):
        target, double = self.loop.target, self.pinn.scale.dtype == jnp.float64
        self.wrong: float = target or _WRONG
        self.aim: float = (target or _AIM) if double else self.wrong
        self.retries: int = self.loop.problem.recipe.retries

    def edges(self, state: FitState) -> np.ndarray:
        return np.array([*(float(window.start) for window in state.networks), self.pinn.t1])

    def limits(self, state: FitState) -> np.ndarray:
        """For each window the error above which it has failed, in proportion to its length."""
        share = np.diff(self.edges(state)) / (self.pinn.t1 - self.pinn.t0)
        return share * (self.aim if self.retries else self.wrong) / (_GROWTH * state.tightening)

    def own_error(self, window: Window) -> float:
        """The largest error of a window alone, relative to the solution or the initial state."""
        found = window_errors(window, self.loop.problem, jnp.zeros_like(self.pinn.scale))
        size = np.maximum(np.asarray(found.size[0]), np.abs(np.asarray(flatten(self.pinn.y0))))
        return relative(found.largest[0], size, self.pinn.y0)

    def errors_along(self, state: FitState) -> list[float]:
        """The largest error of the solution in each window, with what earlier windows add to it."""
        error, end, paths = jnp.zeros_like(self.pinn.scale), self.pinn.y0, []
        for window in state.networks:
            # A window may start at another state. The solution is continuous, but for roundoff.
            error = error + flatten(end) - flatten(window.y0) + jnp.spacing(flatten(end)) / 2
            path = window_errors(window, self.loop.problem, error)
            error, (_, end) = path.end[0], _end(window)
            rounded = roundoff(window, self.loop.problem.recipe.points)
            paths.append(path._replace(largest=path.largest + rounded))
        size = np.max([np.asarray(path.size[0]) for path in paths], axis=0)
        return [relative(path.largest[0], size, self.pinn.y0) for path in paths]

    def improved(self, state: FitState, window: Window) -> FitState:
        """The state with `window` in the place of the present one, if that is better."""
        k, error = state.present, self.own_error(window)
        if state.errors[k] <= error:
            return state
        state = _replaced(state, k, [window], [error])
        if k + 1 < len(state.networks):
            y0 = self.placed(*_end(window))
            following = eqx.tree_at(lambda w: w.y0, state.networks[k + 1], y0)
            state = _replaced(state, k + 1, [following], [state.errors[k + 1]])
        return state

    def placed(self, t: Array, y: Any) -> Any:
        """The end of a window, projected to the manifold through the initial state."""
        manifold, args, layer = self.manifold, self.loop.problem.args, self.pinn.layer
        if manifold is None:
            if layer is None:
                return y
            manifold, args = layer.manifold, layer.args
        return _projected(manifold, args, self.pinn.t0, self.pinn.y0, t, y)

    def next(self, state: FitState) -> FitState:
        """The state for the training of the first half of the window, of the next window, or of the
        first that is not accurate enough for the whole solution."""
        k = state.present
        failed = ~(np.array(state.errors) <= self.limits(state))
        # After a window that has finally failed the others start at a wrong state.
        lost = bool(np.any(failed[:k]))
        shortest = 1.5 * state.first.length / 2**self.retries
        following: FitState | None = None
        if failed[k] and not lost and self.retries and state.networks[k].length > shortest:
            following = self.halved(state)
        elif k + 1 < failed.size:
            following = dataclasses.replace(state, present=k + 1)
        elif not lost and not failed[k] and self.retries and state.passes < _PASSES:
            following = self.tightened(state)
        return dataclasses.replace(state, finished=1) if following is None else following.closed()

    def halved(self, state: FitState) -> FitState:
        """The state with the present window cut in halves, of new weights."""
        k, pinn = state.present, self.pinn
        window, (first, last) = state.networks[k], self.edges(state)[k : k + 2]
        middle = (first + last) / 2
        # In a shorter window the state changes less, and so do the outputs.
        size, slope = (middle - first) / state.first.length, initial_slope(state.first.net)

        def half(key: PRNGKeyArray, first: float, last: float) -> Window:
            return pinn.window_of(fresh(window.net, slope, size, key), window.y0, first, last)

        first_key, second_key = jr.split(jr.fold_in(self.loop.network_key(state), 2))
        halves = [half(first_key, first, middle), half(second_key, middle, last)]
        return _replaced(state, k, halves, [np.inf, np.inf])

    def tightened(self, state: FitState) -> FitState | None:
        """The state with smaller limits, if the solution is about right but not accurate enough."""
        error = max(self.errors_along(state))
        if not self.aim < error < 100 * _WRONG:
            return None
        limits, errors = self.limits(state), np.array(state.errors)
        # At least one window is trained again, and those after it, which start elsewhere.
        factor = max(2 * error / self.aim, 2 * float(np.min(limits / errors)))
        k = int(np.flatnonzero(errors > limits / factor)[0])
        errors[k:] = np.inf
        return dataclasses.replace(
            state,
            errors=tuple(errors.tolist()),
            present=k,
            passes=state.passes + 1,
            tightening=state.tightening * factor,
        )

    def warn(self, state: FitState, along: list[float]) -> None:
        """Names the first window that failed, or else the one with the largest error."""
        errors, edges = np.array(state.errors), self.edges(state)
        failed = np.flatnonzero(~(errors <= self.limits(state)))
        k = int(failed[0]) if failed.size else int(np.argmax(along))
        warnings.warn(
            f"The trained `PINN` is not the solution: its estimated error is {max(along):.2g} of "
            f"the largest component, above {self.wrong:.2g}. Window {k} of {errors.size}, from "
            f"{edges[k]:.6g} to {edges[k + 1]:.6g}, has an estimated error of {errors[k]:.2g} by "
            "itself. Use more windows, more `width` or more `epochs`, or a recipe with `retries`. "
            "Put quantities of unlike units into different leaves.",
            stacklevel=4,
        )


def _replaced(state: FitState, k: int, windows: list[Window], errors: list[float]) -> FitState:
    networks, old = list(state.networks), list(state.errors)
    networks[k : k + 1], old[k : k + 1] = windows, errors
    return dataclasses.replace(state, networks=tuple(networks), errors=tuple(old))


@eqx.filter_jit
def _projected(manifold: Manifold, args: Any, t0: float, y0: Any, t: Array, y: Any) -> Any:
    values = conserved_values(manifold, t0, y0, args)
    found, info = project(manifold, y, t=t, args=args, value=values)
    # The end of a window that has not learned the solution may be too far from the manifold.
    good = info.result == optx.RESULTS.successful
    return jtu.tree_map(lambda a, b: jnp.where(good, a, b), found, y)


@eqx.filter_jit
def _end(window: Window) -> tuple[Array, Any]:
    t = window.start + window.length
    return t, window(t)
