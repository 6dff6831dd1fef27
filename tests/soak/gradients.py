"""Attack: derivatives on nearly circular orbits, where two gradients are nearly parallel.

Eccentricities from 0 to 0.1, forward and reverse, through `project` and through three steps of a
solve. The oracle is the finite difference of a projection in long double (`kepler`), both of the
nearest point and of the plane of the frozen gradients: an implicit rule may use either. Where
roundoff of the conserved values decides how eccentric the manifold is, what counts is the level of
the state that was returned, or the circle; and where roundoff of that state leaves open what the
derivative is (`undetermined`), NaN or something within the spread is right. For a solve the
difference over 1e-4, that of the flow, is right too: at e = 0 the discrete map has no derivative.
"""

import functools
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

import diffrax_conserve as dfc

from . import kepler
from .oracle import Tally, log_uniform, long

LANES, TIMEOUT = 500, 600
STEPS, TOLERANCE, EPS = 3, 1e-3, 2.0**-52
MODES = ["project simplified", "project newton", "solve simplified", "solve newton"]


def invariants(t: Any, y: Any, args: Any) -> Any:
    h = 0.5 * (y[2] ** 2 + y[3] ** 2) - 1 / jnp.sqrt(y[0] ** 2 + y[1] ** 2)
    return jnp.stack([h, y[0] * y[3] - y[1] * y[2]])


def field(t: Any, y: Any, args: Any) -> Any:
    return jnp.concatenate([y[2:], -y[:2] / jnp.sum(y[:2] ** 2) ** 1.5])


@functools.cache
def compiled(mode: str) -> Any:
    """Of `(state, value or dt, tangent, tangent of the value, cotangent)` per lane: all states,
    success, the derivative along the tangent, and the cotangent's product with it."""
    projection = dfc.Newton() if mode.endswith("newton") else dfc.SimplifiedNewton()
    manifold = dfc.FirstIntegral(invariants)

    def project(z: Any, value: Any, _: Any) -> Any:
        y, info = dfc.project(manifold, z, value=value, projection=projection)
        return y, (y[None], info.result == optx.RESULTS.successful)

    def solve(z: Any, dt: Any, adjoint: Any) -> Any:
        sol = dfx.diffeqsolve(
            dfx.ODETerm(field),
            dfc.ManifoldProjection(dfc.RK4(), manifold, projection=projection),
            0.0,
            STEPS * dt,
            dt,
            z,
            saveat=dfx.SaveAt(steps=True),
            stepsize_controller=dfx.ConstantStepSize(),
            max_steps=STEPS + 1,
            adjoint=adjoint,
            throw=False,
        )
        ys = sol.ys[:STEPS]
        return ys[-1], (ys, sol.result == dfx.RESULTS.successful)

    def both(z: Any, value: Any, tangent: Any, of_value: Any, cotangent: Any) -> Any:
        fn = project if mode.startswith("project") else solve
        _, push, (ys, okay) = jax.jvp(
            lambda z, v: fn(z, v, dfx.ForwardMode()),
            (z, value),
            (tangent, of_value),
            has_aux=True,
        )
        _, pull, _ = jax.vjp(
            lambda z, v: fn(z, v, dfx.RecursiveCheckpointAdjoint()), z, value, has_aux=True
        )
        bar, bar_value = pull(cotangent)
        return ys, okay, push, jnp.sum(bar * tangent) + jnp.sum(bar_value * of_value)

    return jax.jit(jax.vmap(both))


def norm(x: np.ndarray) -> np.ndarray:
    return np.sqrt((x**2).sum(0))


def difference(point: Any, h: np.ndarray, y: Any, z: Any) -> tuple[np.ndarray, np.ndarray]:
    """The central difference of `point(h)`, and whether its equations were solved well enough, for
    the same root: near the returned `y`, as seen from how far that is from `z`."""
    (above, first), (below, second) = point(h), point(-h)
    same = norm(above + below - 2 * y) < 0.1 * norm(y - z) + 10 * h + 1e-8
    return (above - below) / (2 * h), (np.maximum(first, second) < 1e-3 * h) & same


def oracle_project(lane: Any, shift: np.ndarray, ys: np.ndarray) -> list[Any]:
    """Both derivatives, at the level of what was returned and there with |E|² shifted."""
    z, value, w, wv = lane
    h0, l0 = value

    def change(h: np.ndarray) -> Any:
        """Of |E|² = 1 + 2 H l² and of l, without cancellation."""
        l = l0 + h * wv[1]
        return 2 * (h * wv[0] * l**2 + h0 * (2 * l0 * h * wv[1] + (h * wv[1]) ** 2)), h * wv[1]

    square, l = kepler.level(ys[-1])
    square = np.maximum(square + shift, 0)
    away = norm(ys[-1] - z)
    e = np.maximum(np.sqrt(square), 1e-9)
    h = 1e-3 * np.where((wv == 0).all(0), np.maximum(e, away), e)

    def point(method: Any, h: np.ndarray) -> Any:
        more = change(h)
        return method(z + h * w, (square + more[0], l + more[1]), ys[-1])

    return [
        difference(functools.partial(point, m), h, ys[-1], z)
        for m in (kepler.nearest, kepler.frozen)
    ]


