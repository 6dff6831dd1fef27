"""Attack: ordinary candidates, as a step of an integrator proposes them, 1e-12 to 1e-2 of its size
away from a state of the manifold. A projection that fails where the oracle reaches the manifold is
a false failure. Those of `SimplifiedNewton` are noted only if the oracle finds no state along the
gradients at the candidate, where that is to look.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from .families import FAMILIES
from .far import compiled
from .oracle import Tally, log_uniform, reachable

LANES, TIMEOUT = 2500, 600
# Where gradients are parallel no iteration is meant to succeed.
NAMES = [name for name in FAMILIES if name != "nearly parallel"]
PROGRAMS = [(f, m, d) for f in NAMES for m in ("simplified", "newton") for d in (8, 4)]


def run(seed: int, number: int, lanes: int) -> Tally:
    rng = np.random.default_rng([seed, number])
    name, mode, width = PROGRAMS[(seed + 7 * number) % len(PROGRAMS)]
    dtype: Any = np.float64 if width == 8 else np.float32
    family = FAMILIES[name]
    start, a = (x.astype(dtype) for x in family.draw(rng, lanes))
    noise = rng.normal(size=start.shape)
    noise /= np.linalg.norm(noise, axis=0)
    away = log_uniform(rng, 1e-12, 1e-2, lanes)
    candidate = (start + away * noise * np.linalg.norm(start, axis=0)).astype(dtype)
    value = jnp.stack(family.fn(jnp, start, a)) * (not family.constraint)
    inputs = [x.T for x in (start, candidate, a, value, start)]
    okay = np.asarray(compiled(name, mode)(*inputs)[1])
    given = family.fn, candidate, a, value
    right = reachable(*given)
    tally = Tally(int(right.sum()), int((right & okay).sum()))
    failed = right & ~okay
    if mode == "simplified" and failed.any():
        there = reachable(*given, frozen=True)
        tally.notes["no state along the gradients at the candidate"] += int((failed & ~there).sum())
        failed &= there

    def show(i: int) -> str:
        return f"{candidate[:, i]}, {a[:, i]}, {away[i]:.1e}"

    tally.blame(f"{name}, {mode}, {dtype.__name__}: a false failure", failed, show)
    return tally
