"""Assertions that a solution, or a state, lies on its manifold."""

from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Real

from .._balance import refuse_rates
from .._custom_types import Args, Manifold, RealScalarLike, Values, Y
from .._manifold import (
    Constraint,
    FirstIntegral,
    check_manifold,
    conserved_values,
    evaluate,
    is_entry,
    named_entries,
)
from .._projection.equations import measure as residuals
from .._projection.project import given_values
from .._tree import tree_all_finite

# Twice the default tolerance of a projection, because the residual is evaluated again here.
ULPS = 32
# The largest number of constraints that a message shows.
_SHOWN = 5


def assert_conserved(
    solution: dfx.Solution,
    manifold: Manifold,
    args: Args = None,
    *,
    y0: Y | None = None,
    rtol: RealScalarLike | None = None,
    atol: RealScalarLike = 0.0,
    num_dense: int = 101,
) -> None:
    r"""Asserts that a solution stays on a manifold, at each saved time and in dense output.

    At $(t_k, y_k)$ the residual of each scalar constraint is at most $atol + rtol \cdot s_k$. The
    scale $s_k$, to which roundoff is proportional, is the larger value of
    $|I_0| + \sum_i |y_i\, \partial I/\partial y_i|$ at $(t_k, y_k)$ and at the initial state.

    **Arguments:**

    - `solution`: the solution from `diffrax.diffeqsolve`, or from `jax.vmap` of it: each lane is
        checked. Rows that diffrax padded (times `inf`) are ignored.
    - `manifold`: a PyTree of [`diffrax_conserve.FirstIntegral`][]s and
        [`diffrax_conserve.Constraint`][]s.
    - `args`: as given to `diffeqsolve`; the same in every lane.
    - `y0`: the initial state, which defines the conserved values. Default: the first saved state.
    - `rtol`, `atol`: tolerances. Default: 32 units of roundoff of the coarsest dtype in the state,
        twice what a projection accepts, and 0.
    - `num_dense`: the number of evenly spaced times at which dense output, if present, is checked.

    **Raises:**

    `AssertionError` if the solve did not succeed, if a state is infinite or NaN, or if a constraint
    is violated. Its message names the constraint, the place, the violation in units of roundoff,
    and likely causes. `ValueError` if there is nothing to check.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import diffrax_conserve.testing as dct

        system = dfc.systems.RigidBody()
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(system.vector_field),
            dfc.ManifoldProjection(diffrax.Tsit5(), system.manifold),
            t0=0.0,
            t1=1.0,
            dt0=0.1,
            y0=system.y0,
            saveat=diffrax.SaveAt(t0=True, steps=True),
        )
        dct.assert_conserved(solution, system.manifold)
        ```
    """
    check_manifold(manifold)
    refuse_rates(manifold, "`assert_conserved`, unlike `diffrax_conserve.drift`,")
    _refuse_unsuccessful(solution)
    lanes = jnp.shape(solution.t0)
    reference = None if y0 is None else (solution.t0, jtu.tree_map(jnp.asarray, y0))
    samples = []
    for kind, ts, ys in _sampled(solution, num_dense):
        if reference is None:
            first = (slice(None),) * len(lanes) + (0,)
            reference = jtu.tree_map(lambda x, first=first: x[first], (ts, ys))
            _check_comparable(ts, manifold)
        batch = jtu.tree_map(
            lambda x: jnp.reshape(x, (-1, *x.shape[len(lanes) :])), (ts, ys, *reference)
        )
        samples.append(_measured(kind, lanes, manifold, None, batch, args, rtol, atol))
    _report(samples)


