"""The verdict for a projection: solves without it and with it, judged by an accurate solve.

This file makes the solves. What they are judged by, the table and the sentence are in
`comparison.py`; linear invariants are found in `linear_invariants.py`.
"""

import dataclasses
import math
import time
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from .._custom_types import Args, Manifold, RealScalarLike
from .._manifold import check_manifold, check_vector_field, is_entry, named_entries, slope_of
from .._options import ONE_STATE, calling, check_counts, check_number, dtype_of
from .._projection.base import AbstractProjection
from .._solver.manifold_projection import ManifoldProjection
from .._tree import key_of
from .comparison import NOTHING, ComparisonReport, ComparisonRow, distance
from .drift import drift
from .linear_invariants import changes, linear_invariants

# States are compared at so many times, evenly spread.
_TIMES = 100
# With more entries than these, an entry is left out with the default metric only, or none is. Each
# combination is a program, which takes some two seconds to compile.
_WITH_METRICS, _LEFT_OUT = 3, 8
# The tolerances of the two solves that are the reference, in units of the largest values of the
# components. Implicit methods cannot solve their equations more accurately.
_EXPLICIT, _IMPLICIT = (1e-11, 1e-13), (1e-8, 1e-10)
# A component that stays much smaller than others of its leaf is as accurate as if it had this share
# of their size: what is left of it may be the roundoff of theirs.
_SMALL = 1e-3
# The reference takes at most so many steps. An explicit method reaches them where the field is
# stiff.
_REFERENCE_STEPS = 1_000_000
# An adaptive solve that must keep its dense output can take at most so many steps.
_DENSE_STEPS = 4096
# A solve is timed at most so often, and not again after so many seconds.
_RUNS, _SECONDS = 5, 0.3
# Linear invariants are searched for in states of at most so many components.
_COMPONENTS = 300


