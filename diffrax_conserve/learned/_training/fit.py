"""`fit`: trains a network from the vector field alone, or from data."""

import dataclasses
import math
import os
import time
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PRNGKeyArray

from ..._custom_types import Args, Manifold
from .._networks import (
    PINN,
    OfPairs,
    PairField,
    PairSampler,
    Sampler,
    args_domain_of,
    as_flow_map,
    restored,
)
from .arguments import (
    check_arguments,
    check_family,
    check_field,
    check_limits,
    check_pool,
    check_types,
)
from .data import as_data
from .defect import VectorField
from .log import FitLog
from .objective import Objective
from .path_error import data_error, step_error
from .pool import Pool, with_domain
from .progress import Progress
from .recipe import Recipe, second_order
from .state import FitState, Past, continued, fingerprint, read_checkpoint
from .trainer import Trainer
from .windows import WindowEnds, solution_error, train_windows, windows_of

_Model = TypeVar("_Model", bound=eqx.Module)


def fit(
    model: _Model,
    vector_field: VectorField | None = None,
    *,
    key: PRNGKeyArray,
    sample: Sampler | None = None,
    data: tuple[Any, Any] | None = None,
    args: Args = None,
    recipe: Recipe | None = None,
    manifold: Manifold | None = None,
    state: FitState | None = None,
    target: float | None = None,
    seconds: float | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    progress: bool | Progress = False,
) -> tuple[_Model, FitLog]:
    r"""Trains a network from the vector field alone, or a flow map from data, or from both.

    Minimises the mean over collocation points of $|u'(t) - f(t, u(t))|^2$, where $u$ is the output
    of the network, the time derivative by forward-mode automatic differentiation. For a network
    with a conservative layer $u$ is the output after as many iterations as the recipe's schedule
    says.

    From `data` a flow map learns what becomes of states. Pairs of them, one step of any length
    apart, are drawn along the trajectories. The loss is that of the differences, each component
    relative to the root mean square of what steps change. Together with a vector field the squared
    defect is added, relative to the median of $|f|^2$.

    An update that is not finite is not made. The model that is returned is the best that was seen,
    not the last. `log.error` estimates the error of its solution.

    A `PINN` of several windows is trained window by window; each starts where the one before ended,
    moved onto the manifold if one is given. Each is judged by its estimated error. One that failed
    is trained again from other weights, and then in halves, as often as the recipe's `retries` say.
    If the solution is still wrong, a warning names the window and the error.

    A training can stop and go on. It stops after the recipe's epochs, at a `target`, after
    `seconds`, or by an interrupt from the keyboard, and returns the best model so far. With
    `state=log.state` and the same other arguments the next call goes on where it stopped, and with
    a `checkpoint` another process does, with the same result, bit for bit, as without the stop. A
    finished training goes on with a recipe of more epochs; its result is that of all epochs at once
    if the optimiser does not depend on their number, as that of SPRING does.

    **Arguments:**

    - `model`: a [`diffrax_conserve.PINN`][], a [`diffrax_conserve.DeepONet`][], any other
        [`diffrax_conserve.learned.AbstractFlowMap`][], or a Module `(y0, h) -> y` with an attribute
        `max_step`, all of whose arrays are then trained.
    - `vector_field`: $f(t, y, args)$. For a flow map it must not depend on time, and with `data` it
        may be left out.
    - `key`: a random key. The same key gives the same result.
    - `sample`: for a flow map, a function from a random key to an initial state, or a
        [`diffrax_conserve.learned.Pool`][], which follows the solutions from there.
    - `data`: for a flow map, trajectories `(ts, ys)`: times of shape `(n, k)`, increasing along
        each trajectory and perhaps unequal, and states with leading axes `(n, k)`.
        [`diffrax_conserve.learned.trajectories`][] makes some. With a vector field and without
        `sample` its states are those of the collocation points too.
    - `args`: passed to `vector_field`. Left out for a flow map that takes `args` itself: they are
        drawn from its `args_domain`, and the states of `data` are then pairs `(y, args)`.
    - `recipe`: a [`diffrax_conserve.learned.Recipe`][]. Default:
        [`diffrax_conserve.learned.second_order`][]`(model)`.
    - `manifold`: for a `PINN` of several windows, where the ends of the windows are moved to: the
        values of its integrals are those at the initial state. Default: that of its layer.
    - `state`: the `state` of the log of a training that is to go on.
    - `target`: ends the training of a flow map whose loss is at most this. For a `PINN` it is the
        estimated error that its solution shall have, relative to its largest component. Default:
        all epochs are made, and a solution with an error above 1e-4 is wrong.
    - `seconds`: ends the training after this wall time.
    - `checkpoint`: a file that holds the state of the training. It is replaced now and then; if it
        exists, the training goes on from it.
    - `progress`: whether to print a line on standard error, or a function that is called now and
        then with the number of epochs done, that of all epochs, the last loss and the best
        criterion.

    **Returns:**

    The trained model and a [`diffrax_conserve.learned.FitLog`][].

    **Raises:**

    `ValueError` or `TypeError` before the training if the arguments do not fit, among them a vector
    field that is not finite at an initial state, or that depends on time though a flow map cannot;
    `FloatingPointError` if no update was finite.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax

        system = dfc.systems.get("harmonic-oscillator")
        pinn = dfc.PINN(system.y0, 0.0, 1.0, width=10, depth=2, key=jax.random.key(0))
        recipe = dfc.learned.paper(pinn, epochs=200, points=50)
        pinn, log = dfc.fit(pinn, system.vector_field, key=jax.random.key(1), recipe=recipe)
        print(f"loss {log.best:.0e} at epoch {log.best_epoch}")
        ```

        ```text
        loss 5e-03 at epoch 200
        ```

    ??? cite "Reference"

        E. Cardoso-Bihlo and A. Bihlo, arXiv:2311.14131, Algorithm 1.
    """
    check_types(vector_field, key, sample, data, recipe, progress)
    check_arguments(model, sample, data, manifold)
    check_limits(state, target, seconds)
    recipe = second_order(model) if recipe is None else recipe
    flow_map = None if isinstance(model, PINN) else as_flow_map(model)
    if flow_map is not None and (domain := args_domain_of(flow_map)) is not None:
        check_family(sample, args)
        flow_map = OfPairs(flow_map)
        vector_field = None if vector_field is None else PairField(vector_field)
        sample = None if sample is None else PairSampler(sample, domain)
    found = None if data is None or flow_map is None else as_data(data, flow_map)
    if found is not None and vector_field is not None and sample is None:
        sample = found.sample
    trainer = Trainer(
        vector_field,
        sample,
        found,
        args,
        recipe,
        key,
        None if target is None else float(target),
        math.inf if seconds is None else seconds,
        progress,
        None if checkpoint is None else Path(checkpoint),
        fingerprint(model, key, recipe),
    )
    if isinstance(model, PINN):
        return _fit_windows(trainer, model, manifold, state)
    assert flow_map is not None
    if isinstance(sample, Pool):
        check_pool(sample, flow_map, args, recipe)
    trained, log = _fit_flow_map(trainer, flow_map, state)
    trained = trained.flow_map if isinstance(trained, OfPairs) else trained
    return restored(trained, model), log


