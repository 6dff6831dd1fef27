"""The solves of `compare`: with every list of entries and every metric, and the reference.

To compile a solve takes seconds, so few programs make all of them. An entry that is left out is
zero in the place of its function, which is conserved trivially; which ones are left out, and
the weights of a metric, are numbers that a compiled program is given.
"""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float

from .._custom_types import Args, RealScalarLike, Values
from .._manifold import Constraint, FirstIntegral, slope_of
from .._tree import irregular_weights, ravel, unravel
from .drift import drift

# The tolerances of the two solves that are the reference, in units of the largest values of the
# components. Implicit methods cannot solve their equations more accurately.
_EXPLICIT, _IMPLICIT = (1e-11, 1e-13), (1e-8, 1e-10)
# A component that stays much smaller than what moves it may be the roundoff of that. So it is as
# accurate as if it had this share of what its slope adds in a step without cancellation.
_CANCELLED = 1e-2
# But no component needs to be larger than this share of the largest one: of a stiff slope the terms
# are much larger than anything in the solution.
_SMALL = 1e-3
# By these shares of themselves components are varied, to see the terms of a slope.
_VARIED = 2.0**-10
# An entry that changes less along the reference counts as conserved.
_CHANGES = 1e-8
# The reference takes at most so many steps from a time to the next. An explicit method reaches them
# where the field is stiff.
_REFERENCE_STEPS = 20_000
# A solve is timed at most so often, and not again after so many seconds.
_RUNS, _SECONDS = 5, 0.3


class Task(eqx.Module):
    """What all solves have in common. `y0s` has a leading axis over the lanes."""

    term: dfx.ODETerm
    args: Args
    y0s: Any
    t0: Float[Array, ""]
    t1: Float[Array, ""]
    dt0: Float[Array, ""] | None
    controller: dfx.AbstractStepSizeController
    saveat: dfx.SaveAt
    batch: bool = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)

    def lanes(self, one: Callable[[Any], Any], y0s: Any) -> Any:
        """`one` of each state. A single one is not made a batch, which would be slower."""
        if self.batch:
            return eqx.filter_vmap(one)(y0s)
        found = one(jtu.tree_map(lambda x: x[0], y0s))
        return jtu.tree_map(lambda x: x[None] if eqx.is_array(x) else x, found)


class _Switched(eqx.Module):
    """A function that is zero unless it is kept."""

    fn: Callable[..., Values]
    kept: Bool[Array, ""]

    def __call__(self, t: RealScalarLike, y: Any, args: Args) -> Values:
        return _where(self.kept, self.fn(t, y, args))


def _where(kept: Bool[Array, ""], values: Values) -> Values:
    return jtu.tree_map(lambda x: jnp.where(kept, x, jnp.zeros_like(x)), values)


def switched(entry: Any, kept: bool) -> Any:
    """An entry of a manifold, or one that is zero."""
    flag = jnp.asarray(kept)
    fn = _Switched(entry.fn, flag)
    if isinstance(entry, Constraint):
        return Constraint(fn)
    value = None if entry.value is None else _where(flag, entry.value)
    rate = None if entry.rate is None else _Switched(entry.rate, flag)
    return FirstIntegral(fn, value=value, rate=rate)


@eqx.filter_jit
def _solved(task: Task, solver: dfx.AbstractSolver) -> dfx.Solution:
    def one(y0: Any) -> dfx.Solution:
        return dfx.diffeqsolve(
            task.term, solver, task.t0, task.t1, task.dt0, y0, task.args, saveat=task.saveat,
            stepsize_controller=task.controller, adjoint=dfx.ForwardMode(),
            max_steps=task.max_steps, throw=False,
        )  # fmt: skip

    return task.lanes(one, task.y0s)


def timed(task: Task, solver: dfx.AbstractSolver) -> tuple[dfx.Solution, float]:
    """The solutions, and the seconds of a solve after the compilation."""
    sols, spent = jax.block_until_ready(_solved(task, solver)), []
    while len(spent) < _RUNS and sum(spent) < _SECONDS:
        begun = time.perf_counter()
        jax.block_until_ready(_solved(task, solver))
        spent.append(time.perf_counter() - begun)
    return sols, min(spent) / jtu.tree_leaves(task.y0s)[0].shape[0]


def sizes_of(task: Task, sols: dfx.Solution) -> Any:
    """The largest value of each component as far as it is finite, and at least what roundoff may
    have made of it. The leaves of a state do not matter."""

    def largest(y: Any) -> np.ndarray:
        size = np.abs(np.asarray(y)).astype(float)
        return np.max(size, axis=(0, 1), where=np.isfinite(size), initial=0)

    start = jtu.tree_map(lambda y: y[:, None], task.y0s)
    size = jtu.tree_map(lambda y, x: np.maximum(largest(y), largest(x)), sols.ys, start)
    top = max(np.max(x, initial=0) for x in jtu.tree_leaves(size))
    step = (float(task.t1) - float(task.t0)) / max(np.min(sols.stats["num_steps"]), 1)

    def floored(size: np.ndarray, slope: Any) -> np.ndarray:
        size = np.maximum(size, np.minimum(_CANCELLED * step * largest(slope), _SMALL * top))
        return np.where(size > 0, size, 1.0)

    return jtu.tree_map(floored, size, _varied(task, jnp.asarray(sols.ts), sols.ys))


