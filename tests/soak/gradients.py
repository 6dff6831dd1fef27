"""Attack: derivatives on nearly circular orbits, where two gradients are nearly parallel.

Eccentricities from 0 to 0.1, forward and reverse, through a few steps of a projected solve, whose
error is small. The oracle is the derivative of an accurate solve without projection; NaN is right
too, but not where the gradients are far from parallel.
"""

import functools
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import diffrax_conserve as dfc

from .oracle import Tally, log_uniform

LANES, TIMEOUT = 500, 600
STEPS, TOLERANCE, FAR = 3, 1e-3, 1e-2
MODES = ["simplified", "newton"]


def invariants(t: Any, y: Any, args: Any) -> Any:
    h = 0.5 * (y[2] ** 2 + y[3] ** 2) - 1 / jnp.sqrt(y[0] ** 2 + y[1] ** 2)
    return jnp.stack([h, y[0] * y[3] - y[1] * y[2]])


def field(t: Any, y: Any, args: Any) -> Any:
    return jnp.concatenate([y[2:], -y[:2] / jnp.sum(y[:2] ** 2) ** 1.5])


@functools.cache
def compiled(mode: str) -> Any:
    """Of `(state, dt, tangent, cotangent)` per lane: success, the derivative along the tangent, the
    product of both with it; and the same of the flow."""
    projection = dfc.Newton() if mode == "newton" else dfc.SimplifiedNewton()
    projected = dfc.ManifoldProjection(
        dfc.RK4(), dfc.FirstIntegral(invariants), projection=projection
    )

    def end(y0: Any, dt: Any, solver: Any, adjoint: Any) -> Any:
        sol = dfx.diffeqsolve(
            dfx.ODETerm(field), solver, 0.0, STEPS * dt, dt, y0, adjoint=adjoint, throw=False
        )
        return sol.ys[-1], dfx.is_okay(sol.result)

    def both(y0: Any, dt: Any, tangent: Any, cotangent: Any) -> Any:
        forward, reverse = dfx.ForwardMode(), dfx.RecursiveCheckpointAdjoint()
        _, push, okay = jax.jvp(
            lambda y: end(y, dt, projected, forward), (y0,), (tangent,), has_aux=True
        )
        _, pull, _ = jax.vjp(lambda y: end(y, dt, projected, reverse), y0, has_aux=True)
        _, flow, _ = jax.jvp(
            lambda y: end(y, dt, dfx.Dopri8(), forward), (y0,), (tangent,), has_aux=True
        )
        return okay, push, pull(cotangent)[0] @ tangent, flow

    return jax.jit(jax.vmap(both))


def run(seed: int, number: int, lanes: int) -> Tally:
    rng = np.random.default_rng([seed, number])
    mode = MODES[(seed + number) % len(MODES)]
    e = log_uniform(rng, 1e-12, 0.1, lanes) * (rng.random(lanes) < 0.9)
    y0 = np.stack([1 - e, 0 * e, 0 * e, np.sqrt((1 + e) / (1 - e))], axis=1)
    dt = rng.uniform(0.02, 0.05, lanes)
    tangent, cotangent = rng.normal(size=(2, lanes, 4))
    okay, push, product, flow = map(np.asarray, compiled(mode)(y0, dt, tangent, cotangent))
    size = np.linalg.norm(flow, axis=1)
    forward = np.linalg.norm(push - flow, axis=1) / size
    reverse = np.abs(product - np.sum(cotangent * flow, axis=1)) / size
    reverse /= np.linalg.norm(cotangent, axis=1)
    tally = Tally(lanes, int(okay.sum()))

    def show(i: int) -> str:
        errors = f"errors {forward[i]:.2g}, {reverse[i]:.2g}"
        return f"e = {e[i]}: {errors}, {dt[i]}, {tangent[i]}, {cotangent[i]}"

    for way, error in (("forward", forward), ("reverse", reverse)):
        unknown = np.isnan(error)
        tally.notes[f"{mode}, {way}: NaN"] += int((okay & unknown).sum())
        tally.blame(f"{mode}, {way}", okay & (error > TOLERANCE), show)
        tally.blame(f"{mode}, {way}: NaN where it is known", okay & unknown & (e > FAR), show)
    return tally