def _fit_windows(
    trainer: Trainer, pinn: PINN, manifold: Manifold | None, given: FitState | None
) -> tuple[Any, FitLog]:
    ends = WindowEnds.of(pinn, manifold, trainer.args)
    state = _first(trainer, pinn, given)
    state, found, ended = train_windows(trainer, state, ends)
    trainer.save(state, always=True)
    trained = pinn.cut(found.edges.tolist(), found.nets, found.y0s)
    error = solution_error(trainer, pinn, trained, found.errors)
    if ended == "epochs" and trainer.target is not None and error <= trainer.target:
        ended = "target"
    return trained, _log(trainer, state, ended, error, found.errors)


def _fit_flow_map(trainer: Trainer, flow_map: Any, given: FitState | None) -> tuple[Any, FitLog]:
    state = _first(trainer, flow_map, given)
    objective, _ = trainer.start(state.model, state)

    def close(objective: Objective, state: FitState) -> bool:
        del objective
        return trainer.target is not None and float(state.carry.best) <= trainer.target

    def trained(objective: Objective, state: FitState) -> Any:
        best = eqx.combine(state.carry.best_weights, objective.static)
        return with_domain(best, state.carry.best_domain)

    def error(objective: Objective, state: FitState) -> float:
        network, field = trained(objective, state), trainer.vector_field
        if field is None:
            assert trainer.data is not None
            return data_error(network, trainer.data, trainer.key)
        assert trainer.sample is not None
        return step_error(network, field, trainer.args, trainer.sample, trainer.key)

    ended = "epochs"
    if not state.finished:
        state, ended = trainer.rounds(objective, state, close, error)
        state = dataclasses.replace(state, finished=int(state.done >= trainer.recipe.epochs))
    trainer.save(state, always=True)
    return trained(objective, state), _log(trainer, state, ended, error(objective, state))


def _first(trainer: Trainer, model: Any, given: FitState | None) -> FitState:
    """The state that a training begins with: a given one, that of a checkpoint, or a new one."""
    network = model.window(0) if isinstance(model, PINN) else model
    recipe, (points_key, _) = trainer.recipe, jr.split(trainer.key)
    if trainer.vector_field is not None:
        points = network.draw(recipe.times, trainer.sample, recipe.points, points_key)
        check_field(network, trainer.vector_field, trainer.args, points)
    _, carry = trainer.start(network, None)
    carry = jtu.tree_map(lambda x: jnp.astype(x, x.dtype), carry)
    windows = windows_of(model) if isinstance(model, PINN) else None
    nothing = np.zeros(0, int), np.zeros(0)
    first = FitState(model, carry, *nothing, Past.empty(), windows=windows)
    if given is not None:
        return continued(given, trainer.recipe.epochs, first)
    if trainer.checkpoint is not None and trainer.checkpoint.exists():
        found = read_checkpoint(trainer.checkpoint, first, trainer.mark)
        return found if found.finished else continued(found, trainer.recipe.epochs, first)
    return first


def _log(trainer: Trainer, state: FitState, ended: str, error: float, errors: Any = ()) -> FitLog:
    past = state.past.and_then(state.carry, state.checked, state.criteria)
    return FitLog(
        error=error,
        errors=np.asarray(errors),
        losses=past.losses,
        checked=past.checked,
        criteria=past.criteria,
        best_epoch=past.best_epoch,
        best=past.best,
        skipped=past.skipped,
        ended=ended,
        seconds=time.perf_counter() - trainer.begun - trainer.compile_seconds,
        compile_seconds=trainer.compile_seconds,
        state=state,
    )