def compare(
    vector_field: Callable[[RealScalarLike, Any, Args], Any],
    solver: dfx.AbstractSolver,
    manifold: Manifold,
    y0: PyTree[ArrayLike],
    *,
    t0: float = 0.0,
    t1: float,
    dt0: float | None = None,
    rtol: float | None = None,
    atol: float | None = None,
    args: Args = None,
    batch: bool = False,
    projection: AbstractProjection | None = None,
    metric: PyTree[Any] | None = None,
    reference: dfx.AbstractSolver | None = None,
    max_steps: int = 100_000,
) -> ComparisonReport:
    r"""Prints and returns whether projecting makes a solution better, and says what to keep.

    The equation is solved without projection, with all entries of the manifold kept, and with each
    entry left out; each with the default metric, with `metric=1.0`, and with the `metric` that you
    give. The error of a state is judged by a solve at a tight tolerance that steps exactly to the
    times at which states are compared,

    $$e(t) = \max_{\text{leaves}} \frac{\max_k |y_k(t) - y^*_k(t)|}{\max_{k, t} |y^*_k(t)|}.$$

    A second solve, at a tolerance a hundred times as large, tells how far this reference can be
    trusted. From the time on at which both differ by more than a third of the smallest error, or
    every error is larger than 0.3, nothing is judged: so chaos is told.

    Of more than three entries each is left out with the default metric only, of more than eight
    none is. The solves take half a minute in all for a small system, most of it compilation.

    **Arguments:**

    - `vector_field`, `args`: $f(t, y, args)$, or a `diffrax.ODETerm` of it, and its parameters.
    - `solver`: the solver without projection, such as `diffrax.Tsit5()`.
    - `manifold`: a PyTree of `FirstIntegral`s and `Constraint`s.
    - `y0`: the state at `t0`; or with `batch=True` several ones, stacked along a leading axis.
    - `t0`, `t1`: the interval. Longer ones tell more, up to where errors are as large as the state.
    - `dt0`: the length of fixed steps.
    - `rtol`, `atol`: instead of it, the tolerances of adaptive steps, by a
        [`diffrax.PIDController`][].
    - `batch`: whether `y0` holds several states. Random ones tell more than one does.
    - `projection`: as of [`diffrax_conserve.ManifoldProjection`][]. One without a metric, such as
        [`diffrax_conserve.Staged`][], is compared with all entries only.
    - `metric`: another metric to try, such as physical weights.
    - `reference`: the solver of the reference. Default: [`diffrax.Dopri8`][], or for implicit
        solvers [`diffrax.Kvaerno5`][].
    - `max_steps`: the largest number of adaptive steps.

    **Returns:**

    A [`diffrax_conserve.ComparisonReport`][]. Its `verdict` is one sentence, its `solver` the one
    to take, and `plot()` draws errors against time.

    **Raises:**

    `RuntimeError` unless `jax_enable_x64` is on, because the reference needs float64; `ValueError`
    or `TypeError` if the arguments do not fit together.

    !!! example

        ```python
        import contextlib

        import diffrax
        import diffrax_conserve as dfc
        import jax

        jax.config.update("jax_enable_x64", True)
        system = dfc.systems.Kepler()
        with contextlib.redirect_stdout(None):  # without this it prints the table
            report = dfc.compare(
                system.vector_field, dfc.RK4(), system.manifold, system.y0, t1=20.0, dt0=0.2
            )
        print(report.choice)
        ```
    """
    if isinstance(vector_field, dfx.ODETerm):
        vector_field = vector_field.vector_field
    check_vector_field(vector_field)
    check_manifold(manifold)
    _check_solver(solver)
    _check_float64()
    y0s = _stacked(y0, batch)
    dtype = jnp.finfo(jnp.result_type(*jtu.tree_leaves(y0s))).dtype
    first = jtu.tree_map(lambda x: x[0], y0s)
    with calling("`vector_field`", "vector_field(t, y, args)", t0, first, args):
        eqx.filter_eval_shape(
            lambda y: slope_of(vector_field, jnp.asarray(t0, dtype), y, args), first
        )
    controller, ts, max_steps = _steps(t0, t1, dt0, rtol, atol, max_steps)
    has_rates = any(
        getattr(entry, "rate", None) is not None for _, entry in named_entries(manifold)
    )
    if has_rates:
        max_steps = min(max_steps, _DENSE_STEPS)
    task = _Task(
        dfx.ODETerm(vector_field), args, y0s, jnp.asarray(ts, dtype),
        None if dt0 is None else jnp.asarray(dt0, dtype), controller, batch, has_rates, max_steps,
    )  # fmt: skip
    variants = _variants(solver, manifold, projection, metric, first)
    report = _report(task, variants, entries_of(manifold), reference)
    print(report)
    return report


# ---- Before the solves ----


def _check_solver(solver: Any) -> None:
    if not isinstance(solver, dfx.AbstractSolver):
        raise TypeError(
            f"`solver` is {solver!r}, which is not a diffrax solver. Pass an instance, such as "
            "`diffrax.Tsit5()`."
        )
    if isinstance(solver, ManifoldProjection):
        raise ValueError(
            "`solver` is a `ManifoldProjection`, but `compare` makes those itself. Pass the solver "
            "in it, `solver.solver`, and its `projection`."
        )


def _check_float64() -> None:
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise RuntimeError(
            "`compare` needs float64 for the solve that it judges by. Set the environment variable "
            "`JAX_ENABLE_X64=1`, or call `jax.config.update('jax_enable_x64', True)` before any "
            "array is made. States in float32 may stay so."
        )


