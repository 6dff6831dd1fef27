"""Assertions that a solution, or a state, lies on its manifold."""

import functools as ft
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Real

from .._balance import refuse_rates
from .._custom_types import Args, Manifold, RealScalarLike, Values, Y
from .._manifold import check_manifold, conserved_values, evaluate, has_value, named_entries
from .._numerics.problem import residuals_and_scales
from .._options import check_solution
from .._projection.project import given_values
from .._tree import ravel, tree_all_finite

# Twice the default tolerance of a projection, because the residual is evaluated again here.
_ULPS = 32
# The largest number of constraints that a message shows, and what it ends with.
_SHOWN = 5
_ADVICE = (
    "To look at: is the solver wrapped, `ManifoldProjection(solver, manifold)`, with this "
    "manifold? Does a single or initial state need `diffrax_conserve.project`? Are `t` and `args` "
    "those of the solve? Is anything in a lower precision? Does the equation conserve it "
    "(`diffrax_conserve.check_invariance`)? Where dense output is wrong and saved states hold, the "
    "solver's interpolation is not projected; `SaveAt(ts=...)` and events use it too."
)


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
        term, saveat = diffrax.ODETerm(system.vector_field), diffrax.SaveAt(t0=True, steps=True)
        solver = dfc.ManifoldProjection(diffrax.Tsit5(), system.manifold)
        sol = diffrax.diffeqsolve(term, solver, 0.0, 1.0, 0.1, system.y0, saveat=saveat)
        dct.assert_conserved(sol, system.manifold)
        ```
    """
    check_solution(solution, "assert_conserved")
    check_manifold(manifold)
    refuse_rates(manifold, "`assert_conserved`, unlike `diffrax_conserve.drift`,")
    _refuse_unsuccessful(solution)
    sampled = _sampled(solution, num_dense)
    axes = jnp.ndim(solution.t0)  # of the batch

    def flat(tree: Any, axes: int) -> Any:
        return jtu.tree_map(lambda x: jnp.reshape(x, (-1, *jnp.shape(x)[axes:])), tree)

    if y0 is None:
        _, ts, ys = sampled[0]
        alone = [name for name, entry in named_entries(manifold) if not has_value(entry)]
        if ts.shape[-1] == 1 and alone:
            raise ValueError(
                f"`solution` holds one saved state, with nothing to compare `{alone[0]}` with. "
                "Pass `y0=...`, or save the initial state too, as in `SaveAt(t0=True, t1=True)`."
            )
        start = jtu.tree_map(lambda x: jnp.take(x, 0, axes), (ts, ys))
    else:
        start = solution.t0, y0
    for kind, ts, ys in sampled:
        rows, count = flat((ts, ys), axes + 1), ts.shape[-1]
        starts = jtu.tree_map(lambda x, n=count: jnp.repeat(x, n, axis=0), flat(start, axes))
        found = _measure(manifold, None, *rows, *starts, args)
        _check(_Samples(kind, ts.shape, rtol, atol, *rows, *map(np.asarray, found)), manifold, args)


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
    row = jtu.tree_map(lambda x: x[None], (t, y))
    found = _measure(manifold, values, *row, *row, args)
    _check(_Samples("given", (1,), rtol, atol, *row, *map(np.asarray, found)), manifold, args)


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
        "To look at: the step size and `max_steps`. If it is meant to fail, look at its `result`."
    )


def _sampled(solution: dfx.Solution, num_dense: int) -> list[tuple[str, Array, Any]]:
    """The kind, times and states of each set of states in a solution."""
    kinds = []
    if solution.ts is not None and solution.ys is not None:
        if not eqx.is_array(solution.ts):
            raise ValueError(
                "`solution` has states saved by several `SubSaveAt`s. Check one of them at a time: "
                "`dataclasses.replace(solution, ts=solution.ts[0], ys=solution.ys[0])`."
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


# ---- What is there ----


class _Samples(NamedTuple):
    """The `m` scalar constraints at each time of each lane of a batch."""

    kind: str  # "saved state", "dense output" or "given"
    shape: tuple[int, ...]  # of the batch, and the number of times; together the rows
    rtol: RealScalarLike | None
    atol: RealScalarLike
    ts: Real[Array, " rows"]
    ys: Any
    finite: Bool[np.ndarray, " rows"]  # whether the state is
    residual: Real[np.ndarray, "rows m"]
    scale: Real[np.ndarray, "rows m"]
    found: Real[np.ndarray, "rows m"]
    target: Real[np.ndarray, "rows m"]

    @property
    def precision(self) -> Any:
        """That of the coarsest dtype in the state."""
        return max((jnp.finfo(x.dtype) for x in jtu.tree_leaves(self.ys)), key=lambda i: i.eps)

    @property
    def limit(self) -> Real[np.ndarray, "rows m"]:
        rtol = _ULPS * float(self.precision.eps) if self.rtol is None else self.rtol
        return np.asarray(rtol * self.scale.astype(np.float64) + self.atol)

    @property
    def violated(self) -> Bool[np.ndarray, "rows m"]:
        """NaN never satisfies a constraint."""
        return ~(np.isfinite(self.limit) & (np.abs(self.residual) <= self.limit))

    def place(self, row: int) -> str:
        *lane, k = map(int, np.unravel_index(row, self.shape))
        rows = np.sum(~np.isinf(self.ts.reshape(self.shape)[tuple(lane)]))
        of_batch = f", lane {tuple(lane)}" if lane else ""
        return f"at time {self.ts[row]:.9g} ({self.kind}, row {k} of {rows}{of_batch})"

    def state(self, row: int) -> Any:
        return jtu.tree_map(lambda y: np.asarray(y)[row], self.ys)

    def text(self, row: int) -> str:
        with np.printoptions(precision=9, threshold=20):
            return " ".join(str(self.state(row)).split())


@eqx.filter_jit
@ft.partial(eqx.filter_vmap, in_axes=(None, None, 0, 0, 0, 0, None))
def _measure(
    manifold: Manifold, values: Values | None, t: Array, y: Any, t0: Array, y0: Any, args: Args
) -> tuple[Array, ...]:
    """Of one row: whether the state is finite, the residuals and their scales, the values and what
    they must be. A padded row is treated as the initial state."""
    padded = jnp.isinf(t)
    t, y = jtu.tree_map(lambda a, b: jnp.where(padded, b.astype(a.dtype), a), (t, y), (t0, y0))
    target = conserved_values(manifold, t0, y0, args) if values is None else values
    _, initial_scale = residuals_and_scales(manifold, target, t0, y0, args)
    residual, scale = map(ravel, residuals_and_scales(manifold, target, t, y, args))
    return (
        tree_all_finite((t, y)),
        jnp.where(padded, 0, residual),
        jnp.maximum(scale, ravel(initial_scale)),
        ravel(evaluate(manifold, t, y, args)),
        ravel(target),
    )


# ---- What is wrong ----


def _check(s: _Samples, manifold: Manifold, args: Args) -> None:
    """Raises an `AssertionError` unless every state is finite and satisfies every constraint."""
    if not np.all(s.finite):
        row = int(np.argmin(s.finite))
        raise AssertionError(
            f"The state is not finite {s.place(row)}: {s.text(row)}.\n"
            "To look at: a failed projection gives NaN in dense output; in saved states it comes "
            "from the vector field or from the solver."
        )
    failed = np.flatnonzero(s.violated.any(axis=0)).tolist()
    if not failed:
        return
    names = _names(manifold, s.ts[0], s.state(0), args)
    lines = ["The state leaves the manifold."]
    for i in failed[:_SHOWN]:
        lines += _description(s, i, names[i])
    if len(failed) > _SHOWN:
        lines.append(f"... and {len(failed) - _SHOWN} more scalar constraints.")
    raise AssertionError("\n".join([*lines, _ADVICE]))


def _names(manifold: Manifold, t: Array, y: Y, args: Args) -> list[str]:
    """The name of each scalar constraint."""
    return [
        name + jtu.keystr(path) + (str(list(index)) if index else "")
        for name, entry in named_entries(manifold)
        for path, leaf in jtu.tree_leaves_with_path(eqx.filter_eval_shape(entry.fn, t, y, args))
        for index in np.ndindex(leaf.shape)
    ]


def _description(s: _Samples, i: int, name: str) -> list[str]:
    row = int(np.argmax(s.violated[:, i]))
    residual, scale, target = (float(x[row, i]) for x in (s.residual, s.scale, s.target))
    units = abs(residual) / (float(s.precision.eps) * (scale if scale > 0 else 1))
    must = f"stay {target!r}" if target else "be 0"
    return [
        f"`{name}` first {s.place(row)}:",
        f"    it is {float(s.found[row, i])!r}, but must {must}",
        f"    residual {residual:.3e} = {units:.3g} units of roundoff ({s.precision.dtype}) of its "
        f"scale {scale:.3g}; tolerance {s.limit[row, i]:.3e}",
        f"    state {s.text(row)}",
        f"    violated in {np.sum(s.violated[:, i])} of {np.sum(~np.isinf(s.ts))} rows",
    ]
