"""The windows of a PINN: each starts at the end of the previous one, and is judged by its error."""

import dataclasses
import warnings
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
import optimistix as optx
from jaxtyping import Array, PRNGKeyArray

from ..._custom_types import Args, Manifold
from ..._manifold import conserved_values
from ..._projection.project import project
from .._networks import PINN, Window, fresh, initial_slope
from .._networks.flat import flatten
from .._networks.mlp import MLP
from .objective import Objective
from .path_error import relative, window_errors
from .state import FitState, Windows
from .trainer import Trainer

_project = eqx.filter_jit(project)


class WindowEnds(NamedTuple):
    """The manifold to which the ends of the windows are projected."""

    manifold: Manifold
    values: Any
    args: Args

    @classmethod
    def of(cls, pinn: PINN, manifold: Manifold | None, args: Args) -> "WindowEnds | None":
        if manifold is None:
            if pinn.layer is None:
                return None
            manifold, args = pinn.layer.manifold, pinn.layer.args
        return cls(manifold, conserved_values(manifold, pinn.t0, pinn.y0, args), args)

    def __call__(self, t: Array, y: Any) -> Any:
        found, info = _project(self.manifold, y, t=t, args=self.args, value=self.values)
        # The end of a window that has not learned the solution may be too far from the manifold.
        return found if bool(info.result == optx.RESULTS.successful) else y


def windows_of(pinn: PINN) -> Windows:
    """The windows of an untrained network."""
    nets, y0s = jtu.tree_map(np.asarray, (pinn.nets, pinn.y0s))
    count, slope = pinn.windows, initial_slope(pinn.window(0).net)
    errors, halvings = np.full(count, np.inf), np.zeros(count, int)
    return Windows(nets, y0s, np.array(pinn.edges), errors, halvings, slope or 0.0)


def train_windows(
    trainer: Trainer, state: FitState, ends: WindowEnds | None
) -> tuple[FitState, Windows, str]:
    """Trains the windows one after the other; windows that fail are trained again, then in
    halves. If errors grow too much from window to window, they are all trained to a smaller one."""
    objective, _ = trainer.start(_present(trainer, state), state)

    def close(objective: Objective, state: FitState) -> bool:
        window = eqx.combine(state.carry.best_weights, objective.static)
        return trainer.target is not None and _own_error(trainer, state.model, window) <= _limit(
            trainer, state.model, state.windows
        )

    try:
        while not state.finished:
            state, ended = trainer.rounds(objective, state, close, _worst)
            window = eqx.combine(state.carry.best_weights, objective.static)
            judged = _judged(trainer, state, window, ends)
            if ended in ("seconds", "interrupt"):
                # `judged` is returned but not stored in `state`: a continued training judges the
                # window at its end.
                return state, judged, ended
            following = _next(trainer, state, judged)
            if not following.finished:
                objective, carry = trainer.start(_present(trainer, following), following)
                following = dataclasses.replace(following, carry=carry)
            # A single assignment, so that an interrupt leaves a consistent state.
            state = following
            trainer.save(state)
    except KeyboardInterrupt:
        if not state.trained:
            raise
        ended = "interrupt"
    else:
        ended = "epochs"
    assert state.windows is not None
    return state, state.windows, ended


def _present(trainer: Trainer, state: FitState) -> Window:
    """The window that is trained next, with new weights at the second attempt."""
    found = state.windows
    assert found is not None
    k = found.present
    net, y0 = jtu.tree_map(lambda x: jnp.asarray(x[k]), (found.nets, found.y0s))
    if found.attempt:
        key = jr.fold_in(trainer.network_key(state), 1)
        net = _fresh(net, found, int(found.halvings[k]), key)
    return state.model.window_of(net, y0, found.edges[k], found.edges[k + 1])