def assert_on_manifold(
    manifold: Manifold,
    y: Y,
    *,
    t: RealScalarLike = 0.0,
    args: Args = None,
    value: Values | None = None,
    rtol: RealScalarLike | None = None,
    atol: RealScalarLike = 0.0,
) -> None:
    """Asserts that one state lies on a manifold.

    **Arguments:**

    - `manifold`: a PyTree of [`diffrax_conserve.FirstIntegral`][]s and
        [`diffrax_conserve.Constraint`][]s.
    - `y`: the state; for several, use a loop, or a solution and `assert_conserved`.
    - `t`, `args`: passed to the functions of the manifold.
    - `value`: the conserved values, as in [`diffrax_conserve.project`][]. Not needed if each
        `FirstIntegral` has its own `value`.
    - `rtol`, `atol`: as in [`diffrax_conserve.testing.assert_conserved`][].

    **Raises:**

    `AssertionError` if the state is infinite or NaN, or violates a constraint; `ValueError` if a
    conserved value is missing or does not fit.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import diffrax_conserve.testing as dct
        import jax.numpy as jnp

        circle = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - 1)
        dct.assert_on_manifold(circle, jnp.array([0.6, 0.8]))
        ```
    """
    check_manifold(manifold)
    y = jtu.tree_map(jnp.asarray, y)
    t = jnp.asarray(t, jnp.result_type(float))
    values = given_values(manifold, value, t, y, args)
    ts, ys = t[None], jtu.tree_map(lambda x: x[None], y)
    batch = jtu.tree_map(lambda x: x[None], (ts, ys, t, y))
    _report([_measured("given", (), manifold, values, batch, args, rtol, atol)])


# ---- Where to look ----


def _refuse_unsuccessful(solution: dfx.Solution) -> None:
    failed = ~np.asarray(dfx.is_okay(solution.result))
    if not np.any(failed):
        return
    lane = tuple(int(i) for i in np.argwhere(failed)[0])
    which = f" in {np.sum(failed)} of {failed.size} lanes, first in lane {lane}" if lane else ""
    message = dfx.RESULTS[jtu.tree_map(lambda x: x[lane], solution.result)].strip()
    raise AssertionError(
        f"The solve did not succeed{which}, so there is nothing to check:\n  {message}\n"
        "To look at: `solution.result`, the step size and `max_steps`; where the failure is meant, "
        "assert that `solution.result` is what it should be."
    )


def _sampled(solution: dfx.Solution, num_dense: int) -> list[tuple[str, Array, Any]]:
    """The kind, times and states of each set of states in a solution."""
    kinds = []
    if solution.ts is not None and solution.ys is not None:
        if not eqx.is_array(solution.ts):
            raise ValueError(
                "`solution` has states saved by several `SubSaveAt`s. Check one of them at a time: "
                "`equinox.tree_at(lambda s: (s.ts, s.ys), solution, (solution.ts[0], "
                "solution.ys[0]))`."
            )
        kinds.append(("saved state", solution.ts, solution.ys))
    if solution.interpolation is not None:
        kinds.append(("dense output", *_dense(solution, num_dense)))
    if not kinds or any(ts.shape[-1] == 0 for _, ts, _ in kinds):
        raise ValueError(
            "`solution` holds no states to check. Save some, for example with "
            "`saveat=SaveAt(t0=True, steps=True)` or `SaveAt(dense=True)`."
        )
    return kinds


@eqx.filter_jit
def _dense(solution: dfx.Solution, num: int) -> tuple[Array, Any]:
    def lane(path: Any) -> tuple[Array, Any]:
        ts = jnp.linspace(path.t0, path.t1, num)
        return ts, jax.vmap(path.evaluate)(ts)

    for _ in jnp.shape(solution.t0):
        lane = eqx.filter_vmap(lane)
    return lane(solution.interpolation)


def _check_comparable(ts: Array, manifold: Manifold) -> None:
    for name, entry in named_entries(manifold):
        if isinstance(entry, FirstIntegral) and entry.value is None and ts.shape[-1] == 1:
            raise ValueError(
                f"`solution` holds one saved state, with nothing to compare `{name}` with. Pass "
                "`y0=...`, or save the initial state too, as in `SaveAt(t0=True, t1=True)`."
            )


# ---- What is there ----


