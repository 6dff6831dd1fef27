"""The verdict for a projection: solves without it and with it, judged by an accurate solve.

This file checks what it is given and says which solvers to compare. The solves themselves are in
`compared_solves.py`; what is judged, the table and the sentence in `comparison.py`; linear
invariants are found in `linear_invariants.py`.
"""

import dataclasses
import functools as ft
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import ArrayLike, PyTree

from .._custom_types import Args, Manifold, RealScalarLike
from .._manifold import check_manifold, check_vector_field, slope_of
from .._options import ONE_STATE, check_counts, check_float64, check_number, dtype_of, noting_call
from .._projection.base import AbstractProjection
from .._solver.manifold_projection import ManifoldProjection
from .check_invariance import entries_of
from .compared_solves import Task, drifts, not_conserved, references, sizes_of, switched, timed
from .comparison import (
    NOTHING,
    WORSE,
    ComparisonReport,
    ComparisonRow,
    by_errors,
    distance,
    judged,
    worsened,
)
from .linear_invariants import changes, linear_invariants

# States are compared at about so many times, evenly spread.
_TIMES = 100
# With more entries than these none is left out.
_LEFT_OUT = 8
# An adaptive solve that must keep its dense output, as balances need it, takes at most so many
# steps.
_DENSE_STEPS = 4096
# What is added to the name of a row with the metric by sizes, or by errors.
_BY_SIZES, _BY_ERRORS = ", metric by sizes", ", metric by errors"


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
    entry left out; each with the default metric, with `metric=1.0`, with $1/\text{size}^2$ of each
    component as its weight, and with the `metric` that you give. The error of a state is judged by
    a solve at a tight tolerance that steps exactly to the times at which states are compared. It is
    the geometric mean over the $n$ components of their largest relative errors so far,

    $$e(t) = \Big(\prod_{k=1}^n
    \frac{\max_{s \le t} |y_k(s) - y^*_k(s)|}{\max_s |y^*_k(s)|}\Big)^{1/n}.$$

    So each component counts as much as any other, and what is said depends neither on units nor on
    how the state is packed into arrays and leaves. Components of which the error without projection
    is roundoff are left out, such as parameters.

    A second solve, at a tolerance a hundred times as large, tells how far this reference can be
    trusted. From the time on at which both differ by more than a third of the smallest error, or
    every error is larger than 0.3, nothing is judged: so chaos is told.

    Taken is the first projection of the table whose error up to then, in the geometric mean over a
    batch, is at most 1.5 times the least and less than 0.9 times that without projection. If there
    is none, the first is taken that has at most 1.1 times that error, also in each component, and
    in no lane 1.5 times, and is said to be for what it keeps only; otherwise no projection is. What
    makes a component more than 3 times less accurate is told, and is taken only if the error falls
    to less than a third. If all entries kept spoil a component so, a metric by errors is tried too:
    the weight of a component is the inverse square of its error without projection. Of more than
    eight entries none is left out.

    A small system takes half a minute, most of it compilation. The time of a solve contains the
    evaluation of the entry that is left out. A linear invariant that nobody declared is a
    combination of components, of at most 300, that the field conserves at states near the solution.

    **Arguments:**

    - `vector_field`, `args`: $f(t, y, args)$, or a `diffrax.ODETerm` of it, and its parameters.
    - `solver`: the solver without projection, such as `diffrax.Tsit5()`.
    - `manifold`: a PyTree of `FirstIntegral`s and `Constraint`s.
    - `y0`: the state at `t0`; or with `batch=True` several ones, stacked along a leading axis. If
        they are in float32, only the reference is in float64.
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

        import diffrax_conserve as dfc
        import jax

        jax.config.update("jax_enable_x64", True)
        system = dfc.systems.Kepler()
        with contextlib.redirect_stdout(None):  # without this it prints the table
            report = dfc.compare(
                system.vector_field, dfc.RK4(), system.manifold, system.y0, t1=20.0, dt0=0.2
            )
        assert report.choice == "all kept"
        ```
    """
    if isinstance(vector_field, dfx.ODETerm):
        vector_field = vector_field.vector_field
    check_vector_field(vector_field)
    check_manifold(manifold)
    _check_solvers(solver, reference)
    check_float64("compare")
    y0s = _stacked(y0, batch)
    first = jtu.tree_map(lambda x: x[0], y0s)
    dtype = jnp.finfo(jnp.result_type(*jtu.tree_leaves(y0s))).dtype
    start = jnp.asarray(t0, dtype)
    with noting_call("`vector_field`", "vector_field(t, y, args)", t0, first, args):
        eqx.filter_eval_shape(lambda y: slope_of(vector_field, start, y, args), first)
    entries = dict(entries_of(manifold))
    dense = any(getattr(entry, "rate", None) is not None for entry in entries.values())
    controller, saveat, ts, most = _steps(t0, t1, dt0, rtol, atol, max_steps, dense, dtype)
    task = Task(
        dfx.ODETerm(vector_field), args, y0s, start, jnp.asarray(t1, dtype),
        None if dt0 is None else jnp.asarray(dt0, dtype), controller, saveat, batch, most,
    )  # fmt: skip
    if projection is None:
        projection = ManifoldProjection(solver, manifold).projection
    metrics = _metrics(projection, metric)
    if reference is None:
        implicit = isinstance(solver, dfx.AbstractImplicitSolver)
        reference = dfx.Kvaerno5() if implicit else dfx.Dopri8()

    variants = ft.partial(_variants, solver, manifold, projection, first)
    report = _report(task, solver, variants, metrics, entries, reference, ts)
    print(report)
    return report


# ---- Before the solves ----


def _check_solvers(solver: Any, reference: Any) -> None:
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
    if reference is not None and not isinstance(reference, dfx.AbstractSolver):
        raise TypeError(
            f"`reference` is {reference!r}, but it must be a diffrax solver with error estimates, "
            "such as `diffrax.Dopri8()`, or `None`."
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


# The controller, what is saved, at which times, and the largest number of steps.
_Steps = tuple[dfx.AbstractStepSizeController, dfx.SaveAt, np.ndarray, int]


def _steps(
    t0: Any, t1: Any, dt0: Any, rtol: Any, atol: Any, max_steps: int, dense: bool, dtype: Any
) -> _Steps:
    check_number("t0", t0, optional=False)
    check_number("t1", t1, above=t0, optional=False)
    check_counts(max_steps=max_steps)
    t0, t1 = float(t0), float(t1)
    if (dt0 is None) == (rtol is None and atol is None):
        raise ValueError(
            "`compare` takes either fixed steps, `dt0=...`, or adaptive ones, `rtol=...` and "
            f"`atol=...`, but {'neither was' if dt0 is None else 'both were'} given."
        )
    if dt0 is not None:
        check_number("dt0", dt0, above=0.0)
        return _fixed(t0, t1, float(dt0), dense)
    if rtol is None or atol is None:
        missing = "rtol" if rtol is None else "atol"
        raise ValueError(f"`{missing}` is missing: adaptive steps need both `rtol` and `atol`.")
    check_number("rtol", rtol, least=0.0)
    check_number("atol", atol, least=0.0)
    ts = np.linspace(t0, t1, _TIMES + 1)
    most = min(max_steps, _DENSE_STEPS) if dense else max_steps
    controller = dfx.PIDController(rtol=float(rtol), atol=float(atol))
    return controller, dfx.SaveAt(ts=jnp.asarray(ts, dtype), dense=dense), ts, most


def _fixed(t0: float, t1: float, dt0: float, dense: bool) -> _Steps:
    """What is saved are ends of steps: to interpolate would compile twice as long."""
    # A bit less, so that roundoff in the quotient does not add a step.
    count = max(1, math.ceil((t1 - t0) / dt0 - 1e-6))
    stride = max(1, count // _TIMES)
    ts = np.minimum(t0 + np.append(np.arange(0, count, stride), count) * dt0, t1)
    saveat = dfx.SaveAt(t0=True, t1=True, steps=stride, dense=dense)
    # The sum of many steps may need another one, as long as roundoff.
    return dfx.ConstantStepSize(), saveat, ts, count + 1


# ---- The variants ----


class _Variant(NamedTuple):
    """One solver to compare: its name, the entries that it keeps, itself for the user, and in the
    form in which it is compiled together with others."""

    name: str
    kept: tuple[str, ...]
    solver: dfx.AbstractSolver
    shared: dfx.AbstractSolver


def _variants(
    solver: dfx.AbstractSolver,
    manifold: Manifold,
    projection: AbstractProjection,
    y0: Any,
    metrics: dict[str, Any],
) -> list[_Variant]:
    """The solvers with projections. Without metrics all entries are kept only."""
    entries, found = dict(entries_of(manifold)), []
    leave_out = metrics and 1 < len(entries) <= _LEFT_OUT
    changed = {name: dataclasses.replace(projection, metric=x) for name, x in metrics.items()}
    for left_out in (None, *(entries if leave_out else ())):
        kept = {name: entry for name, entry in entries.items() if name != left_out}
        part = shared = manifold if left_out is None else kept
        if leave_out:
            shared = {name: switched(entry, name != left_out) for name, entry in entries.items()}
        name = "all kept" if left_out is None else f"all but {left_out}"
        for suffix, chosen in (changed or {"": projection}).items():
            wrapped = ManifoldProjection(solver, part, projection=chosen)
            if suffix:  # weights of all components are one program, whatever the weights
                chosen = dataclasses.replace(chosen, metric=_spread(chosen.metric, y0))
            compiled = ManifoldProjection(solver, shared, projection=chosen)
            found.append(_Variant(name + suffix, tuple(kept), wrapped, compiled))
    return found


def _metrics(projection: Any, metric: Any) -> dict[str, Any] | None:
    """The metrics to try, by what is added to a name; `None` for a projection that has none."""
    if "metric" not in {x.name for x in dataclasses.fields(projection) if x.init}:
        if metric is not None:
            raise ValueError(
                f"`projection` is a `{type(projection).__name__}`, which has no metric. Leave out "
                "`metric`, or pass `SimplifiedNewton`."
            )
        return None
    metric = projection.metric if metric is None else metric
    found = {"": None, ", metric=1.0": 1.0}
    return found if metric is None else found | {", given metric": metric}


def _spread(metric: Any, y0: Any) -> Any:
    """Weights of all components, or the metric as it is if it has matrices."""

    def spread(weight: Any, part: Any) -> Any:
        return jtu.tree_map(
            lambda x: jnp.broadcast_to(jnp.asarray(weight, x.real.dtype), x.shape), part
        )

    try:
        return None if metric is None else jtu.tree_map(spread, metric, y0)
    except (TypeError, ValueError):
        return metric  # with matrices or functions; or it is wrong, and the projection says why


# ---- The solves ----


def _report(
    task: Task,
    solver: dfx.AbstractSolver,
    variants: Callable[[dict[str, Any]], list[_Variant]],
    metrics: dict[str, Any] | None,
    entries: dict[str, Any],
    reference: dfx.AbstractSolver,
    ts: np.ndarray,
) -> ComparisonReport:
    plain, seconds = timed(task, solver)
    length = len(ts)
    known = np.asarray(plain.ts)[0, :length]
    ts = np.where(np.isfinite(known), known, ts)  # sums of steps, with their roundoff
    sizes = sizes_of(task, plain)
    exact, rough = references(task, reference, ts, sizes)
    field = task.term.vector_field
    invariants = linear_invariants(field, jnp.asarray(ts), exact, sizes, task.args, entries)
    states = lambda sols: jtu.tree_map(lambda x: np.asarray(x)[:, :length], sols.ys)  # noqa: E731

    changing = not_conserved(plain, exact, rough, entries, task.args)
    counted = judged(states(plain), exact)

    def told(variant: _Variant, sols: dfx.Solution, seconds: float) -> tuple[ComparisonRow, Any]:
        ys, success = states(sols), np.asarray(sols.result == dfx.RESULTS.successful)
        row = ComparisonRow(
            variant.name, variant.kept, variant.solver, distance(ys, exact, counted),
            success,
            _message(sols, success), drifts(task, sols, entries), changes(invariants, ys, sizes),
            np.asarray(sols.stats["num_steps"]), seconds,
        )  # fmt: skip
        return row, ys

    def tried(metrics: dict[str, Any]) -> list[tuple[ComparisonRow, Any]]:
        return [told(variant, *timed(task, variant.shared)) for variant in variants(metrics)]

    def report_of(found: list[tuple[ComparisonRow, Any]]) -> ComparisonReport:
        rows = tuple(row for row, _ in found)
        doubt = distance(rough, exact, counted)
        report = ComparisonReport(rows, ts, doubt, len(invariants), changing)
        beside = ft.partial(worsened, found[0][1], exact, rough, report.last)
        rows = (dataclasses.replace(row, worsened=beside(ys)) for row, ys in found)
        return dataclasses.replace(report, rows=tuple(rows))

    nothing = told(_Variant(NOTHING, (), solver, solver), plain, seconds)
    by_sizes = {_BY_SIZES: jtu.tree_map(lambda size: size**-2, sizes)}
    found = [nothing, *tried({} if metrics is None else metrics | by_sizes)]
    report = report_of(found)
    # Weights by errors know the solution, so they seem better than they are elsewhere. They are
    # tried only where the projection that keeps all spoils a component.
    if metrics and report.rows[1].worsened[1] > WORSE:
        report = report_of(found + tried({_BY_ERRORS: by_errors(nothing[1], exact)}))
    return report


def _message(sols: dfx.Solution, success: np.ndarray) -> str:
    """Why the first lane failed that did."""
    if success.all():
        return ""
    first = int(np.argmin(success))
    message = dfx.RESULTS[jtu.tree_map(lambda x: x[first], sols.result)]
    return " ".join(message.split()).partition(". ")[0].rstrip(".")
