"""`project`, and the checks of what is projected."""

import dataclasses

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._custom_types import Args, Manifold, RealScalarLike, State, Values, Y
from .._manifold import check_manifold, conserved_values, has_value, named_entries
from .._step.equations import shown_terms
from .._step.roundoff import hidden_scale
from .._tree import ravel, tree_stop_gradient
from .base import AbstractProjection, ProjectionInfo, Target, check_projection
from .newton import Newton
from .options import check_state


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
    target = Target(projection, manifold, values, hidden, args, direction)
    return _projected(target, t, y)


@eqx.filter_jit
def _projected(target: Target, t: RealScalarLike, candidate: Y) -> tuple[Y, ProjectionInfo]:
    """The tolerance follows the roundoff of the functions, which is measured at the candidate. At a
    result far away it may be different, so the result is judged by what is measured there."""
    _, _, hidden = hidden_scale(target.manifold, t, candidate, target.args)
    target = dataclasses.replace(target, hidden=hidden)
    y, info = target.project(t, candidate)
    # If the projection failed, its result may be NaN, where nothing can be measured.
    usable = jtu.tree_map(lambda x, y: jnp.where(jnp.isfinite(x), x, y), y, candidate)
    value, jacobian, hidden = hidden_scale(target.manifold, t, usable, target.args)
    there = dataclasses.replace(target, hidden=hidden).problem(t, candidate)
    # A projection may have tolerances of its own. If it reports a success, we believe it, unless
    # there is less than half of the roundoff that it assumed.
    shown = jnp.abs(value) + shown_terms(jacobian, jnp.abs(ravel(usable)))
    ok = tree_stop_gradient(there.equations).holds(lax.stop_gradient(ravel(y)))
    ok = ok | info.ok & jnp.all(target.hidden <= 2 * (shown + hidden))
    return y, there.report(ravel(candidate), ravel(y), info.num_steps, ok=ok)


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
