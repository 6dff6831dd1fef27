"""The windows of a PINN: each starts at the end of the previous one, and is judged by its error.

A window whose error is too large is cut in halves, which are trained from new weights. So the
windows become short where the solution changes fast, as the steps of an adaptive solver do.
"""

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
from .._networks.flat import flatten
from .._networks.mlp import MLP, fresh, initial_slope
from .._networks.pinn import PINN, Window
from .errors import PathErrors, relative, window_errors
from .loop import FitLog, Loop
from .state import FitState, Windows

_project = eqx.filter_jit(project)
# A solution with a larger error than this, relative to its largest component, counts as wrong.
_WRONG = 1e-4
# The error that is aimed at without a `target`; in single precision `_WRONG`.
_AIM = 1e-7
# A safety factor: errors of windows add up, and later windows may amplify them.
_GROWTH = 20
# The number of times that all windows may be trained again, to smaller errors.
_PASSES = 3


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


def train_windows(
    loop: Loop, pinn: PINN, manifold: Manifold | None, given: FitState | None
) -> tuple[Any, FitLog]:
    """Trains the windows one after the other, and estimates the error of the whole solution."""
    ends = WindowEnds.of(pinn, manifold, loop.problem.args)
    count = pinn.windows
    nets, y0s = jtu.tree_map(np.asarray, (pinn.nets, pinn.y0s))
    windows = Windows(nets, y0s, np.array(pinn.edges), np.full(count, np.inf))
    state = loop.begin(pinn, pinn.window(0), windows, given)
    given_pinn, ended = state.model, "epochs"

    def own(window: Window) -> float:
        return _own_error(loop, given_pinn, window)

    found, carry = state.windows, state.carry
    while not state.finished:
        assert found is not None
        objective, first = loop.start(_window(given_pinn, found, found.present), state)
        if state.done < 0:
            state = dataclasses.replace(state, carry=first)
        limit = float(_limits(loop, given_pinn, found)[found.present])
        state, carry, ended = loop.train(
            objective,
            state,
            lambda carry, of=objective, limit=limit: own(of.best(carry)) <= limit,
            own,
        )
        found = _judged(loop, given_pinn, found, objective.best(carry), ends)
        if ended in ("seconds", "interrupt"):
            # `found` is returned but not stored in `state`: a continued training judges the
            # window at its end.
            break
        state = _next(loop, state, found)
        found, ended = state.windows, "epochs"
        loop.save(state)
    assert found is not None
    loop.save(state, always=True)
    along = _errors_along(loop, given_pinn, found)
    trained = given_pinn.cut(found.edges.tolist(), found.nets, found.y0s)
    if not max(along) <= _wrong(loop):
        _warn(loop, given_pinn, found, along)
    if ended == "epochs" and loop.target is not None and max(along) <= loop.target:
        ended = "target"
    return trained, loop.log(state, carry, ended, max(along), found.errors)


def _window(pinn: PINN, found: Windows, k: int) -> Window:
    net, y0 = jtu.tree_map(lambda x: jnp.asarray(x[k]), (found.nets, found.y0s))
    return pinn.window_of(net, y0, found.edges[k], found.edges[k + 1])


def _judged(
    loop: Loop, pinn: PINN, found: Windows, window: Window, ends: WindowEnds | None
) -> Windows:
    """All windows, with the present one replaced by `window` if that is better."""
    k, error = found.present, _own_error(loop, pinn, window)
    if found.errors[k] <= error:
        return found
    nets, y0s = jtu.tree_map(lambda x, new: _put(x, k, new), found.nets, window.net), found.y0s
    if k + 1 < found.errors.size:
        t, end = _end(window)
        end = end if ends is None else ends(t, end)
        y0s = jtu.tree_map(lambda x, new: _put(x, k + 1, new), y0s, end)
    return dataclasses.replace(found, nets=nets, y0s=y0s, errors=_put(found.errors, k, error))


def _next(loop: Loop, state: FitState, found: Windows) -> FitState:
    """The state for the next training: of the first half of the window, of the next window, or of
    the first that is not accurate enough for the whole solution."""
    k, pinn = found.present, state.model
    retries, length = loop.problem.recipe.retries, found.edges[k + 1] - found.edges[k]
    failed = ~(found.errors <= _limits(loop, pinn, found))
    # After a window that has finally failed the others start at a wrong state.
    lost = bool(np.any(failed[:k]))
    shortest = (pinn.t1 - pinn.t0) / pinn.windows / 2**retries
    following: Windows | None = None
    if failed[k] and not lost and retries and length > 1.5 * shortest:
        following = _halved(loop, state, found)
    elif k + 1 < failed.size:
        following = dataclasses.replace(found, present=k + 1)
    elif not lost and not failed[k] and retries and found.passes < _PASSES:
        following = _tightened(loop, pinn, found)
    if following is None:
        return dataclasses.replace(state, windows=found, finished=1)
    return dataclasses.replace(state.closed(), windows=following)


