"""The solves: one solver, from one or from many initial states."""

import dataclasses
import math
import re
import time
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._diagnostics.drift import drift
from ..systems import AbstractSystem


@dataclasses.dataclass(frozen=True)
class Run:
    """The states of one solver at `ts`, which include the initial time, and their drifts, both with
    a leading axis over the initial states; or the reason of a failure."""

    ts: np.ndarray
    ys: Any
    drift: dict[str, np.ndarray]  # by integral, at each of `ts`
    steps: int
    seconds: float
    compile_seconds: float
    failure: str | None = None


def run(system: AbstractSystem, solver: dfx.AbstractSolver, y0s: Any, t1: float, dt: float) -> Run:
    """Solves from each of `y0s`, in steps of `dt` from 0 to `t1`."""
    try:
        return _timed(system, solver, y0s, t1, dt)
    except (RuntimeError, TypeError, ValueError) as error:
        # If one solver cannot start, the results of the others are kept.
        nothing = np.zeros(0)
        return Run(nothing, nothing, {}, 0, 0.0, 0.0, f"at the start: {_reason(error)}")


def _reason(error: Exception) -> str:
    """The message of an error, without the lines that equinox and jax add."""
    found = re.search(r"EquinoxRuntimeError: (.*)", str(error))
    return str(error) if found is None else found[1]


@eqx.filter_jit
def _solve(
    system: AbstractSystem,
    solver: dfx.AbstractSolver,
    y0s: Any,
    t1: jax.Array,
    dt: jax.Array,
    max_steps: int,
) -> dfx.Solution:
    def one(y0: Any) -> dfx.Solution:
        return dfx.diffeqsolve(
            dfx.ODETerm(system.vector_field),
            solver,
            t0=0.0,
            t1=t1,
            dt0=dt,
            y0=y0,
            args=system.args,
            saveat=dfx.SaveAt(t0=True, steps=True),
            stepsize_controller=dfx.ConstantStepSize(),
            max_steps=max_steps,
            throw=False,
        )

    return jax.vmap(one)(y0s)


def _timed(
    system: AbstractSystem, solver: dfx.AbstractSolver, y0s: Any, t1: float, dt: float
) -> Run:
    arguments = (system, solver, y0s, jnp.asarray(t1), jnp.asarray(dt), math.ceil(t1 / dt) + 1)
    started = time.perf_counter()
    compiled = _solve.lower(*arguments).compile()  # pyright: ignore[reportFunctionMemberAccess]
    compile_seconds = time.perf_counter() - started
    jax.block_until_ready(compiled(*arguments).ys)
    started = time.perf_counter()
    solution = compiled(*arguments)
    jax.block_until_ready(solution.ys)
    seconds = time.perf_counter() - started

    batch_drift = jax.vmap(lambda sol: drift(sol, system.manifold, system.args))
    drifts = eqx.filter_jit(batch_drift)(solution)
    largest = {name: _largest_component(drifts[name]) for name in system.manifold}
    ts, ys = jtu.tree_map(np.asarray, (solution.ts, solution.ys))
    counts = np.isfinite(ts).sum(axis=1)  # the rest is padding
    failure = _failure(solution.result, counts, ts, [*jtu.tree_leaves(ys), *largest.values()])
    # Without a failure all solves have as many steps.
    ts, ys, largest = jtu.tree_map(lambda x: x[:, : counts[0]], (ts, ys, largest))
    steps = int(np.max(solution.stats["num_steps"]))
    return Run(ts[0], ys, largest, steps, seconds, compile_seconds, failure)


def _largest_component(values: Any) -> np.ndarray:
    leaves = [np.abs(np.asarray(x)) for x in jtu.tree_leaves(values)]
    return np.max(np.concatenate([x.reshape(*x.shape[:2], -1) for x in leaves], axis=2), axis=2)


def _failure(
    result: dfx.RESULTS, counts: np.ndarray, ts: np.ndarray, values: list[np.ndarray]
) -> str | None:
    """The failure at the first initial state with one, and the number of initial states with a
    failure."""
    wrong = np.any([~np.isfinite(x).reshape(*x.shape[:2], -1).all(axis=2) for x in values], axis=0)
    wrong &= np.isfinite(ts)
    stopped = np.asarray(result != dfx.RESULTS.successful)
    failed = stopped | wrong.any(axis=1)
    if not failed.any():
        return None
    first = int(np.argmax(failed))
    if stopped[first]:
        message = dfx.RESULTS[jtu.tree_map(lambda x: x[first], result)]
        reason = f"after t = {ts[first, counts[first] - 1]:.6g}: {' '.join(message.split())}"
    else:
        t = ts[first, np.argmax(wrong[first])]
        reason = f"at t = {t:.6g}: the state is not finite any more. Choose a smaller dt."
    return reason if failed.size == 1 else f"for {failed.sum()} of {failed.size}: {reason}"
