"""Attack: initial states off a `Constraint`, by 1e-17 to 1, in batches with `throw=False`.

A state that is off by no more than roundoff is to be accepted, one that is off by more than the
threshold refused by an unsuccessful result, for its own lane alone.
"""

import functools
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import diffrax_conserve as dfc

from .oracle import Tally, blames, log_uniform, long, ratio, scales, values

LANES, TIMEOUT = 500, 300
# Relative to the scale: what is off by more must be refused, by less than 8 eps must be accepted.
REFUSED = {np.float64: 1e-7, np.float32: 1e-3}


def _sphere(xp: Any, y: Any, a: Any) -> list[Any]:
    return [y[0] ** 2 + y[1] ** 2 + y[2] ** 2 - a[0] ** 2]


def _rod(xp: Any, y: Any, a: Any) -> list[Any]:
    """Length and velocity of a rod."""
    return [y[0] ** 2 + y[1] ** 2 - a[0] ** 2, y[0] * y[2] + y[1] * y[3]]


def _turn(y: Any, a: Any) -> Any:
    return jnp.stack([-y[1], y[0], 0 * y[2]])


def _swing(y: Any, a: Any) -> Any:
    pull = (y[2] ** 2 + y[3] ** 2) / (y[0] ** 2 + y[1] ** 2)
    return jnp.stack([y[2], y[3], -pull * y[0], -pull * y[1]])


# The constraints, the field, and the number of unknowns. Lengths are in arguments, which count as
# exact, so the scale has their square.
SYSTEMS = {"sphere": (_sphere, _turn, 3), "rod": (_rod, _swing, 4)}


@functools.cache
def compiled(name: str, adaptive: bool, newton: bool) -> Any:
    fn, field, _ = SYSTEMS[name]
    projection = dfc.Newton() if newton else dfc.SimplifiedNewton()
    manifold = {"alpha": dfc.Constraint(lambda t, y, a: jnp.stack(fn(jnp, y, a)))}

    def solve(y0: Any, a: Any, t1: Any) -> Any:
        sol = dfx.diffeqsolve(
            dfx.ODETerm(lambda t, y, a: field(y, a)),
            dfc.ManifoldProjection(dfx.Tsit5(), manifold, projection=projection),
            jnp.zeros_like(t1),
            t1,
            t1 / 4,
            y0,
            a,
            saveat=dfx.SaveAt(ts=jnp.linspace(0, t1, 6)[1:]),
            stepsize_controller=dfx.PIDController(1e-4, 1e-4)
            if adaptive
            else dfx.ConstantStepSize(),
            max_steps=50,
            throw=False,
        )
        return sol.result, sol.ys

    return eqx.filter_jit(eqx.filter_vmap(solve))


def run(seed: int, number: int, lanes: int) -> Tally:
    rng = np.random.default_rng([seed, number])
    name = list(SYSTEMS)[number % 2]
    fn, _, n = SYSTEMS[name]
    dtype = (np.float64, np.float32)[(seed + number // 2) % 2]
    adaptive, newton = map(bool, rng.random(2) < (0.5, 0.3))
    a = log_uniform(rng, 0.1, 10, (1, lanes)).astype(dtype)
    y0 = rng.normal(size=(n, lanes))
    long_as = {"sphere": slice(0, 3), "rod": slice(0, 2)}[name]
    y0[long_as] *= a / np.linalg.norm(y0[long_as], axis=0)
    if name == "rod":
        speed = rng.normal(size=lanes)
        y0[2:] = speed * np.stack([-y0[1], y0[0]])
    # On it in long double, then off by so much, radially, then rounded.
    off_by = log_uniform(rng, 1e-17, 1, lanes) * (rng.random(lanes) < 0.8)
    y0[long_as] *= 1 + off_by * rng.choice([-1, 1], lanes) * 0.9
    y0 = y0.astype(dtype)
    broken = rng.random(lanes) < 0.02
    # NaN has no size, so that adaptive steps from it are all rejected, as without a projection.
    y0[0, broken] = np.finfo(dtype).max ** 0.7 if adaptive else np.nan
    t1 = rng.uniform(0.05, 0.5, lanes).astype(dtype)
    with np.errstate(all="ignore"):
        scale = scales(fn, long(y0), long(a))
        violation = (np.abs(values(fn, y0, a)) / scale).max(axis=0)
    tally = Tally(lanes)
    solve = compiled(name, adaptive, newton)
    good = np.argmax(violation <= 4 * np.finfo(dtype).eps)
    # Where the batch is ended by one that is refused, again without the worst, which become good.
    for worst in [np.inf, 0.3, 0.01, 1e-3, 1e-4, 1e-6, 1e-8, 1e-10]:
        healed = ~(violation <= worst) & (worst < np.inf)
        y0[:, healed], violation[healed] = y0[:, [good]], violation[good]
        a[:, healed] = a[:, [good]]
        try:
            result, ys = jax.block_until_ready(solve(y0.T, a.T, t1))
            break
        except Exception as error:
            lines = [line for line in str(error).splitlines() if "onstraint" in line]
            tally.wrong["raised under throw=False"] = 1
            tally.examples[:] = [f"raised under throw=False: {(lines or [str(error)[:300]])[0]}"]
    else:
        return tally
    okay = np.asarray(result == dfx.RESULTS.successful)
    ys = np.asarray(ys)
    tally.success = int(okay.sum())
    eps = np.finfo(dtype).eps

    def show(i: int) -> str:
        what = f"{name}, {adaptive=}, {newton=}, {dtype.__name__}, off by {float(violation[i]):.2g}"
        return f"{what}: y0 = {y0[:, i]}, a = {a[:, i]}, t1 = {t1[i]}"

    tally.blame("accepted", okay & ~(violation <= REFUSED[dtype]), show)
    tally.blame("refused though on it", ~okay & (violation <= 4 * eps), show)
    flat = ys.reshape(-1, n).T
    off = ratio(fn, flat, np.repeat(a, ys.shape[1], axis=1), 0).reshape(ys.shape[:2])
    tally.blame("residual later", okay & ~(off <= 1).all(axis=1), show)
    names = [
        i
        for i in np.flatnonzero(~okay)[:20]
        if not blames(dfx.RESULTS[jax.tree.map(lambda x, i=i: x[i], result)], {"alpha": 0}, "alpha")
    ]
    tally.blame("refused without a name", np.isin(np.arange(okay.size), names), show)
    # One bad lane must not change the others.
    worst = np.isnan(violation) | (violation > REFUSED[dtype])
    if okay.any() and worst.any():
        donor = np.where(worst, np.flatnonzero(okay)[0], np.arange(okay.size))
        again = np.asarray(solve(y0[:, donor].T, a[:, donor].T, t1)[1])
        changed = okay & ~worst & (again != ys).any(axis=(1, 2))
        tally.blame("changed by another lane", changed, show)
    return tally
