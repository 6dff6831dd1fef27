"""The windows of a PINN: each starts at the end of the previous one, and is judged by its error.

A window whose error is too large is cut in halves, which are trained from new weights. So the
windows become short where the solution changes fast, as the steps of an adaptive solver do.
"""

import dataclasses
import warnings
from collections.abc import Callable
from typing import Any

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
from .._networks.flat import flatten
from .._networks.mlp import fresh, initial_slope
from .._networks.pinn import PINN, Window
from .errors import relative, window_errors
from .loop import FitLog, Loop
from .state import FitState

_project = eqx.filter_jit(project)
# A solution with a larger error than this, relative to its largest component, counts as wrong.
_WRONG = 1e-4
# The error that is aimed at without a `target`; in single precision `_WRONG`.
_AIM = 1e-7
# A safety factor: errors of windows add up, and later windows may amplify them.
_GROWTH = 20
# The number of times that all windows may be trained again, to smaller errors.
_PASSES = 3


def train_windows(
    loop: Loop, pinn: PINN, manifold: Manifold | None, given: FitState | None
) -> tuple[Any, FitLog]:
    """Trains the windows one after the other, and estimates the error of the whole solution."""
    place = _projection(loop, pinn, manifold)
    state = loop.begin(tuple(map(pinn.window, range(pinn.windows))), given)
    # Compiled here, so that it takes no time of the training.
    _errors_along(loop, pinn, _halved(loop, pinn, state))
    shown, carry, ended = state, state.carry, "epochs"

    def own(window: Window) -> float:
        return _own_error(loop, pinn, window)

    try:
        while not state.finished:
            objective, state = loop.start(state)
            limit = _limits(loop, pinn, state)[state.present]
            state, carry, ended = loop.train(
                objective,
                state,
                lambda carry, of=objective, limit=limit: own(of.best(carry)) <= limit,
                own,
            )
            window = objective.best(carry)
            shown = _judged(state, window, own(window), place)
            if ended in ("seconds", "interrupt"):
                # A continued training judges the window at its end.
                break
            state, ended = _next(loop, pinn, shown), "epochs"
            shown = state
            loop.save(state)
    except KeyboardInterrupt:
        if not state.trained:
            raise
        ended = "interrupt"
    loop.save(state, always=True)
    along = _errors_along(loop, pinn, shown)
    if not max(along) <= _wrong(loop):
        _warn(loop, pinn, shown, along)
    if ended == "epochs" and loop.target is not None and max(along) <= loop.target:
        ended = "target"
    nets, y0s = jtu.tree_map(
        lambda *xs: jnp.stack(xs), *[(window.net, window.y0) for window in shown.networks]
    )
    trained = pinn.cut(_edges(pinn, shown).tolist(), nets, y0s)
    return trained, loop.log(state, carry, ended, max(along), shown.errors)


def _edges(pinn: PINN, state: FitState) -> np.ndarray:
    return np.array([*(float(window.start) for window in state.networks), pinn.t1])


def _projection(loop: Loop, pinn: PINN, manifold: Manifold | None) -> Callable[[Array, Any], Any]:
    """The projection of the ends of windows to the manifold through the initial state."""
    args = loop.problem.args
    if manifold is None:
        if pinn.layer is None:
            return lambda t, y: y
        manifold, args = pinn.layer.manifold, pinn.layer.args
    values = conserved_values(manifold, pinn.t0, pinn.y0, args)

    def projected(t: Array, y: Any) -> Any:
        found, info = _project(manifold, y, t=t, args=args, value=values)
        # The end of a window that has not learned the solution may be too far from the manifold.
        return found if bool(info.result == optx.RESULTS.successful) else y

    return projected


def _replaced(state: FitState, k: int, windows: list[Window], errors: list[float]) -> FitState:
    """The state with these windows in the place of as many of its own, from the `k`th on."""
    networks, old = list(state.networks), list(state.errors)
    networks[k : k + 1], old[k : k + 1] = windows, errors
    return dataclasses.replace(state, networks=tuple(networks), errors=tuple(old))


def _judged(
    state: FitState, window: Window, error: float, place: Callable[[Array, Any], Any]
) -> FitState:
    """The state with `window` in the place of the present one, if that is better."""
    k = state.present
    if state.errors[k] <= error:
        return state
    state = _replaced(state, k, [window], [error])
    if k + 1 < len(state.networks):
        y0 = place(*_end(window))
        following = eqx.tree_at(lambda w: w.y0, state.networks[k + 1], y0)
        state = _replaced(state, k + 1, [following], [state.errors[k + 1]])
    return state


def _next(loop: Loop, pinn: PINN, state: FitState) -> FitState:
    """The state for the next training: of the first half of the window, of the next window, or of
    the first that is not accurate enough for the whole solution."""
    k, retries = state.present, loop.problem.recipe.retries
    failed = ~(np.array(state.errors) <= _limits(loop, pinn, state))
    # After a window that has finally failed the others start at a wrong state.
    lost = bool(np.any(failed[:k]))
    shortest = (pinn.t1 - pinn.t0) / pinn.windows / 2**retries
    following: FitState | None = None
    if failed[k] and not lost and retries and state.networks[k].length > 1.5 * shortest:
        following = _halved(loop, pinn, state)
    elif k + 1 < failed.size:
        following = dataclasses.replace(state, present=k + 1)
    elif not lost and not failed[k] and retries and state.passes < _PASSES:
        following = _tightened(loop, pinn, state)
    return dataclasses.replace(state, finished=1) if following is None else following.closed()