def _stacked(y0: Any, batch: bool) -> Any:
    """The states with a leading axis. Raises unless they are floating-point arrays of one dtype."""
    leaves = jtu.tree_leaves(y0)
    if not leaves or not all(jnp.issubdtype(dtype_of(x), jnp.inexact) for x in leaves):
        raise TypeError(
            f"`y0` is {eqx.tree_pformat(y0)}, but it must be a PyTree of floating-point arrays. "
            "Convert it, for example by `jnp.asarray(..., dtype=float)`."
        )
    y0 = jtu.tree_map(jnp.asarray, y0)
    if not batch:
        return jtu.tree_map(lambda x: x[None], y0)
    if len({x.shape[:1] for x in jtu.tree_leaves(y0)} | {()}) != 2:
        raise ValueError(
            f"With `batch=True` the leaves of `y0` must have the same leading axis over the "
            f"states, but `y0` is {eqx.tree_pformat(y0)}. {ONE_STATE}"
        )
    return y0


def _steps(
    t0: float, t1: float, dt0: float | None, rtol: float | None, atol: float | None, max_steps: int
) -> tuple[dfx.AbstractStepSizeController, np.ndarray, int]:
    """The controller, the times at which states are compared, and the largest number of steps.

    With fixed steps these times are ends of steps.
    """
    check_number("t0", t0, optional=False)
    check_number("t1", t1, above=float(t0), optional=False)
    check_counts(max_steps=max_steps)
    if (dt0 is None) == (rtol is None and atol is None):
        given = "both" if dt0 is not None else "neither"
        raise ValueError(
            f"`compare` takes fixed steps, `dt0=...`, or adaptive ones, `rtol=..., atol=...`; "
            f"{given} were given."
        )
    t0, t1 = float(t0), float(t1)
    if dt0 is None:
        for name, value in {"rtol": rtol, "atol": atol}.items():
            if value is None:
                raise ValueError(f"`{name}` is missing: give both `rtol` and `atol`.")
            check_number(name, value, least=0.0)
        assert rtol is not None and atol is not None
        controller = dfx.PIDController(rtol=float(rtol), atol=float(atol))
        return controller, np.linspace(t0, t1, _TIMES + 1), max_steps
    check_number("dt0", dt0, above=0.0)
    # A share of a step less, so that roundoff in the quotient does not add one.
    count = max(1, math.ceil((t1 - t0) / float(dt0) - 1e-6))
    ends = np.unique(np.round(np.linspace(0, count, min(count, _TIMES) + 1)))
    # The sum of many steps may need one more, which is as long as roundoff.
    return dfx.ConstantStepSize(), np.minimum(t0 + ends * float(dt0), t1), count + 2


# ---- The variants ----


def entries_of(manifold: Manifold) -> dict[str, Any]:
    """The entries by name, such as `energy` for `manifold["energy"]`."""
    flat, _ = jtu.tree_flatten_with_path(manifold, is_leaf=is_entry)
    return {".".join(str(key_of(x)) for x in path) or "manifold": entry for path, entry in flat}


def _variants(
    solver: dfx.AbstractSolver,
    manifold: Manifold,
    projection: AbstractProjection | None,
    metric: PyTree[Any] | None,
    y0: Any,
) -> list[tuple[str, tuple[str, ...], dfx.AbstractSolver]]:
    """The name of each solver to compare, what it keeps, and itself; without projection first."""
    entries = entries_of(manifold)
    if projection is None:
        projection = ManifoldProjection(solver, manifold).projection
    found: list[Any] = [(NOTHING, (), solver)]
    projections = _projections(projection, metric, y0)
    lists = {"all kept": (tuple(entries), manifold)}
    if len(projections) > 1 and 1 < len(entries) <= _LEFT_OUT:
        for name in entries:
            rest = {k: v for k, v in entries.items() if k != name}
            lists[f"all but {name}"] = tuple(rest), rest
    for i, (name, (kept, part)) in enumerate(lists.items()):
        for j, (suffix, chosen) in enumerate(projections.items()):
            if i == 0 or j == 0 or len(entries) <= _WITH_METRICS:
                wrapped = ManifoldProjection(solver, part, projection=chosen)
                found.append((name + suffix, kept, wrapped))
    return found