class _Samples(NamedTuple):
    """The `m` scalar constraints at each time of each lane."""

    kind: str  # "saved state", "dense output" or "given"
    lanes: tuple[int, ...]  # the shape of the batch, whose lanes have one axis in the following
    ts: Real[np.ndarray, "lanes times"]
    ys: Any
    finite: Bool[np.ndarray, "lanes times"]  # whether the state is
    labels: list[tuple[str, bool]]  # of each constraint: its name, and if it is a `Constraint`
    residual: Real[np.ndarray, "lanes times m"]
    scale: Real[np.ndarray, "lanes times m"]
    found: Real[np.ndarray, "lanes times m"]
    target: Real[np.ndarray, "lanes m"]
    limit: Real[np.ndarray, "lanes times m"]
    eps: float  # the unit of roundoff of the coarsest dtype

    @property
    def violated(self) -> Bool[np.ndarray, "lanes times m"]:
        """NaN never satisfies a constraint."""
        return ~(np.isfinite(self.limit) & (np.abs(self.residual) <= self.limit))

    def place(self, lane: int, k: int) -> str:
        time = f"at time {self.ts[lane, k]:.9g}"
        if self.kind == "given":
            return time
        index = tuple(int(i) for i in np.unravel_index(lane, self.lanes)) if self.lanes else ()
        rows = np.sum(~np.isinf(self.ts[lane]))
        return f"{time} ({self.kind}, row {k} of {rows}" + f", lane {index}" * bool(index) + ")"

    def state(self, lane: int, k: int) -> str:
        with np.printoptions(precision=9, threshold=20):
            return " ".join(str(jtu.tree_map(lambda y: np.asarray(y)[lane, k], self.ys)).split())


def _measured(
    kind: str,
    lanes: tuple[int, ...],
    manifold: Manifold,
    values: Values | None,
    batch: tuple[Array, Any, Array, Any],
    args: Args,
    rtol: RealScalarLike | None,
    atol: RealScalarLike,
) -> _Samples:
    ts, ys = batch[:2]
    t, y = jtu.tree_map(lambda x: x[0, 0], (ts, ys))
    shapes = eqx.filter_eval_shape(evaluate, manifold, t, y, args)
    eps = max(float(jnp.finfo(x.dtype).eps) for x in jtu.tree_leaves((y, shapes)))
    found = map(np.asarray, _measure(manifold, values, batch, args))
    finite, residual, scale, found, target = found
    limit = np.asarray((ULPS * eps if rtol is None else rtol) * scale.astype(np.float64) + atol)
    return _Samples(
        kind, lanes, np.asarray(ts), ys, finite, _labels(manifold, shapes), residual, scale, found,
        target, limit, eps,
    )  # fmt: skip


@eqx.filter_jit
def _measure(
    manifold: Manifold, values: Values | None, batch: tuple[Array, Any, Array, Any], args: Args
) -> tuple[Array, ...]:
    """In each lane `(ts, ys, t0, y0)` whether the states are finite, the residuals and their
    scales, the values and what they must be. Padded rows are treated as the initial state."""

    def of_lane(ts: Array, ys: Any, t0: Array, y0: Any) -> tuple[Array, ...]:
        target = conserved_values(manifold, t0, y0, args) if values is None else values
        _, initial_scale = residuals(manifold, target, t0, y0, args)

        def at(t: Array, y: Y) -> tuple[Array, ...]:
            padded = jnp.isinf(t)
            t = jnp.where(padded, t0.astype(t.dtype), t)
            y = jtu.tree_map(lambda a, b: jnp.where(padded, b, a), y, y0)
            residual, scale = residuals(manifold, target, t, y, args)
            residual = jnp.where(padded, 0, _vector(residual))
            scale = jnp.maximum(_vector(scale), _vector(initial_scale))
            found = _vector(evaluate(manifold, t, y, args))
            return tree_all_finite((t, y)), residual, scale, found

        return *jax.vmap(at)(ts, ys), _vector(target)

    return jax.vmap(of_lane)(*batch)


def _vector(values: Values) -> Real[Array, " m"]:
    with jax.numpy_dtype_promotion("standard"):
        return ravel_pytree(values)[0]


