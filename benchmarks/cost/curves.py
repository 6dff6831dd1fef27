"""Curves of error and drift against time, over the tolerances of each contestant, for
work_precision.py."""

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import measuring
import numpy as np

T1 = 100.0
MAX_DRIFT = 1e-14

Solve = Callable[[float, np.ndarray], np.ndarray]  # (setting, initial states) -> states at t1


class Contestant(NamedTuple):
    """`solve(setting, initial states) -> states at t = 100`, for each of the `settings`, which are
    tolerances, or steps where the steps are fixed."""

    solve: Solve
    settings: tuple[float, ...]
    compile_seconds: float | None = None


def diffeqsolve(
    system: Any,
    solver: dfx.AbstractSolver,
    y0: Any,
    setting: Any,
    *,
    adaptive: bool = True,
    solver_state: bool = False,
) -> dfx.Solution:
    """To t = 100 with the tolerance, or the number of steps, `setting`."""
    controller = dfx.PIDController(rtol=setting, atol=setting)
    return dfx.diffeqsolve(
        dfx.ODETerm(system.vector_field),
        solver,
        t0=0.0,
        t1=T1,
        dt0=None if adaptive else T1 / setting,
        y0=y0,
        saveat=dfx.SaveAt(t1=True, solver_state=solver_state),
        stepsize_controller=controller if adaptive else dfx.ConstantStepSize(),
        adjoint=dfx.ForwardMode(),
        max_steps=None,
        throw=False,
    )


def ours(
    system: Any,
    solver: dfx.AbstractSolver,
    lanes: int,
    settings: tuple[float, ...],
    *,
    adaptive: bool = True,
) -> Contestant:
    """Compiled once, for all settings; one trajectory is compiled without a batch axis."""
    _, unravel = jfu.ravel_pytree(system.y0)

    def one(setting: jax.Array, y0: jax.Array) -> jax.Array:
        solution = diffeqsolve(system, solver, unravel(y0), setting, adaptive=adaptive)
        ok = solution.result == dfx.RESULTS.successful
        return jnp.where(ok, jfu.ravel_pytree(solution.ys)[0], jnp.nan)

    like = jax.eval_shape(lambda: jfu.ravel_pytree(system.y0)[0])
    if lanes == 1:
        executable, seconds = measuring.compiled(one, settings[0], like)
        return Contestant(lambda x, start: executable(x, start[0])[None], settings, seconds)
    batch = jax.ShapeDtypeStruct((lanes, *like.shape), like.dtype)
    executable, seconds = measuring.compiled(jax.vmap(one, (None, 0)), settings[0], batch)
    return Contestant(executable, settings, seconds)


def flattened(states: Any) -> np.ndarray:
    return np.asarray(jax.vmap(lambda y: jfu.ravel_pytree(y)[0])(states))


def curves(
    system: Any, contestants: Mapping[str, Contestant], start: Any, rounds: int
) -> dict[str, list[dict[str, float]]]:
    """For each contestant and setting: seconds per trajectory, error and drift, the worst of all
    trajectories."""
    flat = flattened(start)
    _, unravel = jfu.ravel_pytree(system.y0)
    exact = jax.vmap(lambda y0: system.reference(jnp.array([T1]), y0))(start)
    exact = flattened(jax.tree.map(lambda leaf: leaf[:, 0], exact))
    runs = {
        (name, setting): partial(contestant.solve, setting, flat)
        for name, contestant in contestants.items()
        for setting in contestant.settings
    }
    found: dict[str, list[dict[str, float]]] = {name: [] for name in contestants}
    for (name, setting), (seconds, end) in measuring.take_turns(runs, rounds, long=0.5).items():
        error = float(np.max(np.abs(np.asarray(end) - exact)))
        drift = measuring.largest_drift(system, start, jax.vmap(unravel)(jnp.asarray(end)))
        row = dict(setting=setting, seconds=seconds / len(flat), error=error, drift=drift)
        found[name].append(row)
        if name.startswith("projected") and not drift <= MAX_DRIFT:
            raise AssertionError(f"{name} at {setting}: the drift is {drift:.1e}")
    for name, rows in found.items():
        if not rows[-1]["error"] <= rows[0]["error"]:
            raise AssertionError(f"{name}: the error is not that of a solver that converges")
    return found


def time_to(rows: list[dict[str, float]], quantity: str, target: float) -> float | None:
    """Seconds at which `quantity` gets, and stays, at most `target`, between two settings by
    interpolation of the logarithms; `None` if it does not, the first setting if that suffices."""
    above = [i for i, row in enumerate(rows) if not row[quantity] <= target]
    if not above:
        return rows[0]["seconds"]
    if above[-1] == len(rows) - 1:
        return None
    a, b = rows[above[-1]], rows[above[-1] + 1]
    x = math.log(a[quantity] / target) / math.log(a[quantity] / max(b[quantity], 1e-300))
    return math.exp((1 - x) * math.log(a["seconds"]) + x * math.log(b["seconds"]))


def times_to(
    found: Mapping[str, list[dict[str, float]]], error: float
) -> dict[str, dict[str, float | None]]:
    """For each contestant: the time to `error` alone, and to `error` and `MAX_DRIFT`."""
    out: dict[str, dict[str, float | None]] = {}
    for name, rows in found.items():
        excess = [max(row["error"] / error, row["drift"] / MAX_DRIFT) for row in rows]
        with_excess = [row | {"excess": x} for row, x in zip(rows, excess, strict=True)]
        both = time_to(with_excess, "excess", 1.0)
        out[name] = {"error": time_to(rows, "error", error), "error and drift": both}
    return out
