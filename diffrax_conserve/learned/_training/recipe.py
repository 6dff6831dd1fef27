"""Recipes: the options of a training, the default one and that of the paper."""

from collections.abc import Callable
from typing import final

import equinox as eqx
import optax
from jaxtyping import Array

from ..._options import check_number
from ..._tree import tree_size
from .._networks.pinn import PINN
from .._networks.trainable import Times
from .loss import Bounded, Loss, mean_square
from .schedule import every_iteration, ramped_weight, staged_iterations
from .second_order import SPRING, LevenbergMarquardt, SecondOrder
from .times import grid_times, uniform_times

Schedule = Callable[[Array, int, int], Array]


@final
class Recipe(eqx.Module):
    """The options of a training by [`diffrax_conserve.fit`][]. Every part can be replaced.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import optax

        recipe = dfc.learned.Recipe(epochs=500, points=100, optimiser=optax.adam(3e-3), refresh=100)
        ```
    """

    epochs: int = 5000
    points: int = 2000
    optimiser: optax.GradientTransformation | SecondOrder = eqx.field(
        default_factory=lambda: optax.adam(1e-3)
    )
    iterations: Schedule = staged_iterations
    weight: Schedule = ramped_weight
    loss: Loss = mean_square
    times: Times = uniform_times
    refresh: int | None = None
    max_gradient_norm: float | None = 1.0
    check_every: int = 50
    retries: int = 0

    def __check_init__(self):
        for name in ("epochs", "points", "check_every"):
            if not getattr(self, name) >= 1:
                raise ValueError(f"`{name}` must be at least 1, but is {getattr(self, name)}.")
        check_number("max_gradient_norm", self.max_gradient_norm, above=0.0)
        if not isinstance(self.optimiser, optax.GradientTransformation | SecondOrder):
            raise TypeError(
                f"`optimiser` is {self.optimiser!r}, but it must be an optimiser of optax, such as "
                "`optax.adam(1e-3)`, or `diffrax_conserve.learned.SPRING()` or "
                "`LevenbergMarquardt()`."
            )
        for name in ("iterations", "weight", "loss", "times"):
            if not callable(getattr(self, name)):
                raise TypeError(f"`{name}` is {getattr(self, name)!r}, not a function.")
        if self.retries < 0:
            raise ValueError(f"`retries` must not be negative, but is {self.retries}.")
        if self.refresh is not None and self.refresh < 1:
            raise ValueError(f"`refresh` must be at least 1, or `None`, but is {self.refresh}.")


Recipe.__init__.__doc__ = r"""**Arguments:**

- `epochs`: the number of updates; each uses all collocation points.
- `points`: the number of collocation points: times, or pairs of an initial state and a time.
- `optimiser`: any [`optax.GradientTransformation`][], [`diffrax_conserve.learned.SPRING`][] or
    [`diffrax_conserve.learned.LevenbergMarquardt`][].
- `iterations`, `weight`: the projection schedule, for a network with a conservative layer:
    functions of the epoch (traced), the number of epochs and the number of iterations in the layer,
    which return $p$ and $s$. The network is trained through $(1 - s) P_{p-1} u + s P_p u$, where
    $P_k u$ is its output after $k$ iterations. Defaults: `staged_iterations` and `ramped_weight`.
- `loss`: a function from the squared norm of the defect at each point, and the median of $|f|^2$
    over the initial states, to the loss: `mean_square`, `Bounded()`, or your own.
- `times`: the distribution of times: `uniform_times`, `grid_times`, or your own function.
- `refresh`: the number of epochs after which new points are drawn. Default: never.
- `max_gradient_norm`: longer gradients are scaled to this norm; `None` for no limit. Not used by
    second-order methods, which have a damping instead.
- `check_every`: the number of epochs after which the model is compared with the best one so far.
- `retries`: how often a failed window of a `PINN` is cut in halves. Before each cut it is trained
    again from other weights. With 0 windows are judged but not retrained.
"""


def second_order(model: eqx.Module, *, epochs: int | None = None) -> Recipe:
    """The default recipe: second-order training, with a method chosen by the size of the network.

    A `PINN` with up to 2,000 weights in each window is trained by
    [`diffrax_conserve.learned.LevenbergMarquardt`][] on a grid of 120 times, in 40 epochs for each
    window. A larger one, and every flow map, is trained by [`diffrax_conserve.learned.SPRING`][] on
    250 fresh points in each of 2,000 epochs.

    **Arguments:**

    - `model`: a [`diffrax_conserve.PINN`][], or a flow map.
    - `epochs`: the number of updates. The error decreases with it, down to the approximation error
        of the network.
    """
    if isinstance(model, PINN) and tree_size(model.window(0).net) <= _LEVENBERG_MARQUARDT_MAX:
        return Recipe(
            epochs=40 if epochs is None else epochs,
            points=120,
            optimiser=LevenbergMarquardt(),
            iterations=every_iteration,
            times=grid_times,
            check_every=5,
            retries=4,
        )
    return Recipe(
        epochs=2000 if epochs is None else epochs,
        points=250,
        optimiser=SPRING(),
        iterations=every_iteration,
        refresh=1,
        check_every=20,
    )


# With this many columns its QR factorisation takes about as long as SPRING's Cholesky
# factorisation.
_LEVENBERG_MARQUARDT_MAX = 2000


def paper(model: eqx.Module, *, epochs: int = 5000, points: int | None = None) -> Recipe:
    """The recipe of the paper, with changes where it fails as published.

    From the paper: Adam at 1e-3, 5,000 full-batch epochs, 2,000 times for a PINN, and for a flow
    map 5,000 pairs of an initial state and a time and the projection schedule.

    Changed: a PINN is projected from the first epoch on; the weight of the last iteration rises
    within each stage; the loss of a flow map is bounded at each point; gradients are clipped. "The
    paper, reproduced" gives the reason and the effect of each.

    **Arguments:**

    - `model`: a [`diffrax_conserve.PINN`][], or a flow map.
    - `epochs`, `points`: as for [`diffrax_conserve.learned.Recipe`][].

    ??? cite "Reference"

        E. Cardoso-Bihlo and A. Bihlo, arXiv:2311.14131, Algorithm 1.
    """
    if isinstance(model, PINN):
        points = 2000 if points is None else points
        return Recipe(epochs=epochs, points=points, iterations=every_iteration)
    return Recipe(epochs=epochs, points=5000 if points is None else points, loss=Bounded())