def _labels(manifold: Manifold, values: Any) -> list[tuple[str, bool]]:
    """The name of each scalar constraint, and whether it is one of a `Constraint`."""

    def kinds(entry: FirstIntegral | Constraint, value: Any) -> Any:
        return jtu.tree_map(lambda _: isinstance(entry, Constraint), value)

    found = jtu.tree_leaves(jtu.tree_map(kinds, manifold, values, is_leaf=is_entry))
    leaves = jtu.tree_flatten_with_path(values)[0]
    return [
        (f"manifold{jtu.keystr(path)}" + f"[{', '.join(map(str, index))}]" * bool(index), kind)
        for (path, value), kind in zip(leaves, found, strict=True)
        for index in np.ndindex(value.shape)
    ]


# ---- What is wrong ----


def _report(samples: list[_Samples]) -> None:
    """Raises an `AssertionError` unless every state is finite and satisfies every constraint."""
    for s in samples:
        if not np.all(s.finite):
            lane, k = map(int, np.argwhere(~s.finite)[0])
            raise AssertionError(
                f"The state is not finite {s.place(lane, k)}: {s.state(lane, k)}.\n"
                "To look at: a failed projection gives NaN in dense output; in saved states it "
                "comes from the vector field or from the solver."
            )
    violated = [(s, i) for s in samples for i in np.flatnonzero(s.violated.any(axis=(0, 1)))]
    failed = [(s, int(i)) for s, i in violated]
    if not failed:
        return
    lines = ["The state leaves the manifold."]
    for s, i in failed[:_SHOWN]:
        lines += _description(s, i)
    if len(failed) > _SHOWN:
        lines.append(f"... and {len(failed) - _SHOWN} more scalar constraints.")
    raise AssertionError("\n".join([*lines, f"To look at: {_advice(samples, failed)}"]))


def _description(s: _Samples, i: int) -> list[str]:
    name, is_constraint = s.labels[i]
    lane, k = map(int, np.argwhere(s.violated[..., i])[0])
    residual, scale = (float(x[lane, k, i]) for x in (s.residual, s.scale))
    units = abs(residual) / (s.eps * (scale if scale > 0 else 1))
    precision = "float64" if s.eps < 1e-10 else f"a unit of roundoff of {s.eps:.1e}"
    must = "must be 0" if is_constraint else f"must stay {float(s.target[lane, i])!r}"
    lines = [
        f"`{name}` first {s.place(lane, k)}:",
        f"    it is {float(s.found[lane, k, i])!r}, but {must}",
        f"    residual {residual:.3e} = {units:.3g} units of roundoff ({precision}) of its scale "
        f"{scale:.3g}; tolerance {s.limit[lane, k, i]:.3e}",
        f"    state {s.state(lane, k)}",
    ]
    if s.kind != "given":
        rows = np.sum(~np.isinf(s.ts))
        lines.append(f"    violated in {np.sum(s.violated[..., i])} of {rows} rows")
    return lines


def _advice(samples: list[_Samples], failed: list[tuple[_Samples, int]]) -> str:
    kinds = {s.kind for s, _ in failed}
    if kinds == {"given"}:
        return "was the state projected (`diffrax_conserve.project`), and with this `t` and `args`?"
    if kinds == {"dense output"} and len(samples) > 1:
        return (
            "saved states hold and dense output does not: the solver's interpolation is not "
            "projected. `SaveAt(ts=...)` and events use it too."
        )
    if all(s.labels[i][1] and s.violated[:, 0, i].any() for s, i in failed):
        return (
            "the first state violates the constraint. Project it: "
            "`y0, info = diffrax_conserve.project(manifold, y0)`."
        )
    return (
        "is the solver wrapped, `ManifoldProjection(solver, manifold)`, with this manifold? Are "
        "`args` those of the solve? Is anything in a lower precision? Does the equation conserve "
        "it (`diffrax_conserve.check_invariance`)?"
    )
