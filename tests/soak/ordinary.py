"""Attack: ordinary candidates, as a step of an integrator proposes them. A projection that fails
where a damped Gauss-Newton iteration in long double succeeds is counted: a false failure. Those of
`SimplifiedNewton` are counted apart if the same oracle finds no state along the gradients at the
candidate, where that is to look.

The candidate is 1e-12 to 1e-2 of its size away from a state of the manifold. To the families of the
other attacks come networks, and functions with constants that their gradients do not show. A lane
counts if one Newton step halves the residual at least, so that the functions are nearly linear at
this distance, and if the squares of their gradients are in the range of the dtype.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import diffrax_conserve as dfc

from .families import FAMILIES, Family
from .oracle import Tally, derivative, log_uniform, long, scales, values

LANES, TIMEOUT = 2500, 600
# Where gradients are parallel, or a correction crosses a singularity, no iteration is meant to
# succeed.
LEFT_OUT = {"redundant", "nearly parallel", "saddle"}
_STEPS = 60
# Relative to the terms that a gradient shows; `1 - cos(q)` has roundoff above that of long double.
_REACHED = 1e-10


def _network(seed: int, gain: float) -> Any:
    rng = np.random.default_rng(seed)
    layers = [
        (rng.normal(size=(m, n)) / np.sqrt(n), rng.normal(size=m))
        for n, m in ((2, 32), (32, 32), (32, 1))
    ]

    def fn(xp: Any, y: Any, a: Any) -> list[Any]:
        x = gain * xp.stack([y[0], y[1]])
        for w, b in layers:
            x = xp.tensordot(w, x, 1) + b.reshape(-1, *[1] * (x.ndim - 1))
            x = xp.tanh(x) if len(b) > 1 else x
        return [a[0] * x[0]]

    return fn


def _small(rng: Any, n: int, lanes: int) -> np.ndarray:
    return rng.normal(size=(n, lanes)) * log_uniform(rng, 1e-4, 0.3, lanes)


ORDINARY: dict[str, Family] = {
    **{name: family for name, family in FAMILIES.items() if name not in LEFT_OUT},
    "rest": Family(lambda xp, y, a: [0.5 * y[1] ** 2 + a[0] * (1 - xp.cos(y[0]))], 2, _small),
    "offset": Family(
        lambda xp, y, a: [a[0] + 0.5 * y[1] ** 2 - xp.cos(y[0])], 2, _small, ((1, 100),)
    ),
    "network": Family(_network(0, 1.0), 2, a=((0.1, 10),)),
    "steep network": Family(_network(1, 4.0), 2, a=((0.1, 10),)),
    "molecule": Family(
        lambda xp, y, a: [y[1] ** 2 + a[0] * (1 - xp.exp(-1.9 * (y[0] - 1.4))) ** 2],
        2,
        lambda rng, n, lanes: np.stack(
            [np.full(lanes, 1.4), rng.normal(size=lanes) * log_uniform(rng, 1e-3, 0.3, lanes)]
        ),
        ((0.1, 0.3),),
    ),
}
PROGRAMS = [(f, m, d) for f in ORDINARY for m in ("simplified", "newton") for d in (8, 4)]


@functools.cache
def compiled(name: str, mode: str) -> Any:
    family = ORDINARY[name]

    def fn(t: Any, y: Any, args: Any) -> Any:
        return jnp.stack(family.fn(jnp, y, args))

    manifold = dfc.Constraint(fn) if family.constraint else dfc.FirstIntegral(fn)
    projection = dfc.SimplifiedNewton() if mode == "simplified" else dfc.Newton()

    def project(start: Any, candidate: Any, a: Any) -> Any:
        value = None if family.constraint else fn(0.0, start, a)
        y, info = dfc.project(manifold, candidate, args=a, value=value, projection=projection)
        return y, info.ok, jnp.zeros_like(fn(0.0, start, a)) if value is None else value

    return jax.jit(jax.vmap(project))


def reachable(
    family: Family, y: np.ndarray, a: np.ndarray, value: np.ndarray, frozen: bool = False
) -> np.ndarray:
    """Which lanes a damped Gauss-Newton iteration brings to the manifold, in long double, of those
    that count; with `frozen` along the gradients at the candidate."""
    # Below float64 the package scales the gradients.
    largest = np.finfo(y.dtype).max ** (0.5 if y.dtype == np.float64 else 1.0)
    y, a, value = long(y), long(a), long(value)
    m, counts, before = len(value), np.ones(y.shape[1], bool), np.inf
    reached = np.zeros(y.shape[1], bool)
    with np.errstate(all="ignore"):
        for step in range(_STEPS):
            g = values(family.fn, y, a) - value
            size = scales(family.fn, y, a, value)
            off = (np.abs(g) / size).max(axis=0)
            reached |= off <= _REACHED
            if step == 0:
                counts &= (size < 1e-3 * largest).all(axis=0)
            if step == 1:
                counts &= reached | (off <= 0.5 * before)
            before = off
            units = np.eye(len(y), dtype=y.dtype)[:, :, None] + 0 * y
            rows = [derivative(lambda z: family.fn(np, z, a), y, unit) for unit in units]
            rows, g = np.stack(rows, axis=1) / size[:, None], g / size
            damping = np.minimum(1e-2, (g * g).sum(axis=0))
            along = rows if step == 0 or not frozen else along
            slopes = np.einsum("ikl,jkl->ijl", rows, along)
            gram = np.einsum("kil,kjl->ijl", slopes, slopes) if frozen else slopes
            right = np.einsum("kil,kl->il", slopes, g) if frozen else g
            for i in range(m):
                gram[i, i] = gram[i, i] * (1 + damping) + np.longdouble("1e-4000")
            y = y - np.einsum("ikl,il->kl", along, _solved(gram, right))
    return counts & reached & np.isfinite(y).all(axis=0)


def _solved(gram: np.ndarray, b: np.ndarray) -> np.ndarray:
    gram, b, m = gram.copy(), b.copy(), len(b)
    for k in range(m):
        for i in range(k + 1, m):
            share = gram[i, k] / gram[k, k]
            gram[i], b[i] = gram[i] - share * gram[k], b[i] - share * b[k]
    for k in reversed(range(m)):
        b[k] = (b[k] - sum(gram[k, j] * b[j] for j in range(k + 1, m))) / gram[k, k]
    return b


def run(seed: int, number: int, lanes: int) -> Tally:
    rng = np.random.default_rng([seed, number])
    name, mode, width = PROGRAMS[(seed + 7 * number) % len(PROGRAMS)]
    dtype = np.float64 if width == 8 else np.float32
    family = ORDINARY[name]
    start, a = (x.astype(dtype) for x in family.draw(rng, lanes))
    noise = rng.normal(size=start.shape)
    noise /= np.linalg.norm(noise, axis=0)
    away = log_uniform(rng, 1e-12, 1e-2, lanes)
    candidate = (start + away * noise * np.linalg.norm(start, axis=0)).astype(dtype)
    y, okay, value = map(np.asarray, compiled(name, mode)(start.T, candidate.T, a.T))
    assert y.dtype == dtype
    right = reachable(family, candidate, a, value.T)
    tally = Tally(int(right.sum()), int((right & okay).sum()))
    failed = right & ~okay
    if mode == "simplified" and failed.any():
        there = reachable(family, candidate, a, value.T, frozen=True)
        tally.notes["no state along the gradients at the candidate"] += int((failed & ~there).sum())
        failed &= there
    tally.notes[f"false failures, {mode}, {dtype.__name__}"] += int(failed.sum())

    def show(i: int) -> str:
        return f"{name}, {mode}, {dtype.__name__}: {candidate[:, i]}, {a[:, i]}, {away[i]:.1e}"

    tally.blame(f"{name}, {mode}, {dtype.__name__}: a false failure", failed, show)
    return tally
