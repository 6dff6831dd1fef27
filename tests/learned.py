"""Small networks that several test files share. Untrained: their laws hold for every weight."""

import functools as ft
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr

import diffrax_conserve as dfc

LORENZ = dfc.systems.ConservativeLorenz()
SMALL = dict(width=8, depth=2)
CORES = "product", "concatenated", "gated"


@eqx.filter_jit
def samples(system, keys):
    """Compiled once for each system and number."""
    return jax.vmap(system.sample)(keys)


def states(count=50, system=LORENZ, seed=7):
    return samples(system, jr.split(jr.key(seed), count))


def flow_map(max_step=0.25, layer=None, seed=0, **options):
    return dfc.DeepONet(
        states(), max_step, key=jr.key(seed), latent=4, layer=layer, **(SMALL | options)
    )


def solution(t1=2.0, layer=None, seed=0, **options):
    return dfc.PINN(LORENZ.y0, 0.0, t1, key=jr.key(seed), layer=layer, **(SMALL | options))


def oscillator(t, y, args):
    del t, args
    return jnp.stack([y[1], -y[0]])


def in_single(network):
    """Evaluated in single precision."""
    core = jax.tree.map(lambda x: x.astype(jnp.float32), network.core)
    return eqx.tree_at(lambda m: m.core, network, core)


RADIUS = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))
EAST = jnp.array([1.0, 0.0])


# Their slopes are not those of any vector field.
unchecked = ft.partial(dfc.DeepONetSolver, check_field=False)


class Still(eqx.Module):
    """The worst flow map: nothing moves. Its error in one step is of first order in the step."""

    max_step: float = 1.0

    def __call__(self, y0, h):
        return jax.tree.map(lambda x: x + 0 * h, y0)


class Within(eqx.Module):
    """A flow map that knows its domain."""

    flow_map: Any
    domain: Any

    @property
    def max_step(self):
        return self.flow_map.max_step

    def __call__(self, y0, h):
        return self.flow_map(y0, h)


class Scale(eqx.Module):
    """States in other units."""

    scale: jax.Array

    def __call__(self, y):
        return y / self.scale

    def inverse(self, z):
        return z * self.scale


def driven(t, y, args):
    """A forced pendulum of square frequency `args`: nonlinear, not autonomous, a PyTree."""
    return {"angle": y["rate"], "rate": -args * jnp.sin(y["angle"]) + jnp.cos(3 * t)}


DRIVEN0 = {"angle": jnp.array(1.0), "rate": jnp.array([0.3])[0]}