def _halved(loop: Loop, pinn: PINN, state: FitState) -> FitState:
    """The state with the present window cut in halves, of new weights."""
    k = state.present
    window, edges = state.networks[k], _edges(pinn, state)[k : k + 2]
    middle = edges.mean()
    # In a shorter window the state changes less, and so do the outputs.
    size = float(middle - edges[0]) * pinn.windows / (pinn.t1 - pinn.t0)

    def half(key: PRNGKeyArray, first: float, last: float) -> Window:
        net = fresh(window.net, initial_slope(pinn.window(0).net), 1.0, key)
        net = eqx.tree_at(lambda net: net.weights[-1], net, size * net.weights[-1])
        return pinn.window_of(net, window.y0, first, last)

    first_key, second_key = jr.split(jr.fold_in(loop.network_key(state), 2))
    halves = [half(first_key, edges[0], middle), half(second_key, middle, edges[1])]
    return _replaced(state, k, halves, [np.inf, np.inf])


def _tightened(loop: Loop, pinn: PINN, state: FitState) -> FitState | None:
    """The state with smaller limits, if the solution is about right but not accurate enough."""
    error, aim = max(_errors_along(loop, pinn, state)), _aim(loop, pinn)
    if not aim < error < 100 * _WRONG:
        return None
    limits, errors = _limits(loop, pinn, state), np.array(state.errors)
    # At least one window is trained again, and those after it, which start elsewhere.
    factor = max(2 * error / aim, 2 * float(np.min(limits / errors)))
    k = int(np.flatnonzero(errors > limits / factor)[0])
    errors[k:] = np.inf
    return dataclasses.replace(
        state,
        errors=tuple(errors.tolist()),
        present=k,
        passes=state.passes + 1,
        tightening=state.tightening * factor,
    )


def _wrong(loop: Loop) -> float:
    """The error above which a solution is wrong."""
    return _WRONG if loop.target is None else loop.target


def _aim(loop: Loop, pinn: PINN) -> float:
    if loop.target is not None:
        return loop.target
    return _AIM if pinn.scale.dtype == jnp.float64 else _WRONG


def _limits(loop: Loop, pinn: PINN, state: FitState) -> np.ndarray:
    """For each window the error above which it has failed, in proportion to its length."""
    aim = _aim(loop, pinn) if loop.problem.recipe.retries else _wrong(loop)
    share = np.diff(_edges(pinn, state)) / (pinn.t1 - pinn.t0)
    return share * aim / (_GROWTH * state.tightening)


def _own_error(loop: Loop, pinn: PINN, window: Window) -> float:
    """The largest error of a window alone, relative to the larger of the solution in it and the
    initial state."""
    found = window_errors(window, loop.problem, jnp.zeros_like(pinn.scale))
    size = np.maximum(np.asarray(found.size[0]), np.abs(np.asarray(flatten(pinn.y0))))
    return relative(found.largest[0], size, pinn.y0)


def _errors_along(loop: Loop, pinn: PINN, state: FitState) -> list[float]:
    """The largest error of the solution in each window, with what earlier windows add to it."""
    error, largest, sizes, end = jnp.zeros_like(pinn.scale), [], [], pinn.y0
    for window in state.networks:
        # The window may start at another state, but the exact solution is continuous.
        error = error + flatten(end) - flatten(window.y0)
        path = window_errors(window, loop.problem, error)
        largest.append(np.asarray(path.largest[0]))
        sizes.append(np.asarray(path.size[0]))
        error, (_, end) = path.end[0], _end(window)
    size = np.max(sizes, axis=0)
    return [relative(e, size, pinn.y0) for e in largest]


@eqx.filter_jit
def _end(window: Window) -> tuple[Array, Any]:
    t = window.start + window.length
    return t, window(t)


def _warn(loop: Loop, pinn: PINN, state: FitState, along: list[float]) -> None:
    """Warns, with the window that is wrong and its error."""
    errors, edges = np.array(state.errors), _edges(pinn, state)
    failed = np.flatnonzero(~(errors <= _limits(loop, pinn, state)))
    k = int(failed[0]) if failed.size else int(np.argmax(along))
    if np.isinf(errors[k]):
        fault = "was not trained, or its error cannot be estimated"
    elif failed.size:
        fault = f"has an estimated error of {errors[k]:.2g} by itself"
    else:
        fault = "is where errors of earlier windows have grown largest"
    warnings.warn(
        f"The trained `PINN` is not the solution: its estimated error is {max(along):.2g} of the "
        f"largest component, above {_wrong(loop):.2g}. Window {k} of {errors.size}, from "
        f"{edges[k]:.6g} to {edges[k + 1]:.6g}, {fault}. Use more windows, more `width` or more "
        "`epochs`, or a recipe with `retries`.",
        stacklevel=4,
    )
