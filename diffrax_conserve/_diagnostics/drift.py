"""How well a solution was conserved."""

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
    named_entries,
)
from .._options import check_solution
from .._projection import measure, relative
from .._tree import tree_add, tree_shapes


def drift(sol: dfx.Solution, manifold: Manifold, args: Args = None) -> Values:
    r"""The residual of every constraint at every saved time, relative to its scale.

    For a first integral $I$ this is

    $$\frac{I(t_k, y_k) - I_0}{|I_0| + \sum_i |y_{0,i}\, \partial I/\partial y_i(t_0, y_0)|},$$

    where $(t_0, y_0)$ is the first saved state and $I_0 = I(t_0, y_0)$, or the integral's `value`;
    for a `Constraint` it is $g(t_k, y_k)$ over the same scale with $I_0 = 0$.

    Of a balance law, a `FirstIntegral` with a `rate`, the integral of the rate from $t_0$ to $t_k$
    is subtracted from the numerator. It is taken along the dense output of the wrapped solver,
    or of a solver that is not wrapped, so the solution must have some.

    The scale is what roundoff is relative to: a momentum that vanishes as the sum of large terms is
    not divided by zero.

    **Arguments:**

    - `sol`: what `diffrax.diffeqsolve` returned. It needs saved times; save `t0` too (as in
        `SaveAt(t0=True, steps=True)`) if the drift from the initial state is wanted. For a batch
        of solutions use `jax.vmap`. What a `SaveAt(fn=...)` saved is taken for states.
    - `manifold`: a PyTree of `FirstIntegral`s and `Constraint`s.
    - `args`: as given to `diffeqsolve`.

    **Returns:**

    A PyTree like the values of the functions in `manifold`, with a leading axis of saved times.
    Rows that diffrax padded (times `inf`) are zero.

    **Raises:**

    `ValueError` if the solution holds no saved states, only one with nothing to compare it with,
    those of several `SaveAt(subs=...)`, or, where dense output tells, something else than states,
    or is a batch; or, of a balance law, no dense output. `TypeError` if `sol` is no solution.

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

    def at(t: Array, y: Y) -> Values:
        padded = ~jnp.isfinite(t)
        y = jtu.tree_map(lambda a, b: jnp.where(padded, b, a), y, y0)
        now = evaluate(manifold, jnp.where(padded, t0, t), y, args)
        then = values if gained is None else tree_add(values, gained(jnp.where(padded, t0, t)))
        residual = jtu.tree_map(lambda x, v: jnp.where(padded, 0, x - v), now, then)
        return relative(residual, scale)

    return jax.vmap(at)(sol.ts, sol.ys)


def _check_states(sol: dfx.Solution, y0: Y) -> None:
    """Raises if what was saved is known not to be states."""
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
    """What the rates of the manifold add to its values until a time, if it has any."""
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
        # Of a projected solver, what its own balance was computed from.
        local = getattr(local, "inner", local)
        return integrated_rates(manifold, path.ts[step], end, local.evaluate, args, path.direction)

    steps = jnp.arange(path.ts.size - 1)
    used = steps < path.ts_size - 1
    # Those that diffrax padded are computed too, for the first step.
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