def oracle_solve(lane: Any, shift: np.ndarray, ys: np.ndarray, h: Any = None) -> list[Any]:
    y0, dt, w, _ = lane
    if h is None:
        h = 1e-3 * np.maximum(np.sqrt(kepler.level(y0)[0]), 1e-9)

    def point(method: Any, h: np.ndarray) -> Any:
        y, unsolved = y0 + h * w, 0 * dt
        start, before = kepler.level(y), kepler.level(y0)
        for near in ys:
            # Each step's level is off that of the start by roundoff, as it was returned.
            now = kepler.level(near)
            to = [s + (n - b) for s, n, b in zip(start, now, before, strict=True)]
            y, length = method(kepler.rk4(y, dt), (to[0] + shift, to[1]), near)
            unsolved = np.maximum(unsolved, length)
        return y, unsolved

    return [
        difference(functools.partial(point, m), h, ys[-1], y0)
        for m in (kepler.nearest, kepler.frozen)
    ]


def draw(rng: np.random.Generator, mode: str, lanes: int) -> Any:
    e = log_uniform(rng, 1e-12, 0.1, lanes) * (rng.random(lanes) < 0.9)
    l = log_uniform(rng, 0.7, 1.4, lanes)
    on = kepler.orbit(long(e), long(l), *rng.uniform(-3, 3, (2, lanes)))
    w, cotangent = rng.normal(size=(2, 4, lanes))
    wv = np.zeros((2, lanes))
    if mode.startswith("solve"):
        return on.astype(float), rng.uniform(0.02, 0.3, (1, lanes)), w, wv[:1], cotangent
    energy = -(1 - long(e) ** 2) / (2 * long(l) ** 2)
    z = on + log_uniform(rng, 1e-10, 1e-2, lanes) * rng.normal(size=(4, lanes))
    moving = (rng.random(lanes) < 0.5) & (e > 1e-5)
    wv = rng.normal(size=(2, lanes)) * e * moving
    return z.astype(float), np.stack([energy, l]).astype(float), w, wv, cotangent


def run(seed: int, number: int, lanes: int) -> Tally:
    rng = np.random.default_rng([seed, number])
    mode = MODES[(seed + number) % len(MODES)]
    drawn = draw(rng, mode, lanes)
    inputs = [x.T for x in drawn]
    if mode.startswith("solve"):
        inputs[1], inputs[3] = inputs[1][:, 0], inputs[3][:, 0]
    ys, okay, push, product = map(np.asarray, compiled(mode)(*inputs))
    ys, push = long(ys).transpose(1, 2, 0), long(push).T
    lane = [long(x) for x in drawn[:4]]
    if mode.startswith("solve"):
        lane[1] = lane[1][0]
    oracle = oracle_project if mode.startswith("project") else oracle_solve
    with np.errstate(all="ignore"):
        found = oracle(lane, np.longdouble(0), ys)
        # What roundoff of the returned state leaves open.
        e = np.sqrt(kepler.level(ys[-1])[0])
        shifted = [oracle(lane, s * 8 * EPS * (e + EPS), ys) for s in (-1, 1)]
        if e.min() < 8 * EPS**0.5:
            # By the conserved values this may be a circle.
            circle = np.where(e < 8 * EPS**0.5, -np.inf, 0)
            found += oracle(lane, circle, ys)
        if mode.startswith("solve"):
            found += oracle(lane, np.longdouble(0), ys, np.longdouble(1e-4) + 0 * lane[1])

        # The smallest error against one of the oracles that solved its equations.
        forward, reverse, spread = np.full((3, lanes), np.inf)
        c = long(drawn[4])
        for k, (right, solved) in enumerate(found):
            size = np.where(solved, norm(right), np.nan)
            forward = np.fmin(forward, norm(push - right) / size)
            dot = np.abs(product - (c * right).sum(0)) / (norm(c) * size)
            reverse = np.fmin(reverse, dot)
            if k < 2:
                others = [norm(s[k][0] - right) for s in shifted]
                spread = np.fmin(spread, np.maximum(*others) / size)
    known = np.isfinite(spread)
    sharp = known & (spread <= TOLERANCE)
    allowed = np.where(sharp, TOLERANCE, 2 * spread)
    number_of_nan = okay & (np.isnan(push).any(0) | np.isnan(product))
    tally = Tally(lanes, int(okay.sum()))
    tally.notes[f"{mode}: determined"] += int((okay & sharp).sum())
    tally.notes[f"{mode}: undetermined"] += int((okay & known & ~sharp).sum())
    tally.notes[f"{mode}: no oracle"] += int((okay & ~known).sum())
    tally.notes[f"{mode}: NaN"] += int(number_of_nan.sum())

    def show(i: int) -> str:
        facts = [np.asarray(x)[..., i].tolist() for x in drawn]
        errors = f"errors {forward[i]:.2g}, {reverse[i]:.2g}, spread {spread[i]:.2g}"
        return f"{mode}, e = {float(e[i]):.2g}: {errors}, {facts}"

    isnan = np.isnan(push).any(0)
    tally.blame(f"{mode}: forward", okay & known & ~isnan & ~(forward <= allowed), show)
    tally.blame(f"{mode}: reverse", okay & known & ~np.isnan(product) & ~(reverse <= allowed), show)
    return tally
