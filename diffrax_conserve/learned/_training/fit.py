"""`fit`: trains a network from the vector field alone."""

import dataclasses
import sys
import time
from collections.abc import Callable
from typing import Any, TypeVar, final

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import PRNGKeyArray

from ..._custom_types import Args, Manifold
from .._networks import PINN, AbstractTrainable, Sampler, as_flow_map, restored
from .arguments import check_arguments, check_pool, check_types
from .defect import VectorField
from .epochs import advance
from .objective import Carry, start
from .pool import Pool, with_domain
from .recipe import Recipe, second_order
from .windows import WindowEnds, with_window

_Model = TypeVar("_Model", bound=eqx.Module)
# Called with the epochs that are done, all epochs, the last loss and the best criterion.
Progress = Callable[[int, int, float, float], None]


@final
class FitLog(eqx.Module):
    """How a training went.

    **Attributes:**

    - `losses`: the training loss at each epoch, before its update.
    - `checked`, `criteria`: the epochs at which the model was compared with the best so far, and
        what was compared: the loss on the first collocation points with all iterations of the
        conservative layer, so that epochs with different iterations are comparable. With a
        [`diffrax_conserve.learned.Pool`][] it is the loss on its states for the next epoch, the
        same states for both models.
    - `best_epoch`, `best`: the epoch of the model that was returned, and its criterion.
    - `skipped`: how many updates were not finite. Each of them was replaced by a return to the best
        model so far, with a new state of the optimiser.
    - `seconds`, `compile_seconds`: wall times, of the training and of the one compilation.
    """

    losses: np.ndarray
    checked: np.ndarray
    criteria: np.ndarray
    best_epoch: int
    best: float
    skipped: int
    seconds: float
    compile_seconds: float


