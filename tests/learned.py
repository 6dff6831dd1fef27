"""Small networks that several test files share. Untrained: their laws hold for every weight."""

import jax
import jax.numpy as jnp
import jax.random as jr

import diffrax_conserve as dfc

LORENZ = dfc.systems.ConservativeLorenz()
SMALL = dict(width=8, depth=2)


def states(count=50, system=LORENZ, seed=7):
    return jax.vmap(system.sample)(jr.split(jr.key(seed), count))


def flow_map(max_step=0.25, layer=None, seed=0, **options):
    return dfc.DeepONet(
        states(), max_step, key=jr.key(seed), latent=4, layer=layer, **(SMALL | options)
    )


def solution(t1=2.0, layer=None, seed=0, **options):
    return dfc.PINN(LORENZ.y0, 0.0, t1, key=jr.key(seed), layer=layer, **(SMALL | options))


def oscillator(t, y, args):
    del t, args
    return jnp.stack([y[1], -y[0]])


RADIUS = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))
EAST = jnp.array([1.0, 0.0])