@eqx.filter_jit
def _varied(task: Task, ts: Array, ys: Any) -> Any:
    """By how much the slopes vary if each component varies by a share of itself, over that share.
    This has the size of the terms of a slope before they cancel, in any units."""

    def at(t: Array, y: Any) -> Any:
        x = ravel(y)
        share = _VARIED * irregular_weights(x.size, x.dtype)
        more, less = (
            slope_of(task.term.vector_field, t, unravel(x * (1 + s), y), task.args)
            for s in (share, -share)
        )
        return jtu.tree_map(lambda a, b: (a - b) / (2 * _VARIED), more, less)

    return jax.vmap(jax.vmap(at))(ts, ys)


@eqx.filter_jit
def _accurate(
    task: Task, solver: dfx.AbstractSolver, ts: Array, sizes: Any, tolerance: Array
) -> Any:
    """The states at the times, NaN from where a solve failed on.

    Each solve ends at one of the times, because dense output is less accurate than steps.
    """

    def norm(error: Any) -> Array:
        scaled = jtu.tree_map(lambda e, s: jnp.max(jnp.abs(e) / s, initial=0), error, sizes)
        return jnp.max(jnp.stack(jtu.tree_leaves(scaled)))

    controller = dfx.PIDController(rtol=0.0, atol=tolerance, norm=norm)

    def step(carry: tuple[Any, Array], interval: tuple[Array, Array]) -> tuple[Any, Any]:
        y, ok = carry
        start, end = interval
        end = jnp.where(ok, end, start)  # after a failure nothing is left to do
        sol = dfx.diffeqsolve(
            task.term, solver, start, end, None, y, task.args, stepsize_controller=controller,
            adjoint=dfx.ForwardMode(), max_steps=_REFERENCE_STEPS, throw=False,
        )  # fmt: skip
        ok = ok & (sol.result == dfx.RESULTS.successful)
        y = jtu.tree_map(lambda x: jnp.where(ok, x[0], jnp.nan), sol.ys)
        return (y, ok), y

    def one(y0: Any) -> Any:
        _, ys = lax.scan(step, (y0, jnp.array(True)), (ts[:-1], ts[1:]))
        return jtu.tree_map(lambda x, xs: jnp.concatenate([x[None], xs]), y0, ys)

    precise = lambda x: x.astype(jnp.promote_types(x.dtype, jnp.float64))  # noqa: E731
    return task.lanes(one, jtu.tree_map(precise, task.y0s))


def references(
    task: Task, solver: dfx.AbstractSolver, ts: np.ndarray, sizes: Any
) -> tuple[Any, Any]:
    """The states of the reference, and those at a tolerance a hundred times as large."""
    implicit = isinstance(solver, dfx.AbstractImplicitSolver)
    rough, accurate = (
        jtu.tree_map(
            np.asarray, _accurate(task, solver, jnp.asarray(ts, float), sizes, jnp.asarray(x))
        )
        for x in (_IMPLICIT if implicit else _EXPLICIT)
    )
    return accurate, rough


@eqx.filter_jit
def _drifts(sols: dfx.Solution, entries: dict[str, Any], args: Args) -> dict[str, Array]:
    found = eqx.filter_vmap(lambda sol: drift(sol, entries, args))(sols)

    def largest(part: Any) -> Array:
        leaves = [jnp.abs(x).reshape(x.shape[0], -1) for x in jtu.tree_leaves(part)]
        return jnp.max(jnp.concatenate(leaves, axis=1), axis=1)

    return {name: largest(part) for name, part in found.items()}


def drifts(task: Task, sols: dfx.Solution, entries: dict[str, Any]) -> dict[str, np.ndarray]:
    """The largest drift of each entry in each lane."""
    if not task.saveat.dense:  # then only the states are needed, which all solvers have alike
        sols = dataclasses.replace(sols, interpolation=None, stats={})
    return {name: np.asarray(x) for name, x in _drifts(sols, entries, task.args).items()}


def not_conserved(
    sols: dfx.Solution, exact: Any, rough: Any, entries: dict[str, Any], args: Args
) -> dict[str, float]:
    """The drifts of the entries that change along the exact solution: as much as along a rough one,
    with errors a hundred times as large, and more than roundoff. Entries with a rate or a value are
    left out: they change, or are not those of the start."""
    plain = {
        name: entry
        for name, entry in entries.items()
        if isinstance(entry, Constraint) or (entry.value is None and entry.rate is None)
    }
    if not plain:
        return {}
    length = jtu.tree_leaves(exact)[0].shape[1]
    ts = jnp.asarray(sols.ts)[:, :length]
    sols = dataclasses.replace(sols, ts=ts, interpolation=None, stats={})
    first, second = (
        _drifts(dataclasses.replace(sols, ys=jtu.tree_map(jnp.asarray, ys)), plain, args)
        for ys in (exact, rough)
    )
    found = {name: (np.max(first[name]), np.max(second[name])) for name in plain}
    return {name: float(a) for name, (a, b) in found.items() if a > max(_CHANGES, b / 2)}
