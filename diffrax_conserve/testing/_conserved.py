"""Assertions that a solution, or a state, lies on its manifold."""

from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Real

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
from ._report import Sample, report_constraints, unsuccessful

# Twice the default tolerance of a projection, because the residual is evaluated again here.
ULPS = 32


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
    kinds = _sampled(solution, num_dense)
    lanes = jnp.shape(solution.t0)
    reference = None if y0 is None else (solution.t0, jtu.tree_map(jnp.asarray, y0))
    samples = []
    for kind, ts, ys in kinds:
        if reference is None:
            first = (slice(None),) * len(lanes) + (0,)
            reference = jtu.tree_map(lambda x, first=first: x[first], (ts, ys))
            _check_comparable(ts, manifold)
        batch = jtu.tree_map(
            lambda x: jnp.reshape(x, (-1, *x.shape[len(lanes) :])), (ts, ys, *reference)
        )
        measured = _measure_lanes(manifold, None, batch, args)
        samples += _samples(manifold, kind, lanes, batch[:2], measured, args, rtol, atol)
    report_constraints(samples)


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
    lane = jtu.tree_map(lambda x: x[None], (ts, ys, t, y))
    measured = _measure_lanes(manifold, values, lane, args)
    report_constraints(_samples(manifold, "given", (), lane[:2], measured, args, rtol, atol))


class Measured(NamedTuple):
    """The `m` scalar constraints of a manifold at each time, in each lane after `jax.vmap`."""

    residual: Real[Array, "*lanes times m"]
    scale: Real[Array, "*lanes times m"]
    found: Real[Array, "*lanes times m"]
    target: Real[Array, "*lanes m"]
    finite: Bool[Array, "*lanes times"]  # whether the state is finite


@eqx.filter_jit
def _measure_lanes(
    manifold: Manifold, values: Values | None, lanes: tuple[Array, Any, Array, Any], args: Args
) -> Measured:
    return jax.vmap(lambda lane: measure(manifold, values, lane, args))(lanes)


def measure(
    manifold: Manifold,
    values: Values | None,
    lane: tuple[Real[Array, " times"], Any, Real[Array, ""], Any],
    args: Args,
) -> Measured:
    """The residuals and their scales in a lane `(ts, ys, t0, y0)`; padded rows are treated as the
    initial state."""
    ts, ys, t0, y0 = lane
    target = conserved_values(manifold, t0, y0, args) if values is None else values
    _, initial_scale = residuals(manifold, target, t0, y0, args)

    def at(t: Array, y: Y) -> tuple[Array, Array, Array, Array]:
        padded = jnp.isinf(t)
        t = jnp.where(padded, t0.astype(t.dtype), t)
        y = jtu.tree_map(lambda a, b: jnp.where(padded, b, a), y, y0)
        found = evaluate(manifold, t, y, args)
        residual, scale = residuals(manifold, target, t, y, args)
        residual = jnp.where(padded, 0, _vector(residual))
        scale = jnp.maximum(_vector(scale), _vector(initial_scale))
        return residual, scale, _vector(found), tree_all_finite((t, y))

    residual, scale, found, finite = jax.vmap(at)(ts, ys)
    return Measured(residual, scale, found, _vector(target), finite)


def _vector(values: Values) -> Real[Array, " m"]:
    with jax.numpy_dtype_promotion("standard"):
        return ravel_pytree(values)[0]


def _refuse_unsuccessful(solution: dfx.Solution) -> None:
    okay = np.asarray(dfx.is_okay(solution.result))
    if not np.all(okay):
        lane = tuple(int(i) for i in np.argwhere(~okay)[0])
        result = jtu.tree_map(lambda x: x[lane], solution.result)
        raise AssertionError(unsuccessful(result, lane, int(np.sum(~okay)), okay.size))


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
        kinds.append(("saved", solution.ts, solution.ys))
    if solution.interpolation is not None:
        ts, ys = _dense(solution, num_dense)
        kinds.append(("dense", ts, ys))
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


def _check_comparable(ts: Float[Array, "..."], manifold: Manifold) -> None:
    for name, entry in named_entries(manifold):
        if isinstance(entry, FirstIntegral) and entry.value is None and ts.shape[-1] == 1:
            raise ValueError(
                f"`solution` holds one saved state, with nothing to compare `{name}` with. Pass "
                "`y0=...`, or save the initial state too, as in `SaveAt(t0=True, t1=True)`."
            )


def _samples(
    manifold: Manifold,
    kind: str,
    lanes: tuple[int, ...],
    rows: tuple[Array, Any],
    measured: Measured,
    args: Args,
    rtol: RealScalarLike | None,
    atol: RealScalarLike,
) -> list[Sample]:
    """One sample for each scalar constraint."""
    t, y = jtu.tree_map(lambda x: x[0, 0], rows)
    values = eqx.filter_eval_shape(evaluate, manifold, t, y, args)
    # The unit of roundoff of the coarsest dtype.
    eps = max(float(jnp.finfo(x.dtype).eps) for x in jtu.tree_leaves((y, values)))
    residual, scale, found, target, finite = map(np.asarray, measured)
    limit = np.asarray((ULPS * eps if rtol is None else rtol) * scale.astype(np.float64) + atol)
    return [
        Sample(
            name,
            is_constraint,
            kind,
            lanes,
            np.asarray(rows[0]),
            rows[1],
            finite,
            residual=residual[..., i],
            scale=scale[..., i],
            found=found[..., i],
            limit=limit[..., i],
            target=target[..., i],
            eps=eps,
        )
        for i, (name, is_constraint) in enumerate(_labels(manifold, values))
    ]


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
