"""`fit`: trains a network from the vector field alone, or from data."""

import dataclasses
import math
import time
import warnings
from typing import Any, TypeVar

import equinox as eqx
from jax.sharding import NamedSharding
from jaxtyping import PRNGKeyArray

from ..._custom_types import Args, Manifold
from .._networks.flow_map import AbstractFlowMap
from .._networks.pinn import PINN
from .._networks.wrappers import OfPairs
from .checks import check_types, checked, checked_sharding
from .errors import flow_map_error, warn_off_manifold
from .loop import FitLog, FitState, Loop, Progress
from .objective import Carry, VectorField
from .recipe import Recipe
from .windows import train_windows

_Model = TypeVar("_Model", bound=eqx.Module)


def fit(
    model: _Model,
    vector_field: VectorField | None = None,
    *,
    key: PRNGKeyArray,
    sample: Any = None,
    data: tuple[Any, Any] | None = None,
    args: Args = None,
    recipe: Recipe | None = None,
    manifold: Manifold | None = None,
    state: FitState | None = None,
    target: float | None = None,
    seconds: float | None = None,
    progress: bool | Progress = False,
    sharding: NamedSharding | None = None,
) -> tuple[_Model, FitLog]:
    r"""Trains a network from the vector field alone, or a flow map from data, or from both.

    Minimises the mean over collocation points of $|u'(t) - f(t, u(t))|^2$ for the output $u$ of the
    network, with $u'$ by forward-mode automatic differentiation; of a `DeepONet` each component in
    units of its deviation over the initial states, of a `PINN` each leaf relative to its size. From
    `data` a flow map learns pairs of states along the trajectories, one step of any length apart:
    the loss is that of the differences, each component relative to the root mean square change by a
    step. With a vector field the squared defect is added, relative to the median of $|f|^2$.

    Updates that are not finite are skipped. The best model is returned, not the last. `log.error`
    estimates the error of its solution. A `DeepONet` gets the Taylor polynomial of its recipe.

    A `PINN` is trained window by window; each starts at the end of the previous one, projected to
    the manifold if one is given. A window whose estimated error is too large is cut in halves, as
    often as the recipe's `retries` allow. If the whole solution misses the `target`, the windows
    are trained again, to smaller errors. A warning tells if the solution, or a step, is wrong.

    **Arguments:**

    - `model`: a [`diffrax_conserve.PINN`][], a [`diffrax_conserve.learned.AbstractFlowMap`][] such
        as [`diffrax_conserve.DeepONet`][], or a Module `(y0, h) -> y` with an attribute `max_step`,
        of which all arrays are trained.
    - `vector_field`: $f(t, y, args)$. For a flow map it must not depend on time; with `data` it is
        optional.
    - `key`: a random key. The same key gives the same result.
    - `sample`: for a flow map, initial states, stacked along a leading axis, or a function from a
        random key to one of them. Default: the states of `data`, or else all of the `domain`, if
        that is a [`diffrax_conserve.learned.Box`][].
    - `data`: for a flow map, trajectories `(ts, ys)`, such as those of
        [`diffrax_conserve.learned.trajectories`][]: increasing times of shape `(n, k)`, and states
        with leading axes `(n, k)`.
    - `args`: passed to `vector_field`. Omit them for a flow map that takes `args` itself: they are
        drawn from its `args_domain`, and the states of `data` are pairs `(y, args)`.
    - `recipe`: a [`diffrax_conserve.learned.Recipe`][]. Default:
        [`diffrax_conserve.learned.second_order`][]`(model)`.
    - `manifold`: for a `PINN`, the manifold to which the ends of the windows are projected, with
        the conserved values at the initial state. Default: that of its layer.
    - `state`: the `state` in the log of a training that was stopped, to continue it with otherwise
        the same arguments, or a recipe of more epochs. The result is the same, bit for bit, as
        without the stop, unless the optimiser depends on the number of epochs, as SPRING does. That
        of a flow map [can be kept in a file][stop-go-on-keep].
    - `target`: for a flow map, the loss at which the training ends; default: none. For a `PINN`,
        the accepted error of its solution, relative to its largest component; default: windows are
        cut until it is about 1e-7 (1e-4 in single precision), and above 1e-4 the solution is wrong.
    - `seconds`: ends the training after this wall time, without the compilation.
    - `progress`: whether to print lines on standard error, or a function of the number of epochs
        done, the total number, the last loss and the best criterion, which may return `True` to
        end the training.
    - `sharding`: spreads the collocation points, along their leading axis, over several devices,
        each of which has all weights.

    **Returns:**

    The trained model and a [`diffrax_conserve.learned.FitLog`][].

    **Raises:**

    `ValueError` or `TypeError` before the training if the arguments do not fit, or the vector field
    is not finite at an initial state, or for a flow map depends on time; `FloatingPointError` if no
    update was finite.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax

        jax.config.update("jax_enable_x64", True)
        system = dfc.systems.get("harmonic-oscillator")
        pinn = dfc.PINN(system.y0, 0.0, 10.0, key=jax.random.key(0))
        pinn, log = dfc.fit(pinn, system.vector_field, key=jax.random.key(1))
        assert log.error < 1e-7
        ```

    ??? cite "Reference"

        E. Cardoso-Bihlo and A. Bihlo, arXiv:2311.14131, Algorithm 1.
    """
    created = time.perf_counter()
    check_types(key, recipe, state, progress, target=target, seconds=seconds)
    network, problem = checked(model, vector_field, key, sample, data, args, recipe, manifold)
    problem = dataclasses.replace(problem, sharding=checked_sharding(sharding, problem.recipe))
    target = None if target is None else float(target)
    loop = Loop(problem, key, target, seconds or math.inf, progress, created)
    if isinstance(model, PINN):
        return train_windows(loop, model.rescaled(problem.field), manifold, state)
    trained, log = _train_flow_map(loop, network, state)
    trained: Any = trained.flow_map if isinstance(trained, OfPairs) else trained
    # A function is its own weights.
    return trained if isinstance(model, AbstractFlowMap) else trained.weights(), log


def _train_flow_map(loop: Loop, flow_map: Any, given: FitState | None) -> tuple[Any, FitLog]:
    objective, state = loop.start(loop.begin((flow_map,), given))

    def close_enough(carry: Carry) -> bool:
        return loop.target is not None and float(carry.best) <= loop.target

    def error(network: Any) -> float:
        return flow_map_error(network, loop.problem, loop.key)

    state, carry, ended = loop.train(objective, state, close_enough, error)
    trained = objective.best(carry)
    found = error(trained)
    warn_off_manifold(trained, objective.first_points)
    if not found <= 0.1:  # not one correct digit
        warnings.warn(
            f"The trained flow map is wrong: its longest step has an estimated error of {found:.2g}"
            ". Train it longer, give it a shorter `max_step` or more `width`, and states in which "
            "every component varies, such as those of `learned.reachable_states`.",
            stacklevel=3,
        )
    return trained, loop.log(state, carry, ended, found)
