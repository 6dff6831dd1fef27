"""Attack: candidates from anywhere; success is decided at the returned state, in long double.

The candidate is 1e-16 to 1e5 of its size away from a state of the manifold; one value in ten is a
random one, which may not be reachable. A `ClosedForm` returns whatever the lane says: the answer,
nearly the answer, something else, or NaN.
"""

import functools
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

import diffrax_conserve as dfc

from ..problems import solve
from .families import FAMILIES
from .oracle import Tally, log_uniform, long, ratio, values

LANES, TIMEOUT = 5000, 600
MODES = ["simplified", "newton", "closed form", "step simplified", "step newton"]
PROGRAMS = [(f, m, d) for m in MODES for f in FAMILIES for d in (np.float64, np.float32)]
# So that a few programs are of many kinds: no factor in common with their number.
STRIDE = 11


@functools.cache
def compiled(name: str, mode: str) -> Any:
    """Of `(start, candidate, parameters, value, answer)` per lane: the state, and whether that is
    called a success."""
    family = FAMILIES[name]

    def fn(t: Any, y: Any, args: Any) -> Any:
        return jnp.stack(family.fn(jnp, y, args[0]))

    manifold = dfc.Constraint(fn) if family.constraint else dfc.FirstIntegral(fn)
    projection = {
        "simplified": dfc.SimplifiedNewton(),
        "newton": dfc.Newton(),
        "closed": dfc.ClosedForm(lambda t, y, args, values: args[1]),
    }[mode.split()[-1] if mode != "closed form" else "closed"]

    def project(start: Any, candidate: Any, a: Any, value: Any, answer: Any) -> Any:
        value = None if family.constraint else value
        y, info = dfc.project(
            manifold, candidate, args=(a, answer), value=value, projection=projection
        )
        return y, info.result == optx.RESULTS.successful

    def step(start: Any, candidate: Any, a: Any, value: Any, answer: Any) -> Any:
        # The field leads to the candidate, and conserves nothing.
        solver = dfc.ManifoldProjection(dfx.Euler(), manifold, projection=projection)
        args, options = (a, 2 * (candidate - start)), dict(max_steps=2, throw=False)
        sol = solve(
            lambda t, y, args: args[1], solver, start, t1=0.5, dt0=0.5, args=args, **options
        )
        return sol.ys[0], sol.result == dfx.RESULTS.successful

    return jax.jit(jax.vmap(step if mode.startswith("step") else project))


def draw(name: str, dtype: Any, rng: np.random.Generator, lanes: int) -> dict[str, np.ndarray]:
    family = FAMILIES[name]
    start, a = (x.astype(dtype) for x in family.draw(rng, lanes))
    away = log_uniform(rng, 1e-16, 1e5, lanes)
    noise = rng.normal(size=start.shape)
    noise /= np.linalg.norm(noise, axis=0)
    size = np.linalg.norm(start, axis=0)
    # Half of them each component by its own size.
    spread = np.where(rng.random(lanes) < 0.5, noise * size, noise * start)
    candidate = (start + away * spread).astype(dtype)
    value = values(family.fn, start, a)
    other = value * rng.normal(size=lanes) * log_uniform(rng, 1e-3, 1e3, lanes)
    with np.errstate(over="ignore"):
        value = np.where(rng.random(lanes) < 0.1, other, value).astype(dtype)
    if family.constraint:
        value = np.zeros_like(value)
    error = log_uniform(rng, 1e-18, 1e2, lanes) * (rng.random(lanes) < 0.8)
    answer = (start * (1 + error * rng.normal(size=start.shape))).astype(dtype)
    answer[:, rng.random(lanes) < 0.02] = np.nan
    return dict(start=start, candidate=candidate, a=a, value=value, answer=answer)


def run(seed: int, number: int, lanes: int) -> Tally:
    rng = np.random.default_rng([seed, number])
    name, mode, dtype = PROGRAMS[(seed + STRIDE * number) % len(PROGRAMS)]
    family = FAMILIES[name]
    lane = draw(name, dtype, rng, lanes)
    inputs = [lane[k].T for k in ("start", "candidate", "a", "value", "answer")]
    y, okay = map(np.asarray, compiled(name, mode)(*inputs))
    assert y.dtype == dtype
    start, value, change = None, lane["value"], 0
    if mode.startswith("step"):
        change = np.abs(long(lane["candidate"]) - long(lane["start"]))
    if mode.startswith("step") and not family.constraint:
        # The solve keeps the value that it computes itself.
        start, value = lane["start"], values(family.fn, lane["start"], lane["a"])
    off = ratio(family.fn, y.T, lane["a"], value, start, change)
    tally = Tally(lanes, int(okay.sum()))

    def show(i: int) -> str:
        facts = {k: lane[k][:, i].tolist() for k in ("start", "candidate", "a", "value", "answer")}
        return f"{name}, {mode}, {dtype.__name__}: {off[i]:.3g} of allowed, y = {y[i]}, {facts}"

    if not family.hides:
        tally.blame(f"{mode}: residual", okay & ~(off <= 1), show)
    return tally