def _halved(loop: Loop, state: FitState, found: Windows) -> Windows:
    """The windows with the present one cut in halves."""
    k, edges, pinn = found.present, found.edges, state.model
    middle = (edges[k] + edges[k + 1]) / 2
    net = jtu.tree_map(lambda x: jnp.asarray(x[k]), found.nets)
    # In a shorter window the state changes less, and so do the outputs.
    size = (middle - edges[k]) * pinn.windows / (pinn.t1 - pinn.t0)

    def half(key: PRNGKeyArray) -> MLP:
        new = fresh(net, initial_slope(pinn.window(0).net), 1.0, key)
        return eqx.tree_at(lambda net: net.weights[-1], new, size * new.weights[-1])

    halves = [half(key) for key in jr.split(jr.fold_in(loop.network_key(state), 2))]

    def cut(x: np.ndarray, first: Any, second: Any) -> np.ndarray:
        return np.concatenate([x[:k], np.stack([first, second]), x[k + 1 :]])

    return dataclasses.replace(
        found,
        nets=jtu.tree_map(cut, found.nets, *halves),
        y0s=jtu.tree_map(lambda x: np.insert(x, k, x[k], axis=0), found.y0s),
        edges=np.insert(edges, k + 1, middle),
        errors=cut(found.errors, np.inf, np.inf),
    )


def _tightened(loop: Loop, pinn: PINN, found: Windows) -> Windows | None:
    """The windows with smaller limits, if the solution is about right but not accurate enough."""
    error, aim = max(_errors_along(loop, pinn, found)), _aim(loop, pinn)
    if not aim < error < 100 * _WRONG:
        return None
    limits = _limits(loop, pinn, found)
    # At least one window is trained again.
    factor = max(2 * error / aim, 2 * float(np.min(limits / found.errors)))
    k = int(np.flatnonzero(found.errors > limits / factor)[0])
    errors = found.errors.copy()
    errors[k:] = np.inf  # these will start elsewhere
    return dataclasses.replace(
        found,
        errors=errors,
        present=k,
        passes=found.passes + 1,
        tightening=found.tightening * factor,
    )


def _put(values: np.ndarray, index: int, value: Any) -> np.ndarray:
    values = values.copy()
    values[index] = value
    return values


def _wrong(loop: Loop) -> float:
    """The error above which a solution is wrong."""
    return _WRONG if loop.target is None else loop.target


def _aim(loop: Loop, pinn: PINN) -> float:
    if loop.target is not None:
        return loop.target
    return _AIM if pinn.scale.dtype == jnp.float64 else _WRONG


def _limits(loop: Loop, pinn: PINN, found: Windows) -> np.ndarray:
    """For each window the error above which it has failed, in proportion to its length."""
    aim = _aim(loop, pinn) if loop.problem.recipe.retries else _wrong(loop)
    share = np.diff(found.edges) / (pinn.t1 - pinn.t0)
    return share * aim / (_GROWTH * found.tightening)


def _own_error(loop: Loop, pinn: PINN, window: Window) -> float:
    """The largest error of a window alone, relative to the larger of the solution in it and the
    initial state."""
    found = _path_errors(loop, window, jnp.zeros_like(pinn.scale))
    size = np.maximum(np.asarray(found.size[0]), np.abs(np.asarray(flatten(pinn.y0))))
    return relative(found.largest[0], size, pinn.y0)


def _errors_along(loop: Loop, pinn: PINN, found: Windows) -> list[float]:
    """The largest error of the solution in each window, with what earlier windows add to it."""
    error, largest, sizes, end = jnp.zeros_like(pinn.scale), [], [], None
    for k in range(found.errors.size):
        window = _window(pinn, found, k)
        if end is not None:
            # The window starts at another state, but the exact solution is continuous.
            error = error + flatten(end) - flatten(window.y0)
        path = _path_errors(loop, window, error)
        largest.append(np.asarray(path.largest[0]))
        sizes.append(np.asarray(path.size[0]))
        error, (_, end) = path.end[0], _end(window)
    size = np.max(sizes, axis=0)
    return [relative(e, size, pinn.y0) for e in largest]


def _path_errors(loop: Loop, window: Window, initial: Array) -> PathErrors:
    problem = loop.problem
    assert problem.vector_field is not None
    substeps = 2 * problem.recipe.points
    return window_errors(window, problem.vector_field, problem.args, initial, substeps)


@eqx.filter_jit
def _end(window: Window) -> tuple[Array, Any]:
    t = window.start + window.length
    return t, window(t)


def _warn(loop: Loop, pinn: PINN, found: Windows, along: list[float]) -> None:
    """Warns, with the window that is wrong and its error."""
    errors = found.errors
    failed = np.flatnonzero(~(errors <= _limits(loop, pinn, found)))
    k = int(failed[0]) if failed.size else int(np.argmax(along))
    first, last = found.edges[k], found.edges[k + 1]
    if np.isinf(errors[k]):
        fault = "was not trained, or its error cannot be estimated"
    elif failed.size:
        fault = f"has an estimated error of {errors[k]:.2g} by itself"
    else:
        fault = "is where errors of earlier windows have grown largest"
    warnings.warn(
        f"The trained `PINN` is not the solution: its estimated error is {max(along):.2g} of the "
        f"largest component, above {_wrong(loop):.2g}. Window {k} of {errors.size}, from "
        f"{first:.6g} to {last:.6g}, {fault}. Use more windows, more `width` or more `epochs`, or "
        "a recipe with `retries`.",
        stacklevel=4,
    )