def _projections(projection: Any, metric: Any, y0: Any) -> dict[str, AbstractProjection]:
    """The projection with each metric, by what is added to its name."""
    if not hasattr(projection, "metric"):
        if metric is not None:
            raise ValueError(
                f"`projection` is a `{type(projection).__name__}`, which has no metric. Leave out "
                "`metric`, or pass `SimplifiedNewton`."
            )
        return {"": projection}
    metric = projection.metric if metric is None else metric
    metrics = {"": None, ", metric=1.0": 1.0}
    if metric is not None:
        metrics[", given metric"] = metric
    # Each as weights of all components: so two of them are one program with different numbers.
    return {
        suffix: dataclasses.replace(projection, metric=_spread(value, y0))
        for suffix, value in metrics.items()
    }


def _spread(metric: Any, y0: Any) -> Any:
    """Weights of all components, or the metric as it is if it has matrices."""

    def spread(weight: Any, part: Any) -> Any:
        return jtu.tree_map(
            lambda x: jnp.broadcast_to(jnp.asarray(weight, x.real.dtype), x.shape), part
        )

    try:
        return None if metric is None else jtu.tree_map(spread, metric, y0)
    except (TypeError, ValueError):
        return metric  # the projection knows matrices, and errors better


# ---- The solves ----


class _Task(eqx.Module):
    """What all solves have in common."""

    term: dfx.ODETerm
    args: Args
    y0s: Any
    ts: Float[Array, " times"]
    dt0: Float[Array, ""] | None
    controller: dfx.AbstractStepSizeController
    batch: bool = eqx.field(static=True)
    dense: bool = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)

    def lanes(self, one: Callable[[Any], Any]) -> Any:
        """`one` of each state. A single one is not made a batch, which would be slower."""
        if self.batch:
            return eqx.filter_vmap(one)(self.y0s)
        found = one(jtu.tree_map(lambda x: x[0], self.y0s))
        return jtu.tree_map(lambda x: x[None] if eqx.is_array(x) else x, found)


@eqx.filter_jit
def _solved(task: _Task, solver: dfx.AbstractSolver) -> dfx.Solution:
    def one(y0: Any) -> dfx.Solution:
        return dfx.diffeqsolve(
            task.term, solver, task.ts[0], task.ts[-1], task.dt0, y0, task.args,
            saveat=dfx.SaveAt(ts=task.ts, dense=task.dense), stepsize_controller=task.controller,
            adjoint=dfx.ForwardMode(), max_steps=task.max_steps, throw=False,
        )  # fmt: skip

    return task.lanes(one)


@eqx.filter_jit
def _accurate(task: _Task, solver: dfx.AbstractSolver, units: Any, tolerance: Array) -> Any:
    """The states of the reference, NaN where it failed."""

    def norm(error: Any) -> Array:
        scaled = jtu.tree_map(lambda e, u: jnp.max(jnp.abs(e) / u, initial=0), error, units)
        return jnp.max(jnp.stack(jtu.tree_leaves(scaled)))

    def one(y0: Any) -> Any:
        # Dense output is less accurate than the steps, so these end at the saved times.
        controller = dfx.PIDController(rtol=0.0, atol=tolerance, norm=norm)
        ts = task.ts.astype(float)
        return dfx.diffeqsolve(
            task.term, solver, ts[0], ts[-1], None, y0, task.args, saveat=dfx.SaveAt(ts=ts),
            stepsize_controller=dfx.ClipStepSizeController(controller, step_ts=ts),
            adjoint=dfx.ForwardMode(), max_steps=_REFERENCE_STEPS, throw=False,
        ).ys  # fmt: skip

    precise = lambda x: x.astype(jnp.promote_types(x.dtype, float))  # noqa: E731
    task = dataclasses.replace(task, y0s=jtu.tree_map(precise, task.y0s))
    return task.lanes(one)


@eqx.filter_jit
def _drifts(sols: dfx.Solution, entries: dict[str, Any], args: Args) -> dict[str, Array]:
    """The largest drift of each entry in each lane."""
    found = eqx.filter_vmap(lambda sol: drift(sol, entries, args))(sols)
    return {
        name: jnp.max(
            jnp.stack([jnp.max(jnp.abs(x.reshape(len(x), -1)), axis=1) for x in jtu.tree_leaves(part)]),
            axis=0,
        )
        for name, part in found.items()
    }  # fmt: skip


