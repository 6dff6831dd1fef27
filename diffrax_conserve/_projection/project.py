"""`project`, and the checks of what is projected."""

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._custom_types import Args, Manifold, RealScalarLike, State, Values, Y
from .._manifold import check_manifold, conserved_values, has_value, named_entries
from .._numerics.problem import Problem, problem_of
from .._numerics.report import ProjectionInfo
from .._numerics.roundoff import cancellation_scale
from .._tree import ravel, tree_stop_gradient, unravel
from .base import AbstractProjection, check_projection, with_options
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
    return _projected(manifold, projection, values, t, y, args)


@eqx.filter_jit
def _projected(
    manifold: Manifold,
    projection: AbstractProjection,
    values: Float[Array, " m"],
    t: RealScalarLike,
    candidate: Y,
    args: Args,
) -> tuple[Y, ProjectionInfo]:
    """The tolerance follows the roundoff of the functions, which is measured at the candidate. At a
    result far away it may be different, so the result is judged by what is measured there."""
    vector = ravel(candidate)

    def problem(cancellation: Float[Array, " m"]) -> Problem:
        asked = problem_of(manifold, values, t, candidate, args, cancellation)
        return with_options(asked, projection, vector)

    _, _, at_candidate = cancellation_scale(manifold, t, candidate, args)
    y, info = projection.solve(problem(at_candidate), vector)
    # If the projection failed, its result may be NaN, where nothing can be measured.
    usable = unravel(jnp.where(jnp.isfinite(y), y, vector), candidate)
    gradient_scale, _, there = cancellation_scale(manifold, t, usable, args)
    # A projection may have tolerances of its own. If it reports a success, we believe it, unless
    # the scale at the result is less than half of the cancellation at the candidate.
    judged = problem(there)
    ok = tree_stop_gradient(judged).is_on_manifold(lax.stop_gradient(y))
    ok = ok | info.ok & jnp.all(at_candidate <= 2 * (gradient_scale + there))
    return unravel(y, candidate), judged.report(vector, y, info.num_iterations, ok=ok)


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
