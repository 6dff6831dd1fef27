"""The drift of a solution from a manifold."""

from collections.abc import Callable

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from .._balance import has_rates, integrated_rates
from .._custom_types import Args, Manifold, RealScalarLike, Values, Y
from .._manifold import (
    FirstIntegral,
    check_manifold,
    conserved_values,
    evaluate,
    is_entry,
    named_entries,
)
from .._options import check_solution
from .._projection.equations import measure, relative
from .._tree import tree_add, tree_shapes, tree_sub


def drift(sol: dfx.Solution, manifold: Manifold, args: Args = None) -> Values:
    r"""The residual of every constraint at every saved time, relative to its scale.

    For a first integral $I$ this is

    $$\frac{I(t_k, y_k) - I_0}{|I_0| + \sum_i |y_{0,i}\, \partial I/\partial y_i(t_0, y_0)|},$$

    where $(t_0, y_0)$ is the first saved state and $I_0 = I(t_0, y_0)$, or the integral's `value`;
    for a `Constraint` it is $g(t_k, y_k)$ over the same scale with $I_0 = 0$.

    For a balance law, a `FirstIntegral` with a `rate`, the integral of the rate from $t_0$ to $t_k$
    is subtracted from the numerator. It is computed along the dense output of the solver (of the
    wrapped one in a `ManifoldProjection`), so the solution must have dense output.

    Roundoff is proportional to this scale. It is not zero for a momentum that vanishes as the sum
    of large terms.

    **Arguments:**

    - `sol`: the solution from `diffrax.diffeqsolve`, with saved times; save `t0` too (as in
        `SaveAt(t0=True, steps=True)`) to get the drift from the initial state. For a batch of
        solutions use `jax.vmap`. Values saved by a `SaveAt(fn=...)` are treated as states.
    - `manifold`: a PyTree of `FirstIntegral`s and `Constraint`s.
    - `args`: as given to `diffeqsolve`.

    **Returns:**

    A PyTree shaped like the values of the functions in `manifold`, with a leading axis over the
    saved times. Rows that diffrax padded (times `inf`) are zero.

    **Raises:**

    `ValueError` if `sol` is a batch, has no saved states, has a single one without a conserved
    value to compare it with, or was saved by `SaveAt(subs=...)`; if the saved values do not have
    the shapes of states (checked only with dense output); or if a balance law has no dense output.
    `TypeError` if `sol` is not a solution.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        square = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))
        term = diffrax.ODETerm(lambda t, y, args: jnp.array([-y[1], y[0]]))
        sol = diffrax.diffeqsolve(
            term,
            dfc.ManifoldProjection(diffrax.Tsit5(), square),
            t0=0,
            t1=9,
            dt0=0.1,
            y0=jnp.array([1.0, 0.0]),
            saveat=diffrax.SaveAt(t0=True, steps=True),
        )
        print(f"{jnp.max(jnp.abs(dfc.drift(sol, square))):.0e}")
        ```

        ```text
        4e-08
        ```
    """
    check_solution(sol, "drift")
    check_manifold(manifold)
    if sol.ts is None or sol.ys is None:
        raise ValueError(
            "`drift` needs saved states, but `sol` holds none. Save some, for example with "
            "`saveat=SaveAt(t0=True, steps=True)`."
        )
    if not eqx.is_array(sol.ts):
        raise ValueError(
            "`sol` was saved by `SaveAt(subs=...)`, but `drift` takes the times and states of one "
            "of them: write `dataclasses.replace(sol, ts=sol.ts[0], ys=sol.ys[0])`."
        )
    if sol.ts.ndim != 1:
        raise ValueError(
            f"`drift` takes one solution, but `sol.ts` has shape {sol.ts.shape}. For a batch write "
            "`jax.vmap(lambda s: drift(s, manifold, args))(sol)`."
        )
    unknown = [
        name
        for name, entry in named_entries(manifold)
        if isinstance(entry, FirstIntegral) and entry.value is None
    ]
    if sol.ts.size == 1 and unknown:
        raise ValueError(
            f"`sol` holds one saved state, so the drift of `{unknown[0]}` from an earlier one is "
            "unknown. Save the initial state too, as in `SaveAt(t0=True, t1=True)`, or write "
            "`FirstIntegral(fn, value=...)`."
        )
    t0, y0 = sol.ts[0], jtu.tree_map(lambda y: y[0], sol.ys)
    _check_states(sol, y0)
    values = conserved_values(manifold, t0, y0, args)
    _, scale = measure(manifold, values, t0, y0, args)

    gained = _gained(sol, manifold, args)
    if gained is not None:
        # The rates are integrated from the start of the solve, at which a given `value` holds.
        values = tree_sub(values, _without_value(manifold, gained(t0)))

    def at(t: Array, y: Y) -> Values:
        padded = ~jnp.isfinite(t)
        y = jtu.tree_map(lambda a, b: jnp.where(padded, b, a), y, y0)
        now = evaluate(manifold, jnp.where(padded, t0, t), y, args)
        then = values if gained is None else tree_add(values, gained(jnp.where(padded, t0, t)))
        residual = jtu.tree_map(lambda x, v: jnp.where(padded, 0, x - v), now, then)
        return relative(residual, scale)

    return jax.vmap(at)(sol.ts, sol.ys)