def _timed(task: _Task, solver: dfx.AbstractSolver) -> tuple[dfx.Solution, float]:
    """The solutions, and the seconds of a solve after the compilation."""
    sols, spent = jax.block_until_ready(_solved(task, solver)), []
    while len(spent) < _RUNS and sum(spent) < _SECONDS:
        begun = time.perf_counter()
        jax.block_until_ready(_solved(task, solver))
        spent.append(time.perf_counter() - begun)
    return sols, min(spent) / jtu.tree_leaves(task.y0s)[0].shape[0]


def _report(
    task: _Task,
    variants: list[tuple[str, tuple[str, ...], dfx.AbstractSolver]],
    entries: dict[str, Any],
    reference: Any,
) -> ComparisonReport:
    """Solves by each variant, the first of them without projection."""
    plain = _timed(task, variants[0][2])
    sizes = _sizes(task.y0s, plain[0].ys)
    exact, rough = _references(task, variants[0][2], reference, sizes)
    invariants = _invariants(task, exact, sizes, entries)
    rows = []
    for name, kept, solver in variants:
        sols, seconds = plain if solver is variants[0][2] else _timed(task, solver)
        ys = jtu.tree_map(np.asarray, sols.ys)
        success = np.asarray(sols.result == dfx.RESULTS.successful)
        failed = np.flatnonzero(~success)
        message = ""
        if failed.size:
            result = jtu.tree_map(lambda x: x[failed[0]], sols.result)
            message = " ".join(dfx.RESULTS[result].split()).partition(". ")[0]
        drifts = _drifts(sols, entries, task.args)
        rows.append(
            ComparisonRow(
                name,
                kept,
                solver,
                distance(ys, exact),
                success,
                message,
                {key: np.asarray(value) for key, value in drifts.items()},
                changes(invariants, ys, sizes),
                np.asarray(sols.stats["num_steps"]),
                seconds,
            )  # fmt: skip
        )
    ts = np.asarray(task.ts, float)
    return ComparisonReport(tuple(rows), ts, distance(rough, exact), len(invariants))


def _sizes(y0s: Any, ys: Any) -> Any:
    """The largest value of each component so far as it is finite, and at least a share of that of
    its leaf."""

    def largest(y0: Any, y: Any) -> np.ndarray:
        size = np.nan_to_num(np.abs(np.asarray(y)), nan=0, posinf=0).max(axis=(0, 1))
        size = np.maximum(size, np.abs(np.asarray(y0)).max(axis=0))
        top = size.max(initial=0)
        return np.maximum(size, _SMALL * top if top > 0 else 1.0).astype(float)

    return jtu.tree_map(largest, y0s, ys)


def _references(task: _Task, solver: Any, reference: Any, sizes: Any) -> tuple[Any, Any]:
    """The states of the reference, and those at a tolerance a hundred times as large."""
    implicit = isinstance(solver, dfx.AbstractImplicitSolver)
    if reference is None:
        reference = dfx.Kvaerno5() if implicit else dfx.Dopri8()
    implicit = isinstance(reference, dfx.AbstractImplicitSolver)
    rough, tight = (
        jtu.tree_map(np.asarray, _accurate(task, reference, sizes, jnp.asarray(tolerance)))
        for tolerance in (_IMPLICIT if implicit else _EXPLICIT)
    )
    return tight, rough


def _invariants(task: _Task, exact: Any, sizes: Any, entries: dict[str, Any]) -> np.ndarray:
    """The linear invariants that nobody declared; none in a state that is too large."""
    if sum(map(np.size, jtu.tree_leaves(sizes))) > _COMPONENTS:
        return np.zeros((0, 0))
    return linear_invariants(task.term.vector_field, task.ts, exact, sizes, task.args, entries)
