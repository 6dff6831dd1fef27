"""The solves, each by one solver from one or from many initial states, and their errors."""

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
from ..systems import AbstractSystem, names

# Explicit methods cannot solve a stiff system, and implicit ones not with fixed steps: the root
# finder diverges. So these steps are adaptive, and the solution is saved after each `dt`.
_ADAPTIVE = dfx.PIDController(rtol=1e-6, atol=1e-10)
_FIRST_STEP = 1e-6
_STEPS_MAX = 16**3

# A solve is run at most so often, and not again after so many seconds.
_RUNS_MAX, _SECONDS_MAX = 5, 2.0

# The largest number of steps that are compared and drawn.
COMPARED_MAX = 2000


@dataclasses.dataclass(frozen=True)
class Run:
    """What one solver found; without a failure also at `ts`, evenly spread steps from 0 on."""

    failure: str | None
    steps: int = 0
    seconds: float = 0.0  # of the processor, of the fastest run
    compile_seconds: float = 0.0  # of the processor too
    ts: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    ys: Any = None  # with a leading axis over the initial states
    drift: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)  # by integral, at `ts`
    largest_drift: dict[str, float] = dataclasses.field(default_factory=dict)  # of all steps


def run(system: AbstractSystem, solver: dfx.AbstractSolver, y0s: Any, t1: float, dt: float) -> Run:
    """Solves from each of `y0s`, from 0 to `t1`, in steps of `dt` or, if stiff, saved so often."""
    try:
        return _timed(system, solver, y0s, t1, dt)
    except (RuntimeError, TypeError, ValueError) as error:
        # If one solver cannot start, the results of the others are kept.
        return Run(f"at the start: {reason(error)}")


def reason(error: Exception) -> str:
    """The message of an error, without the lines that equinox and jax add."""
    found = re.search(r"EquinoxRuntimeError: (.*)", str(error))
    return str(error) if found is None else found[1]


def state_errors(system: AbstractSystem, y0s: Any, runs: dict[str, Run]) -> dict[str, np.ndarray]:
    """The distance from the reference of each solver that succeeded, `(states, times)`."""
    succeeded = {name: run for name, run in runs.items() if run.failure is None}
    if not succeeded:
        return {}
    # Every solver takes the same steps.
    ts = next(iter(succeeded.values())).ts
    exact = _components(eqx.filter_vmap(lambda y0: system.reference(ts, y0))(y0s))
    return {k: np.linalg.norm(_components(v.ys) - exact, axis=2) for k, v in succeeded.items()}


def _components(values: Any) -> np.ndarray:
    """`(states, times, components)`."""
    leaves = [np.asarray(x) for x in jtu.tree_leaves(values)]
    return np.concatenate([x.reshape(*x.shape[:2], -1) for x in leaves], axis=2)


def is_stiff(system: AbstractSystem) -> bool:
    return system.name in names(stiff=True)


@eqx.filter_jit
def _solve(
    system: AbstractSystem, solver: dfx.AbstractSolver, y0s: Any, t1: Any, dt: Any, steps: int
) -> dfx.Solution:
    options: dict[str, Any] = dict(saveat=dfx.SaveAt(t0=True, steps=True), max_steps=steps + 1)
    if is_stiff(system):
        saveat = dfx.SaveAt(ts=jnp.minimum(dt * jnp.arange(steps + 1), t1))
        options = dict(saveat=saveat, max_steps=_STEPS_MAX, stepsize_controller=_ADAPTIVE)
        dt = _FIRST_STEP

    def one(y0: Any) -> dfx.Solution:
        term = dfx.ODETerm(system.vector_field)
        return dfx.diffeqsolve(term, solver, 0.0, t1, dt, y0, system.args, throw=False, **options)

    return jax.vmap(one)(y0s)


def _timed(
    system: AbstractSystem, solver: dfx.AbstractSolver, y0s: Any, t1: float, dt: float
) -> Run:
    arguments = (system, solver, y0s, jnp.asarray(t1), jnp.asarray(dt), math.ceil(t1 / dt))
    started = time.process_time()
    compiled = _solve.lower(*arguments).compile()  # pyright: ignore[reportFunctionMemberAccess]
    compile_seconds = time.process_time() - started
    solution: dfx.Solution = jax.block_until_ready(compiled(*arguments))
    taken: list[float] = []
    while len(taken) < _RUNS_MAX and sum(taken) < _SECONDS_MAX:
        started = time.process_time()
        jax.block_until_ready(compiled(*arguments))
        taken.append(time.process_time() - started)

    batch_drift = jax.vmap(lambda sol: drift(sol, system.manifold, system.args))
    drifts = eqx.filter_jit(batch_drift)(solution)
    failure = _failure(solution, _components((solution.ys, drifts)))
    found = Run(failure, int(np.max(solution.stats["num_steps"])), min(taken), compile_seconds)
    if failure is not None:
        return found
    ts = np.asarray(solution.ts)[0]
    count = np.sum(np.isfinite(ts))  # the rest is padding, in all solves alike
    index = np.unique(np.linspace(0, count - 1, COMPARED_MAX + 1).round().astype(int))
    sizes = {k: np.max(np.abs(_components(drifts[k])), axis=(0, 2)) for k in system.manifold}
    return dataclasses.replace(
        found,
        ts=ts[index],
        ys=jtu.tree_map(lambda y: np.asarray(y)[:, index], solution.ys),
        drift={name: size[index] for name, size in sizes.items()},
        largest_drift={name: float(np.max(size)) for name, size in sizes.items()},
    )


def _failure(solution: dfx.Solution, values: np.ndarray) -> str | None:
    """The failure at the first initial state with one, and how many of them have one."""
    ts = np.asarray(solution.ts)
    wrong = np.isfinite(ts) & ~np.isfinite(values).all(axis=2)
    stopped = np.asarray(solution.result != dfx.RESULTS.successful)
    failed = stopped | wrong.any(axis=1)
    if not failed.any():
        return None
    first = int(np.argmax(failed))
    if stopped[first]:
        message = dfx.RESULTS[jtu.tree_map(lambda x: x[first], solution.result)]
        last = np.max(ts[first], where=np.isfinite(ts[first]), initial=0)
        found = f"after t = {last:.6g}: {' '.join(message.split())}"
    else:
        t = ts[first, np.argmax(wrong[first])]
        found = f"at t = {t:.6g}: the state is not finite any more. Choose a smaller dt."
    return found if failed.size == 1 else f"for {failed.sum()} of {failed.size}: {found}"