def _without_value(manifold: Manifold, gained: Values) -> Values:
    """`gained`, and zero for the entries whose `value` is given."""
    entries, treedef = jtu.tree_flatten(manifold, is_leaf=is_entry)
    parts = [
        jtu.tree_map(jnp.zeros_like, part) if getattr(entry, "value", None) is not None else part
        for entry, part in zip(entries, treedef.flatten_up_to(gained), strict=True)
    ]
    return treedef.unflatten(parts)


def _check_states(sol: dfx.Solution, y0: Y) -> None:
    """Raises if the saved values are known not to be states."""
    if sol.interpolation is None:
        return
    states = tree_shapes(eqx.filter_eval_shape(sol.evaluate, sol.t0))
    if tree_shapes(y0) != states:
        raise ValueError(
            f"`sol` has saved {tree_shapes(y0)} at each time, but the states are {states}. Save "
            "the states themselves, without `SaveAt(fn=...)`."
        )


def _gained(
    sol: dfx.Solution, manifold: Manifold, args: Args
) -> Callable[[RealScalarLike], Values] | None:
    """The integral of the rates of the manifold up to a time, as a function of that time; `None` if
    there are no rates."""
    if not has_rates(manifold):
        return None
    path = sol.interpolation
    if not isinstance(path, dfx.DenseInterpolation):
        raise ValueError(
            "`manifold` has a balance law, a `FirstIntegral` with a `rate`, whose integral is "
            "taken along the dense output, but `sol` has none. Ask for it, for example with "
            "`saveat=SaveAt(t0=True, steps=True, dense=True)`."
        )

    def until(step: RealScalarLike, end: RealScalarLike) -> Values:
        info = jtu.tree_map(lambda x: x[step], path.infos)
        local = path.interpolation_cls(t0=path.ts[step], t1=path.ts[step + 1], **info)
        # For a projected solver this is the interpolation from which the solver computed its
        # balance.
        local = getattr(local, "inner", local)
        return integrated_rates(manifold, path.ts[step], end, local.evaluate, args, path.direction)

    steps = jnp.arange(path.ts.size - 1)
    used = steps < path.ts_size - 1
    # Padded steps are computed too, with the values of the first step, and discarded.
    each = jax.vmap(lambda i, ok: until(jnp.where(ok, i, 0), path.ts[jnp.where(ok, i, 0) + 1]))
    sums = jtu.tree_map(
        lambda x: jnp.cumsum(jnp.where(used.reshape(-1, *[1] * (x.ndim - 1)), x, 0), axis=0),
        each(steps, used),
    )

    def gained(t: RealScalarLike) -> Values:
        t = t * path.direction
        step = jnp.clip(jnp.searchsorted(path.ts, t) - 1, 0, path.ts_size - 2)
        before = jtu.tree_map(lambda x: jnp.where(step > 0, x[step - 1], 0), sums)
        return tree_add(before, until(step, t))

    return gained
