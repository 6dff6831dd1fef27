"""Recipes: the options of a training, and the default one."""

from collections.abc import Callable
from typing import Any, Literal, final

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from ..._options import check_counts, check_number
from ..._tree import tree_size
from .._networks.flat import check_scalars
from .._networks.pinn import PINN
from .._networks.trainable import LayerSchedule, Times
from .second_order import METHODS, Loss, SecondOrder


def mean(squares: Array, typical: Array) -> Float[Array, ""]:
    del typical
    return jnp.mean(squares)


def uniform(key: PRNGKeyArray, count: int, first: Any, last: Any) -> Float[Array, " points"]:
    return jr.uniform(key, (count,), minval=first, maxval=last)


def grid(key: PRNGKeyArray, count: int, first: Any, last: Any) -> Float[Array, " points"]:
    del key
    return jnp.linspace(first, last, count)


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
    optimiser: optax.GradientTransformation | Literal["spring", "levenberg-marquardt"] = eqx.field(
        default_factory=lambda: optax.chain(optax.clip_by_global_norm(1.0), optax.adam(1e-3))
    )
    schedule: Callable[[Array, int, int], LayerSchedule] | None = None
    loss: Loss = mean
    times: Times = uniform
    taylor: int = 0
    refresh: int | None = None
    check_every: int = 50
    retries: int = 0
    damping: float = 1e-2

    def __check_init__(self):
        counts = dict(epochs=self.epochs, points=self.points, check_every=self.check_every)
        check_counts(**counts, refresh=1 if self.refresh is None else self.refresh)
        check_scalars(least=0.0, optional=False, retries=self.retries, taylor=self.taylor)
        check_number("damping", self.damping, above=0.0, optional=False)
        word = isinstance(self.optimiser, str) and self.optimiser in METHODS
        if not word and not isinstance(self.optimiser, optax.GradientTransformation):
            raise TypeError(
                f"`optimiser` is {self.optimiser!r:.200}, but it must be one of optax, or one of "
                f"{', '.join(map(repr, METHODS))}."
            )

    @property
    def method(self) -> optax.GradientTransformation | SecondOrder:
        """What makes the updates."""
        if isinstance(self.optimiser, str):
            return METHODS[self.optimiser](self.damping)
        return self.optimiser


Recipe.__init__.__doc__ = r"""**Arguments:**

- `epochs`: the number of updates; each uses all collocation points.
- `points`: the number of collocation points: times, or pairs of an initial state and a time.
- `optimiser`: any [`optax.GradientTransformation`][], or a [second-order
    method][second-order-methods], `"spring"` or `"levenberg-marquardt"`. Default: Adam at 1e-3 and
    clipping.
- `schedule`: for a conservative layer with `steps`, a function `(epoch, epochs, steps)` of traced
    `epoch` that returns $p$ and $s$. The network is trained through
    $(1 - s) P_{p-1} u + s P_p u$, where $P_k u$ is its output after $k$ iterations. Default: the
    layer is complete in every epoch.
- `loss`: a function from the squared norm $q$ of the defect at each point, and the median of
    $|f|^2$ over the initial states, to the loss. Default: the mean of $q$. With `lambda q, typical:
    jnp.mean(q / (1 + q / typical))` states that change too fast for the network do not dominate.
- `times`: a function `(key, count, first, last)` to times. Default: independent and uniform.
- `taylor`: the order of the polynomial that a [`diffrax_conserve.DeepONet`][] without one gets, if
    the vector field changes slowly enough in the longest step. Default: 0, none.
- `refresh`: the number of epochs after which new points are drawn. Default: never.
- `check_every`: the number of epochs after which the model is compared with the best one so far.
- `retries`: how often a window of a `PINN` that failed is cut in halves.
- `damping`: $\lambda$ of a second-order method: of `"spring"` in units of the loss, of
    `"levenberg-marquardt"` that of the first update.
"""


def second_order(model: eqx.Module, *, epochs: int | None = None) -> Recipe:
    """The default recipe: second-order training, with a method chosen by the size of the network.

    A `PINN` with up to 2,000 weights in each window is trained by `"levenberg-marquardt"` on a grid
    of 120 times, in 40 epochs for each window. A larger one, and every flow map, is trained by
    `"spring"` on 250 fresh points in each of 1,000 epochs.

    **Arguments:**

    - `model`: a [`diffrax_conserve.PINN`][], or a flow map.
    - `epochs`: the number of updates; more reduce the error, down to what the network can do.
    """
    if not isinstance(model, eqx.Module):
        raise TypeError(f"`model` is {model!r}, but it must be the network that is trained.")
    # With 2,000 columns a QR factorisation takes about as long as SPRING's Cholesky factorisation.
    updates = lambda default: default if epochs is None else epochs  # noqa: E731
    if isinstance(model, PINN) and tree_size(model.window(0).net) <= 2000:
        # Up to 1,024 windows in the place of one.
        options: dict[str, Any] = dict(times=grid, check_every=5, retries=10)
        return Recipe(updates(40), 120, "levenberg-marquardt", **options)
    return Recipe(updates(1000), 250, "spring", taylor=1, check_every=20, refresh=1)