def _judged(trainer: Trainer, state: FitState, window: Window, ends: WindowEnds | None) -> Windows:
    """All windows, with the present one replaced by `window` if that is better."""
    found = state.windows
    assert found is not None
    k, error = found.present, _own_error(trainer, state.model, window)
    if found.errors[k] <= error:
        return found
    nets, y0s = jtu.tree_map(lambda x, new: _put(x, k, new), found.nets, window.net), found.y0s
    if k + 1 < found.errors.size:
        t = window.start + window.length
        end = window(t)
        end = end if ends is None else ends(t, end)
        y0s = jtu.tree_map(lambda x, new: _put(x, k + 1, new), y0s, end)
    return dataclasses.replace(found, nets=nets, y0s=y0s, errors=_put(found.errors, k, error))


def _next(trainer: Trainer, state: FitState, found: Windows) -> FitState:
    """The state for the next training: the same window again, its first half, the next window, or
    the first that is not accurate enough for the whole solution."""
    k, retries = found.present, trainer.recipe.retries
    limit = _limit(trainer, state.model, found)
    failed = not found.errors[k] <= limit and not found.given_up and retries
    if failed and found.attempt == 0:
        found = dataclasses.replace(found, attempt=1)
    elif failed and found.halvings[k] < retries:
        found = _halved(found, trainer.network_key(state))
    else:
        # After a window that has finally failed, the others start at a wrong state and are not
        # retried.
        found = dataclasses.replace(found, given_up=int(bool(found.given_up or failed)))
        again = None
        if k + 1 < found.errors.size:
            again = dataclasses.replace(found, present=k + 1, attempt=0)
        elif not found.given_up and found.passes < retries:
            again = _tightened(trainer, state.model, found)
        if again is None:
            return dataclasses.replace(state, windows=found, finished=1)
        found = again
    return dataclasses.replace(
        state,
        windows=found,
        past=state.past.and_then(state.carry, state.checked, state.criteria),
        trained=state.trained + 1,
        checked=np.zeros(0, int),
        criteria=np.zeros(0),
    )


def _tightened(trainer: Trainer, given: PINN, found: Windows) -> Windows | None:
    """The windows with a smaller limit, if the solution is right but not within the target."""
    along = _errors_along(trainer, given.cut(found.edges.tolist(), found.nets, found.y0s))
    error, target = max(along), trainer.target
    if target is None or not target < error < _WRONG:
        return None
    tightening = found.tightening * 2 * error / target
    # At least one window is trained again.
    tightening = max(tightening, 2 * _limit(trainer, given) / np.max(found.errors))
    k = int(np.flatnonzero(found.errors > _limit(trainer, given) / tightening)[0])
    errors = found.errors.copy()
    errors[k + 1 :] = np.inf  # these will start elsewhere
    return dataclasses.replace(
        found,
        errors=errors,
        present=k,
        attempt=0,
        passes=found.passes + 1,
        tightening=float(tightening),
    )


def _halved(found: Windows, key: PRNGKeyArray) -> Windows:
    """The windows with the present one cut in halves."""
    k, edges = found.present, found.edges
    net = jtu.tree_map(lambda x: jnp.asarray(x[k]), found.nets)
    depth = int(found.halvings[k]) + 1
    halves = [_fresh(net, found, depth, key) for key in jr.split(jr.fold_in(key, 2))]

    def cut(x: np.ndarray, first: Any, second: Any) -> np.ndarray:
        return np.concatenate([x[:k], np.stack([first, second]), x[k + 1 :]])

    return dataclasses.replace(
        found,
        nets=jtu.tree_map(cut, found.nets, *halves),
        y0s=jtu.tree_map(lambda x: np.insert(x, k, x[k], axis=0), found.y0s),
        edges=np.insert(edges, k + 1, (edges[k] + edges[k + 1]) / 2),
        errors=cut(found.errors, np.inf, np.inf),
        halvings=cut(found.halvings, depth, depth),
        attempt=0,
    )


