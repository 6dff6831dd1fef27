"""The networks and the recipe of the paper, to compare with: the defaults are more accurate.

E. Cardoso-Bihlo and A. Bihlo, arXiv:2311.14131.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from .._custom_types import RealScalarLike, Y
from ._networks.deeponet import DeepONet
from ._networks.pinn import PINN
from ._networks.trainable import LayerSchedule
from ._training.recipe import Recipe


def pinn(y0: Y, t0: RealScalarLike, t1: RealScalarLike, **options: Any) -> PINN:
    """A [`diffrax_conserve.PINN`][] of the paper's size, one window of four layers of 40 units,
    with its other arguments."""
    sizes: dict[str, Any] = dict(windows=1, width=40, depth=4, slope=None)
    return PINN(y0, t0, t1, **(sizes | options))


def deeponet(states: Y, max_step: RealScalarLike, **options: Any) -> DeepONet:
    """A [`diffrax_conserve.DeepONet`][] of the paper's kind and size, 20 products of a branch and a
    trunk for each component, both of four layers of 40 units, with its other arguments."""
    sizes: dict[str, Any] = dict(core="product", width=40, depth=4, latent=20)
    return DeepONet(states, max_step, **(sizes | options))


def recipe(
    model: eqx.Module, *, epochs: int = 5000, points: int | None = None, as_printed: bool = False
) -> Recipe:
    """The recipe of the paper, with changes where it fails as published.

    From the paper: Adam at 1e-3, 5,000 full-batch epochs, 2,000 times for a PINN, and for a flow
    map 5,000 pairs of an initial state and a time and the projection schedule. Changed: a PINN is
    projected from the first epoch on; the weight of the last iteration rises within each stage; the
    loss of a flow map is bounded at each point, and normalised; gradients are clipped.

    **Arguments:**

    - `model`: a [`diffrax_conserve.PINN`][], or a flow map.
    - `epochs`, `points`: as for [`diffrax_conserve.learned.Recipe`][].
    - `as_printed`: whether to make none of these changes. Give the network a layer
        `ConservativeLayer(manifold, steps=P, as_printed=True)` too.
    """
    if points is None:
        points = 2000 if isinstance(model, PINN) else 5000
    if as_printed:
        return Recipe(epochs, points, optax.adam(1e-3), schedule=_printed)
    if isinstance(model, PINN):
        return Recipe(epochs=epochs, points=points, schedule=_projected)
    return Recipe(epochs=epochs, points=points, schedule=_staged, loss=_bounded)


def _printed(epoch: Array, epochs: int, steps: int) -> LayerSchedule:
    return jnp.minimum(steps, epoch * (steps + 1) // epochs), epoch / epochs


def _staged(epoch: Array, epochs: int, steps: int) -> LayerSchedule:
    """No iteration of the layer at first and one more in each stage, with a weight that rises from
    0 to 1, so that the trained function is continuous."""
    position = epoch * (steps + 1) / epochs
    p = jnp.minimum(steps, epoch * (steps + 1) // epochs)
    return p, position - jnp.minimum(jnp.floor(position), steps)


def _projected(epoch: Array, epochs: int, steps: int) -> LayerSchedule:
    """All iterations from the first epoch on, the last one with the weight of `_staged`."""
    return jnp.full_like(epoch, steps), _staged(epoch, epochs, steps)[1]


def _bounded(squares: Array, typical: Array) -> Float[Array, ""]:
    """The mean of `q / (1 + q / typical)`: a point contributes at most the median of `|f|²`."""
    return jnp.mean(squares / (1 + squares / jnp.where(typical > 0, typical, 1)))
