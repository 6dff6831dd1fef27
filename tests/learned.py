"""Small networks that several test files share. Untrained: their laws hold for every weight."""

import functools as ft
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

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


class Rotation(eqx.Module):
    """The exact flow map of a spring of some stiffness, but for an error in proportion to the step;
    with `bend` = -1 its derivative by the stiffness points the wrong way at 1."""

    off: float = 0.0
    bend: float = 1.0
    max_step: float = 0.5
    args_domain: Any = None

    def __call__(self, y0, *step):
        *stiffness, h = step
        w = jnp.sqrt(1 + self.bend * (stiffness[0] - 1)) if stiffness else 1.0
        c, s = jnp.cos(w * h), jnp.sin(w * h)
        return jnp.stack([c * y0[0] + s / w * y0[1], c * y0[1] - w * s * y0[0]]) + self.off * h


def turning(t1=3.0, unit=1.0, **options):
    """A PINN for `oscillator` from the east."""
    sizes = dict(width=12, depth=1, slope=2.0, key=jr.key(0))
    return dfc.PINN(unit * EAST, 0.0, t1, **(sizes | options))


def error_of_turning(pinn, unit=1.0):
    ts = jnp.linspace(pinn.t0, pinn.t1, 400)
    exact = jnp.stack([jnp.cos(ts), -jnp.sin(ts)], axis=1)
    return float(jnp.max(jnp.abs(jax.jit(jax.vmap(pinn))(ts) / unit - exact)))


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


VORTICES, FOUR = (
    dfc.systems.PointVortices(),
    dfc.systems.PointVortices(strengths=(1.0, 2.0, 3.0, -1.0)),
)
CONSERVING = dfc.learned.ConservativeLayer(LORENZ.manifold, steps=4)
# All that a file can hold, each at least once.
SAVED = {
    "pinn": lambda: solution(activation="sin", windows=3, slope=2.0, layer=CONSERVING),
    "any state": lambda: dfc.PINN(
        {"a": (jnp.ones(2), [jnp.zeros((2, 1), jnp.float32), None]), "b": jnp.array(2.0)},
        0.0, 1.0, key=jr.key(0), **SMALL,
    ),
    "system with parameters": lambda: dfc.DeepONet(
        states(4, FOUR), 0.5, key=jr.key(0), layer=dfc.learned.ConservativeLayer(FOUR.manifold)
    ),
    "deeponet": lambda: flow_map(depth=3),
    "gated": lambda: flow_map(core="gated", taylor=dfc.learned.Taylor(LORENZ.vector_field, 2)),
    "concatenated": lambda: flow_map(
        core="concatenated", taylor=dfc.learned.Taylor(LORENZ.vector_field), layer=CONSERVING
    ),
    "framed": lambda: dfc.learned.Repeated(
        dfc.DeepONet(
            states(9, VORTICES), 0.5, frame=VORTICES.frame, key=jr.key(0),
            taylor=dfc.learned.Taylor(VORTICES.vector_field), **SMALL,
        ),
        3,
    ),
    "family": lambda: dfc.learned.Repeated(
        dfc.learned.Transformed(
            flow_map(args_domain=dfc.learned.Box({"a": 0.5}, {"a": jnp.array(1.5)})),
            dfc.learned.BoxCox(0.125),
        ),
        2,
    ),
    "single": lambda: in_single(saved("deeponet")),
    "half": lambda: jax.tree.map(lambda x: x.astype(jnp.bfloat16), saved("deeponet")),
}  # fmt: skip


@ft.cache
def saved(name):
    """With other numbers in each array, so that nothing is compiled. A later array, as an upper
    bound, has larger ones."""
    leaves, structure = jax.tree.flatten(eqx.filter_eval_shape(SAVED[name]))
    rng = np.random.default_rng(0)
    made = [
        jnp.asarray(i + rng.random(x.shape), x.dtype) if hasattr(x, "dtype") else x
        for i, x in enumerate(leaves, 1)
    ]
    return jax.tree.unflatten(structure, made)