def fit(
    model: _Model,
    vector_field: VectorField,
    *,
    key: PRNGKeyArray,
    sample: Sampler | None = None,
    args: Args = None,
    recipe: Recipe | None = None,
    manifold: Manifold | None = None,
    progress: bool | Progress = False,
) -> tuple[_Model, FitLog]:
    r"""Trains a network from the vector field alone: no solution is needed.

    Minimises the mean over collocation points of $|u'(t) - f(t, u(t))|^2$, where $u$ is the output
    of the network, the time derivative by forward-mode automatic differentiation. For a network
    with a conservative layer $u$ is the output after as many iterations as the recipe's schedule
    says.

    An update that is not finite is not made. The model that is returned is the best that was seen,
    not the last.

    A `PINN` of several windows is trained window by window; each starts where the one before ended,
    moved onto the manifold if one is given.

    **Arguments:**

    - `model`: a [`diffrax_conserve.PINN`][], a [`diffrax_conserve.DeepONet`][], any other
        [`diffrax_conserve.learned.AbstractFlowMap`][], or a Module `(y0, h) -> y` with an attribute
        `max_step`, all of whose arrays are then trained.
    - `vector_field`: $f(t, y, args)$. For a flow map it must not depend on time.
    - `key`: a random key. The same key gives the same result.
    - `sample`: for a flow map, a function from a random key to an initial state, or a
        [`diffrax_conserve.learned.Pool`][], which follows the solutions from there.
    - `args`: passed to `vector_field`.
    - `recipe`: a [`diffrax_conserve.learned.Recipe`][]. Default:
        [`diffrax_conserve.learned.second_order`][]`(model)`.
    - `manifold`: for a `PINN` of several windows, where the ends of the windows are moved to: the
        values of its integrals are those at the initial state. Default: that of its layer.
    - `progress`: whether to print a line on standard error, or a function that is called now and
        then with the number of epochs done, that of all epochs, the last loss and the best
        criterion.

    **Returns:**

    The trained model and a [`diffrax_conserve.learned.FitLog`][].

    **Raises:**

    `ValueError` or `TypeError` before anything is compiled if the arguments do not fit.

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
    check_types(vector_field, key, sample, recipe, progress)
    check_arguments(model, sample, manifold)
    recipe = second_order(model) if recipe is None else recipe
    if isinstance(model, PINN):
        trainer = _Trainer(vector_field, sample, args, recipe, progress, model.windows)
        return _fit_windows(trainer, model, WindowEnds.of(model, manifold, args), key)
    flow_map = as_flow_map(model)
    if isinstance(sample, Pool):
        check_pool(sample, flow_map, args, recipe)
    trainer = _Trainer(vector_field, sample, args, recipe, progress, 1)
    trained, log = trainer.train(flow_map, key)
    return restored(trained, model), log


def _fit_windows(
    trainer: "_Trainer", pinn: PINN, ends: WindowEnds | None, key: PRNGKeyArray
) -> tuple[Any, FitLog]:
    """Trains the windows one after the other."""
    logs = []
    for k in range(pinn.windows):
        window, log = trainer.train(pinn.window(k), key if k == 0 else jr.fold_in(key, k))
        logs.append(log)
        pinn = with_window(pinn, k, window, ends)
    return pinn, _log_of_windows(logs, trainer.recipe.epochs)


@final
@dataclasses.dataclass
class _Trainer:
    """Trains one network after the other, all of the same shape, with one compilation."""

    vector_field: VectorField
    sample: Sampler | None
    args: Args
    recipe: Recipe
    progress: bool | Progress
    count: int
    trained: int = 0
    compiled: Any = None

    def train(self, model: AbstractTrainable, key: PRNGKeyArray) -> tuple[Any, FitLog]:
        recipe = self.recipe
        objective, carry = start(model, self.vector_field, key, self.sample, self.args, recipe)
        begun = time.perf_counter()
        if self.compiled is None:
            arguments = (objective, carry, jnp.asarray(0), jnp.asarray(0))
            compilable = eqx.filter_jit(advance)
            lowered = compilable.lower(*arguments)  # pyright: ignore[reportFunctionMemberAccess]
            self.compiled = lowered.compile()
        compile_seconds = time.perf_counter() - begun
        checked, criteria, done = [], [], 0
        while True:
            # Without an epoch between them, the first round only judges the model as it came.
            stop = min(done + recipe.check_every, recipe.epochs) if checked else 0
            carry, criterion = self.compiled(objective, carry, jnp.asarray(done), jnp.asarray(stop))
            done = stop
            checked.append(done)
            criteria.append(float(criterion))
            before = self.trained * recipe.epochs
            _report(self.progress, done, before, self.count * recipe.epochs, carry)
            if done == recipe.epochs:
                break
        self.trained += 1
        log = FitLog(
            losses=np.asarray(carry.losses),
            checked=np.array(checked),
            criteria=np.array(criteria),
            best_epoch=int(carry.best_epoch),
            best=float(carry.best),
            skipped=int(carry.skipped),
            seconds=time.perf_counter() - begun - compile_seconds,
            compile_seconds=compile_seconds,
        )
        trained = eqx.combine(carry.best_weights, objective.static)
        return with_domain(trained, carry.best_domain), log


def _log_of_windows(logs: list[FitLog], epochs: int) -> FitLog:
    """The log of all windows one after the other; its best is that of the worst window."""
    worst = max(range(len(logs)), key=lambda k: logs[k].best)
    return FitLog(
        losses=np.concatenate([log.losses for log in logs]),
        checked=np.concatenate([k * epochs + log.checked for k, log in enumerate(logs)]),
        criteria=np.concatenate([log.criteria for log in logs]),
        best_epoch=worst * epochs + logs[worst].best_epoch,
        best=logs[worst].best,
        skipped=sum(log.skipped for log in logs),
        seconds=sum(log.seconds for log in logs),
        compile_seconds=sum(log.compile_seconds for log in logs),
    )


def _report(progress: bool | Progress, done: int, before: int, epochs: int, carry: Carry) -> None:
    if progress is False:
        return
    loss = float(carry.losses[max(done - 1, 0)])
    best = float(carry.best)
    done += before
    if progress is not True:
        progress(done, epochs, loss, best)
        return
    # On a terminal one line that is overwritten, in a file one line for every tenth.
    terminal = sys.stderr.isatty()
    if terminal or done == epochs or done % max(epochs // 10, 1) == 0:
        end = "\r" if terminal and done < epochs else "\n"
        text = f"epoch {done:>{len(str(epochs))}} of {epochs}: loss {loss:.3e}, best {best:.3e}"
        print(text, end=end, file=sys.stderr, flush=True)
