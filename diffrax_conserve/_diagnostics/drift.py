"""The drift of a solution from a manifold, and which of its states are off."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool

from .._balance import has_rates, integrated_rates
from .._constants import TOLERANCE_IN_EPS
from .._custom_types import Args, Manifold, RealScalarLike, Values, Y
from .._manifold import (
    check_manifold,
    conserved_values,
    evaluate,
    has_value,
    is_entry,
    named_entries,
)
from .._numerics.problem import relative_to_scale, residuals_and_scales
from .._numerics.roundoff import cancellation_scale
from .._options import check_solution
from .._time import FieldTime
from .._tree import eps_of, ravel, tree_add, tree_shapes, tree_sub


def drift(sol: dfx.Solution, manifold: Manifold, args: Args = None) -> Values:
    r"""The residual of every constraint at every saved time, relative to its scale.

    For a first integral $I$ this is

    $$\frac{I(t_k, y_k) - I_0}{|I_0| + \sum_i |y_{0,i}\, \partial I/\partial y_i(t_0, y_0)|},$$

    where $(t_0, y_0)$ is the first saved state and $I_0 = I(t_0, y_0)$, or the integral's `value`;
    for a `Constraint` it is $g(t_k, y_k)$ over the same scale with $I_0 = 0$, to which roundoff is
    proportional. Each component of a value has a scale of its own; only one with less than
    $\sqrt\varepsilon$ of the largest scale in its array has that one, because it may be zero at the
    start but for roundoff. Where all these terms are zero, as of the momentum of bodies at rest,
    the drift is absolute, in the units of the function.
    From the numerator the integral of a `rate` from $t_0$ to $t_k$ is subtracted, computed along
    the dense output, which the solution must then have.

    **Arguments:**

    - `sol`: the solution from `diffrax.diffeqsolve`, with saved times; save `t0` too for the drift
        from the initial state. For a batch use `equinox.filter_vmap`.
    - `manifold`: a PyTree of `FirstIntegral`s and `Constraint`s.
    - `args`: as given to `diffeqsolve`.

    **Returns:**

    A PyTree shaped like the values of the functions in `manifold`, with a leading axis over the
    saved times. Rows that diffrax padded (times `inf`) are zero.

    **Raises:**

    `ValueError` if `sol` is a batch, holds no states or one without a conserved value to compare it
    with, was saved by `SaveAt(subs=...)`, or by `SaveAt(fn=...)` in a form to which `manifold` does
    not apply, or lacks dense output for a `rate`. What `fn` saved in the form of a state, such as
    `2 * y`, is taken for the state. `TypeError` if `sol` is not a solution.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        square = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))
        solver = dfc.ManifoldProjection(diffrax.Tsit5(), square)
        term = diffrax.ODETerm(lambda t, y, args: jnp.array([-y[1], y[0]]))
        saveat = diffrax.SaveAt(t0=True, steps=True)
        sol = diffrax.diffeqsolve(term, solver, 0, 9, 0.1, jnp.array([1.0, 0.0]), saveat=saveat)
        assert jnp.max(jnp.abs(dfc.drift(sol, square))) < 1e-6  # float32
        ```
    """
    ts, ys, values, residual = _residuals(sol, manifold, args, "drift")
    _, scale = residuals_and_scales(manifold, values, ts[0], jtu.tree_map(lambda y: y[0], ys), args)

    def own(scale: Array) -> Array:
        most = jnp.max(scale, initial=0)
        return jnp.where(scale < jnp.finfo(scale.dtype).eps ** 0.5 * most, most, scale)

    scale = jtu.tree_map(own, scale)
    return jax.vmap(lambda t, y: relative_to_scale(residual(t, y), scale))(ts, ys)


def off_manifold(sol: dfx.Solution, manifold: Manifold, args: Args = None) -> Bool[Array, " times"]:
    r"""Whether a saved state is not on the manifold, for each saved time.

    At a saved time inside a very long step the interpolation of the wrapped solver may be so
    inaccurate that it cannot be projected. Then the saved state is that of the interpolation, off
    the manifold by its error, which [`diffrax_conserve.drift`][] shows. A state counts as on the
    manifold if each residual is within 32 units of roundoff of the size of its terms there.

    **Arguments:**

    - `sol`, `manifold`, `args`: as of [`diffrax_conserve.drift`][].

    **Returns:**

    An array of booleans, one for each saved time; its sum is the number of such states.

    **Raises:**

    As [`diffrax_conserve.drift`][].

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc

        system = dfc.systems.get("lotka-volterra")
        solver = dfc.ManifoldProjection(diffrax.Tsit5(), system.manifold)
        term, saveat = diffrax.ODETerm(system.vector_field), diffrax.SaveAt(t0=True, steps=True)
        sol = diffrax.diffeqsolve(term, solver, 0, 9, 0.1, system.y0, saveat=saveat)
        assert not dfc.off_manifold(sol, system.manifold).any()
        ```
    """
    ts, ys, values, residual = _residuals(sol, manifold, args, "off_manifold")
    numbers = jnp.abs(ravel(values))

    def at(t: Array, y: Y) -> Array:
        # Twice the tolerance of a projection, because the roundoff of the functions is measured
        # here anew, and may be a bit smaller than where the solve measured it.
        g = ravel(residual(t, y))
        _, jacobian, hidden = cancellation_scale(manifold, t, y, args)
        scale = numbers + jacobian.absolute_matvec(jnp.abs(ravel(y))) + hidden
        limit = 2 * TOLERANCE_IN_EPS * eps_of(g) * scale
        return ~jnp.all((jnp.abs(g) <= limit) | jnp.isinf(t))

    return jax.vmap(at)(ts, ys)


def _residuals(
    sol: dfx.Solution, manifold: Manifold, args: Args, user: str
) -> tuple[Array, Any, Values, Callable[[Array, Y], Values]]:
    """The saved times and states, the conserved values at the start of the solve, and the residuals
    as a function of a saved time and state, zero where diffrax padded them. Raises unless `sol` has
    what they need."""
    check_solution(sol, user)
    check_manifold(manifold)
    if sol.ts is None or sol.ys is None:
        raise ValueError(
            f"`{user}` needs saved states, but `sol` holds none. Save some, for example with "
            "`saveat=SaveAt(t0=True, steps=True)`."
        )
    if not eqx.is_array(sol.ts):
        raise ValueError(
            f"`sol` was saved by `SaveAt(subs=...)`, but `{user}` takes the times and states of "
            "one of them: write `dataclasses.replace(sol, ts=sol.ts[0], ys=sol.ys[0])`."
        )
    if sol.ts.ndim != 1:
        raise ValueError(
            f"`{user}` takes one solution, but `sol.ts` has shape {sol.ts.shape}. For a batch "
            f"write `equinox.filter_vmap(lambda s: {user}(s, manifold, args))(sol)`, with `args` "
            f"of each lane `equinox.filter_vmap(lambda s, a: {user}(s, manifold, a))(sol, args)`."
        )
    for name, entry in named_entries(manifold):
        if sol.ts.size == 1 and not has_value(entry):
            raise ValueError(
                f"`sol` holds one saved state, so the value that `{name}` had is unknown. Save the "
                "first one too, by `SaveAt(t0=True, t1=True)`, or write "
                "`FirstIntegral(fn, value=...)`."
            )
    t0, y0 = sol.ts[0], jtu.tree_map(lambda y: y[0], sol.ys)
    if sol.interpolation is not None:
        states = tree_shapes(eqx.filter_eval_shape(sol.evaluate, sol.t0))
        if tree_shapes(y0) != states:
            raise ValueError(
                f"`sol` has saved {tree_shapes(y0)} at each time, but the states are {states}. "
                "Save the states themselves, without `SaveAt(fn=...)`."
            )
    try:
        values = conserved_values(manifold, t0, y0, args)
    except Exception as error:
        raise ValueError(
            "`manifold` cannot be evaluated at the saved states. Pass the `args` of the solve, "
            "which a solution does not keep. Save the states themselves, without `SaveAt(fn=...)`."
        ) from error
    integral_until = _rate_integral(sol, manifold, args, values)

    # A given `value` holds at the start of the solve, from which the rates are integrated. Without
    # one the value is known at the first saved time, so what was gained before is subtracted.
    def at_start(entry: Any, value: Values, integral_until: Values) -> Values:
        return value if has_value(entry) else tree_sub(value, integral_until)

    values = jtu.tree_map(at_start, manifold, values, integral_until(t0), is_leaf=is_entry)

    def residual(t: Array, y: Y) -> Values:
        padded = jnp.isinf(t)
        t, y = jtu.tree_map(lambda a, b: jnp.where(padded, b, a), (t, y), (t0, y0))
        found = tree_sub(evaluate(manifold, t, y, args), tree_add(values, integral_until(t)))
        return jtu.tree_map(lambda x: jnp.where(padded, 0, x), found)

    return sol.ts, sol.ys, values, residual


def _rate_integral(
    sol: dfx.Solution, manifold: Manifold, args: Args, values: Values
) -> Callable[[RealScalarLike], Values]:
    """The integral of the rates of the manifold up to a time, as a function of that time."""
    if not has_rates(manifold):
        return lambda t: jtu.tree_map(jnp.zeros_like, values)
    path = sol.interpolation
    if not isinstance(path, dfx.DenseInterpolation):
        raise ValueError(
            "`manifold` has a `rate`, whose integral is taken along the dense output, but `sol` "
            "has none. Ask for it by `saveat=SaveAt(t0=True, steps=True, dense=True)`."
        )
    field_time = FieldTime(path.direction)

    def until(step: RealScalarLike, end: RealScalarLike) -> Values:
        info = jtu.tree_map(lambda x: x[step], path.infos)
        local = path.interpolation_cls(t0=path.ts[step], t1=path.ts[step + 1], **info)
        # A projected solver computes its balances along the dense output of the wrapped solver, so
        # we take the same.
        local = getattr(local, "inner", local)
        states = lambda t: local.evaluate(field_time(t))  # noqa: E731
        times = field_time(path.ts[step]), field_time(end)
        return integrated_rates(manifold, *times, states, args)

    def whole(step: Array) -> Values:
        # Of a batch with unlike numbers of steps, some are padding. These are replaced by the first
        # step, and the result is discarded.
        used = step < path.ts_size - 1
        start = jnp.where(used, step, 0)
        return jtu.tree_map(lambda x: jnp.where(used, x, 0), until(start, path.ts[start + 1]))

    steps = jax.vmap(whole)(jnp.arange(path.ts.size - 1))
    sums = jtu.tree_map(lambda x: jnp.cumsum(x, axis=0), steps)

    def integral_until(t: RealScalarLike) -> Values:
        t = field_time(t)
        step = jnp.clip(jnp.searchsorted(path.ts, t) - 1, 0, path.ts_size - 2)
        before = jtu.tree_map(lambda x: jnp.where(step > 0, x[step - 1], 0), sums)
        return tree_add(before, until(step, t))

    return integral_until
