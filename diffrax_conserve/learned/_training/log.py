"""The log of a training."""

from typing import Any, final

import equinox as eqx
import numpy as np


@final
class FitLog(eqx.Module):
    """The record of a training.

    **Attributes:**

    - `error`: the estimated error of the solution, for each leaf of the state relative to its
        largest component. For a `PINN` it is the largest error in the whole interval; for a flow
        map the root mean square error of its longest step, over states from `sample`. The estimate
        solves the differential equation of the error, driven by the defect. Infinity if no estimate
        is possible or a window was not trained.
    - `errors`: for each window of a `PINN`, the error that this window alone causes.
    - `losses`: the training loss at each epoch, before its update.
    - `checked`, `criteria`: the epochs at which the model was compared with the best so far, and
        the compared values: the loss on the first collocation points with all iterations of the
        conservative layer, so that epochs with different numbers of iterations are comparable. With
        a [`diffrax_conserve.learned.Pool`][] it is the loss on its states for the next epoch, the
        same states for both models.
    - `best_epoch`, `best`: the epoch of the returned model, and its criterion; for several windows
        those of the worst.
    - `skipped`: the number of updates that were not finite. Each was replaced by a return to the
        best model so far, with a new state of the optimiser.
    - `ended`: the reason why the training ended: `"epochs"`, `"target"`, `"seconds"` or
        `"interrupt"`.
    - `seconds`, `compile_seconds`: the wall times of the training and of the compilation.
    - `state`: the state of the training, to continue it by `fit(..., state=log.state)`.
    """

    error: float
    errors: np.ndarray
    losses: np.ndarray
    checked: np.ndarray
    criteria: np.ndarray
    best_epoch: int
    best: float
    skipped: int
    ended: str
    seconds: float
    compile_seconds: float
    state: Any
