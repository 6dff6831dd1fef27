"""What a training tells about itself."""

from typing import Any, final

import equinox as eqx
import numpy as np


@final
class FitLog(eqx.Module):
    """How a training went.

    **Attributes:**

    - `error`: the estimated error of the solution. Each leaf of the state counts relative to its
        largest component. For a `PINN` it is the largest error in the whole interval; for a flow
        map the root mean square of that of its longest step, over states from `sample`. The
        estimate solves the differential equation of the error, which the defect drives. Infinity
        where no estimate could be made, or a window was not trained.
    - `errors`: for each window of a `PINN` the error that it adds by itself.
    - `losses`: the training loss at each epoch, before its update.
    - `checked`, `criteria`: the epochs at which the model was compared with the best so far, and
        what was compared: the loss on the first collocation points with all iterations of the
        conservative layer, so that epochs with different iterations are comparable. With a
        [`diffrax_conserve.learned.Pool`][] it is the loss on its states for the next epoch, the
        same states for both models.
    - `best_epoch`, `best`: the epoch of the model that was returned, and its criterion; of several
        windows those of the worst.
    - `skipped`: how many updates were not finite. Each of them was replaced by a return to the best
        model so far, with a new state of the optimiser.
    - `ended`: what ended the training: `"epochs"`, `"target"`, `"seconds"` or `"interrupt"`.
    - `seconds`, `compile_seconds`: wall times, of the training and of the one compilation.
    - `state`: where the training stopped, for `fit(..., state=log.state)`.
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
