"""Attack: NaN, or a state off the manifold, in a solve that says it succeeded.

Steps that are too large, adaptive ones with loose tolerances, and states near a singularity; saved
times inside steps, dense output, events, all steps and the last one.
"""

import functools
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

import diffrax_conserve as dfc

from .families import FAMILIES, Family, _normal, _positive
from .oracle import Tally, log_uniform, ratio, values

LANES, TIMEOUT = 1000, 600
# Canonical systems: the first function is the energy, the state (q, p).
SYSTEMS = {
    **{k: FAMILIES[k] for k in ("kepler", "pendulum", "relativistic", "toda", "populations")},
    "exponentials": Family(lambda xp, y, a: [xp.exp(y[0]) + a[0] * xp.exp(y[1])], 2),
    "henon-heiles": Family(
        lambda xp, y, a: [0.5 * sum(x * x for x in y) + y[0] ** 2 * y[1] - y[1] ** 3 / 3], 4
    ),
    "well": Family(lambda xp, y, a: [0.5 * y[1] ** 2 + a[0] / y[0] ** 2], 2, _positive),
    "quartic": Family(lambda xp, y, a: [y[0] ** 4 + a[0] * y[1] ** 2], 2, _normal),
}
FIXED = {"RK4": dfc.RK4(), "Euler": dfx.Euler(), "LeapfrogMidpoint": dfx.LeapfrogMidpoint()}
ADAPTIVE = {
    "Heun": dfx.Heun(),
    "Bosh3": dfx.Bosh3(),
    "Tsit5": dfx.Tsit5(),
    "Dopri8": dfx.Dopri8(),
    "ReversibleHeun": dfx.ReversibleHeun(),
    "HalfSolver(RK4)": dfx.HalfSolver(dfc.RK4()),
    "Kvaerno3": dfx.Kvaerno3(root_finder=dfx.VeryChord(1e-3, 1e-6, norm=optx.max_norm)),
}
SOLVERS = FIXED | ADAPTIVE
MODES = ["ts", "dense", "event", "steps", "t1"]
TIMES = 25
MAX_STEPS = 100
# Of the solves that succeed, so many may have saved a state off the manifold inside a long step.
SHARE_OFF = 0.01


@functools.cache
def compiled(name: str, solver: str, newton: bool, mode: str, adaptive: bool) -> Any:
    family = SYSTEMS[name]

    def fn(t: Any, y: Any, a: Any) -> Any:
        return jnp.stack(family.fn(jnp, y, a[:-1]))

    def vector_field(t: Any, y: Any, a: Any) -> Any:
        slope = jax.grad(lambda y: fn(t, y, a)[0])(y)
        q, p = jnp.split(slope, 2)
        return jnp.concatenate([p, -q])

    projection = dfc.Newton() if newton else dfc.SimplifiedNewton()
    wrapped = dfc.ManifoldProjection(SOLVERS[solver], dfc.FirstIntegral(fn), projection=projection)

    def solve(y0: Any, a: Any, dt: Any, steps: Any, fractions: Any, rtol: Any) -> Any:
        t1 = dt * steps
        ts = jnp.clip(fractions * t1, jnp.minimum(t1, 0), jnp.maximum(t1, 0))
        saveat = {
            "ts": dfx.SaveAt(ts=ts),
            "dense": dfx.SaveAt(dense=True, t1=True),
            "event": dfx.SaveAt(t1=True, ts=ts),
            "steps": dfx.SaveAt(steps=True, t0=True),
            "t1": dfx.SaveAt(t1=True),
        }[mode]
        # The level is one that the solve crosses at some time, if at all.
        crossing = dfx.Event(
            lambda t, y, args, **_: y[0] - args[-1], root_finder=optx.Newton(1e-6, 1e-6)
        )
        controller = dfx.PIDController(rtol, rtol) if adaptive else dfx.ConstantStepSize()
        options = dict(saveat=saveat, stepsize_controller=controller, throw=False)
        options |= dict(event=crossing if mode == "event" else None, max_steps=MAX_STEPS)
        term, args = dfx.ODETerm(vector_field), jnp.append(a, y0[0] * 0.9)
        sol = dfx.diffeqsolve(term, wrapped, jnp.zeros_like(t1), t1, dt, y0, args, **options)
        okay = (sol.result == dfx.RESULTS.successful) | (sol.result == dfx.RESULTS.event_occurred)
        if mode == "dense":
            return okay, jnp.append(ts, t1), jnp.concatenate([jax.vmap(sol.evaluate)(ts), sol.ys])
        return okay, sol.ts, sol.ys

    return eqx.filter_jit(jax.vmap(solve))


def run(seed: int, number: int, lanes: int) -> Tally:
    rng = np.random.default_rng([seed, number])
    names = list(SYSTEMS)
    name, mode = names[(seed + number) % len(names)], MODES[(seed + number) % len(MODES)]
    solver = str(rng.choice(list(SOLVERS)))
    newton, adaptive = rng.random() < 0.2, solver in ADAPTIVE and rng.random() < 0.4
    # diffrax itself cannot locate an event in float32 where float64 is enabled.
    dtype = np.float32 if rng.random() < 0.25 and mode != "event" else np.float64
    family = SYSTEMS[name]
    y0, a = (x.astype(dtype) for x in family.draw(rng, lanes))
    dt = log_uniform(rng, 0.02, 2, lanes).astype(dtype) * (1 if number % 2 else -1)
    steps = rng.integers(2, 60, lanes).astype(dtype)
    fractions = np.sort(rng.random((lanes, TIMES)), axis=1).astype(dtype)
    rtol = log_uniform(rng, 1e-6, 1e-1, lanes).astype(dtype)
    solve = compiled(name, solver, newton, mode, adaptive)
    okay, ts, ys = map(np.asarray, solve(y0.T, a.T, dt, steps, fractions, rtol))
    tally = Tally(lanes, int(okay.sum()))
    saved = ~np.isinf(ts)  # NaN would be a time that was saved
    finite = np.isfinite(ys).all(axis=2)

    def repeat(x: np.ndarray) -> np.ndarray:
        return np.repeat(x, ys.shape[1], axis=-1)

    value = values(family.fn, y0, a)
    flat = ys.reshape(-1, ys.shape[2]).T
    off = ratio(family.fn, flat, repeat(a), repeat(value), repeat(y0)).reshape(ts.shape)

    def show(i: int) -> str:
        k = np.argmax(np.where(saved[i], off[i], 0))
        facts = {"y0": y0[:, i], "a": a[:, i], "dt": dt[i], "steps": steps[i], "rtol": rtol[i]}
        what = f"{name}, {solver}, {newton=}, {mode}, {adaptive=}, {dtype.__name__}"
        return f"{what}: t = {ts[i, k]}, y = {ys[i, k]}, {off[i, k]:.3g} of allowed, {facts}"

    okay = okay & np.isfinite(value).all(axis=0)
    tally.blame(f"{mode}: not finite", okay & (saved & ~finite).any(axis=1), show)
    away = okay & (saved & finite & ~(off <= 1)).any(axis=1)
    if mode not in ("steps", "t1"):
        # Inside a very long step a state may be that of the interpolation, off the manifold.
        tally.notes[f"{mode}: off"] += int(away.sum())
        away = away & (away.sum() > SHARE_OFF * okay.sum())
    tally.blame(f"{mode}: off", away, show)
    return tally