def _fresh(net: MLP, found: Windows, halvings: int, key: PRNGKeyArray) -> MLP:
    """New weights. In a shorter window the state changes less, and so do the outputs."""
    return fresh(net, found.slope or None, 0.5**halvings, key)


def _put(values: np.ndarray, index: int, value: Any) -> np.ndarray:
    values = values.copy()
    values[index] = value
    return values


def _worst(objective: Objective, state: FitState) -> float:
    """The largest error of the trained windows."""
    del objective
    assert state.windows is not None
    errors = state.windows.errors
    return float(np.max(errors, where=np.isfinite(errors), initial=0))


def _limit(trainer: Trainer, given: PINN, found: Windows | None = None) -> float:
    """The error of a single window above which it has failed."""
    if trainer.target is None:
        return _WRONG
    tightening = 1.0 if found is None else found.tightening
    return trainer.target / (_GROWTH * given.windows * tightening)


# A solution with a larger error than this, relative to its largest component, counts as wrong.
_WRONG = 1e-4
# A safety factor: errors of windows add up, and later windows may amplify them.
_GROWTH = 4


def _own_error(trainer: Trainer, pinn: PINN, window: Window) -> float:
    """The largest error of a window alone, relative to the larger of the solution in it and the
    initial state."""
    none = jnp.zeros_like(pinn.scale)
    assert trainer.vector_field is not None
    found = window_errors(window, trainer.vector_field, trainer.args, none, trainer.substeps)
    size = np.maximum(np.asarray(found.size[0]), np.abs(np.asarray(flatten(pinn.y0))))
    return relative(found.largest[0], size, pinn.y0)


def _errors_along(trainer: Trainer, pinn: PINN) -> list[float]:
    """The largest error of the solution in each window, with what earlier windows add to it."""
    error, largest, sizes = jnp.zeros_like(pinn.scale), [], []
    assert trainer.vector_field is not None
    for k in range(pinn.windows):
        window = pinn.window(k)
        found = window_errors(window, trainer.vector_field, trainer.args, error, trainer.substeps)
        largest.append(np.asarray(found.largest[1]))
        sizes.append(np.asarray(found.size[1]))
        if k + 1 < pinn.windows:
            # The next window starts at another state, but the exact solution is continuous.
            end = flatten(window(window.start + window.length))
            error = found.end[1] + end - flatten(pinn.window(k + 1).y0)
    size = np.max(sizes, axis=0)
    return [relative(e, size, pinn.y0) for e in largest]


def solution_error(trainer: Trainer, given: PINN, pinn: PINN, found: Windows) -> float:
    """The largest error in the whole interval, with a warning if it is not small."""
    along = _errors_along(trainer, pinn)
    wrong = trainer.target if trainer.target is not None else _WRONG
    if not max(along) <= wrong:
        _warn(pinn, found.errors, along, _limit(trainer, given, found), wrong)
    return max(along)


def _warn(pinn: PINN, errors: np.ndarray, along: list[float], limit: float, wrong: float) -> None:
    """Warns, with the window that is wrong and its error."""
    failed = np.flatnonzero(~(errors <= limit))
    k = int(failed[0]) if failed.size else int(np.argmax(along))
    first, last = pinn.edges[k], pinn.edges[k + 1]
    if np.isinf(errors[k]):
        fault = "was not trained, or its error cannot be estimated"
    elif failed.size:
        fault = f"has an estimated error of {errors[k]:.2g} by itself"
    else:
        fault = "is where errors of earlier windows have grown largest"
    warnings.warn(
        f"The trained `PINN` is not the solution: its estimated error is {max(along):.2g} of the "
        f"largest component, above {wrong:.2g}. Window {k} of {pinn.windows}, from {first:.6g} to "
        f"{last:.6g}, {fault}. Use more windows, more `width` or more `epochs`, or a recipe with "
        "`retries`.",
        stacklevel=4,
    )
