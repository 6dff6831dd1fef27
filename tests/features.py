"""Problems for `RandomFeatureSolver` that several test files share."""

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import numpy as np

import diffrax_conserve as dfc

from .learned import oscillator as oscillator

EIGHT = dfc.RandomFeatureSolver(8)


def solve(vector_field, y0, t1, *, t0=0.0, dt0=None, tol=None, **kwargs):
    """Compiled once for all times and tolerances."""
    numbers = [None if x is None else jnp.asarray(x) for x in (t1, t0, dt0, tol)]
    return compiled(vector_field, y0, *numbers, **kwargs)


@eqx.filter_jit
def compiled(vector_field, y0, t1, t0, dt0, tol, *, solver=EIGHT, args=None, **kwargs):
    if tol is not None:
        kwargs["stepsize_controller"] = dfx.PIDController(rtol=tol, atol=tol)
    kwargs.setdefault("max_steps", 512)
    return dfx.diffeqsolve(dfx.ODETerm(vector_field), solver, t0, t1, dt0, y0, args, **kwargs)


NORTH = jnp.array([1.0, 0.3])


def oscillation(t):
    c, s = np.cos(t), np.sin(t)
    return np.stack([c + 0.3 * s, 0.3 * c - s], axis=-1)


def lorenz(t, y, args):
    x, y, z = y
    return jnp.stack([10 * (y - x), x * (28 - z) - y, x * y - 8 / 3 * z])
