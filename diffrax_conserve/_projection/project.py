"""`project`, and the checks of what is projected."""

import dataclasses

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jaxtyping import Array

from .._custom_types import Args, Manifold, RealScalarLike, State, Values, Y
from .._manifold import check_manifold, conserved_values, has_value, named_entries
from .._tree import ravel
from .base import AbstractProjection, ProjectionInfo, Target, check_projection
from .equations import any_lane, shown_terms
from .newton import Newton
from .options import check_state
from .roundoff import hidden_scale


def project(
    manifold: Manifold,
    y: State,
    *,
    t: RealScalarLike = 0.0,
    args: Args = None,
    value: Values | None = None,
    projection: AbstractProjection | None = None,
) -> tuple[State, ProjectionInfo]:
    r"""Projects one state to the manifold $\{y : g(t, y, args) = 0\}$.

    Distances are Euclidean in the numbers of the state. If its parts have different units, give
    their scales: `project(manifold, y, projection=Newton(metric=(1 / metres**2, 1 / speed**2)))`.

    Use it to make an initial state consistent, or to change the values of its integrals.

    **Arguments:**

    - `manifold`: a PyTree of `FirstIntegral`s and `Constraint`s.
    - `y`: the candidate, a PyTree of floating-point arrays, real or complex.
    - `t`, `args`: passed to the functions of the manifold.
    - `value`: the conserved values: a PyTree like `manifold`, with the conserved value in the place
        of each `FirstIntegral` and `None` in the place of each `Constraint`. Not needed if each
        `FirstIntegral` has its own `value`.
    - `projection`: the method. Default: `Newton()`, the nearest point.

    **Returns:**

    The state on the manifold, shaped like `y`, and a `ProjectionInfo`, whose `ok` tells whether
    each residual is within its tolerance: nothing is raised at run time.

    **Raises:**

    `TypeError` or `ValueError` if the manifold, the metric or the conserved values do not fit.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        sphere = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - 1)
        y, info = dfc.project(sphere, jnp.array([1.0, 2.0, 2.0]))  # y = (1/3, 2/3, 2/3)
        ```
    """
    check_manifold(manifold)
    projection = Newton() if projection is None else projection
    check_projection(projection)
    check_state(y, kind=jnp.inexact)
    y = jtu.tree_map(jnp.asarray, y)
    values = ravel(given_values(manifold, value, t, y, args)).astype(ravel(y).dtype)
    hidden, direction = jnp.zeros_like(values), jnp.asarray(1)
    return _projected(Target(projection, manifold, values, hidden, None, args, direction), t, y)


@eqx.filter_jit
def _projected(target: Target, t: RealScalarLike, candidate: Y) -> tuple[Y, ProjectionInfo]:
    """The tolerance follows the roundoff of the functions. That is measured before the projection,
    at the candidate. At a result far away it may be different, so it is measured there too. If the
    projection failed, or the roundoff at its result is much smaller, we make it once more, with the
    roundoff that was measured at the result."""

    def by(hidden: Array) -> tuple[Y, ProjectionInfo, Array, Array]:
        """The projection with a tolerance for the roundoff `hidden`; the roundoff at its result;
        and whether that justifies the tolerance, which may be twice too large."""
        y, info = dataclasses.replace(target, hidden=hidden).project(t, candidate)
        # If the projection failed, its result may be NaN, where nothing can be measured.
        usable = jtu.tree_map(lambda x, y: jnp.where(jnp.isfinite(x), x, y), y, candidate)
        value, jacobian, found = hidden_scale(target.manifold, t, usable, target.args)
        shown = jnp.abs(value) + shown_terms(jacobian, ravel(usable))
        return y, info, found, jnp.all(hidden <= 2 * (shown + found))

    hidden = hidden_scale(target.manifold, t, candidate, target.args)[2]
    y, info, found, justified = first = by(hidden)
    done = info.ok & justified
    again = lax.cond(any_lane(~done), lambda: by(found), lambda: first)
    y, info, _, justified = jtu.tree_map(lambda a, b: jnp.where(done, a, b), first, again)
    # If the roundoff measured at the result is smaller than what we assumed, the tolerance was too
    # loose, and we report a failure.
    missed = optx.RESULTS.nonlinear_max_steps_reached
    result = optx.RESULTS.where(info.ok & ~justified, missed, info.result)
    return y, dataclasses.replace(info, ok=info.ok & justified, result=result)


def given_values(
    manifold: Manifold, value: Values | None, t: RealScalarLike, y: Y, args: Args
) -> Values:
    """The conserved values that are given by `value`, or by the entries of the manifold."""
    for name, entry in named_entries(manifold):
        if value is None and not has_value(entry):
            raise ValueError(
                f"`{name}` has no conserved value, so every state would do. Pass `value=...`, such "
                "as `integral.fn(t, y_start, args)`, or write `FirstIntegral(fn, value=...)`."
            )
    return conserved_values(manifold, t, y, args, value)
