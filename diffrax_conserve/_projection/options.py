"""The options of projections: their checks, and their vectors."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from .._custom_types import Y
from .._options import check_counts, check_number, check_numbers, dtype_of
from .._tree import ravel, real_view


def option(default: Any, **kwargs: Any) -> Any:
    """An optional, keyword-only field."""
    return eqx.field(default=default, kw_only=True, **kwargs)


def check_options(projection: Any) -> None:
    for name in ("rtol", "atol"):
        check_number(name, getattr(projection, name), least=0.0)
    if hasattr(projection, "max_steps"):
        check_counts(max_steps=projection.max_steps)
    for name in ("lower", "upper"):
        check_numbers(name, getattr(projection, name, None), least=-math.inf)


# The options that the Newton iterations share.
NEWTON_OPTIONS = r"""**Arguments:**

- `rtol`: the largest accepted residual, relative to the scale of its constraint at the projected
    state, to which roundoff is proportional. Default: 16 units of roundoff of the dtype.
- `atol`: an absolute tolerance, added to the relative one. Default: 0.
- `max_steps`: the largest number of iterations; twice as many with bounds, or in all by `Newton`.
- `metric`: positive weights $M_k$ (masses, or $1/\text{scale}^2$): distances are
    $\sum_k M_k (y_k - \hat y_k)^2$. One number or array, or a PyTree of them for the parts of the
    state, which broadcast against their leaves. An infinite weight freezes its component;
    `metric=1.0` is the Euclidean distance in the numbers of the state. Default: in the steps of an
    ordinary differential equation the *metric of motion*, see `ManifoldProjection`; elsewhere, as
    in [`diffrax_conserve.project`][] and with noise, Euclidean.
- `lower`, `upper`: bounds of the components, such as `lower=0` for concentrations: numbers, arrays
    or PyTrees that broadcast like `metric`. The result, always within the bounds, is
    $\mathrm{clip}(\hat y + M^{-1} G^\top \lambda)$, for linear constraints the nearest such point
    of the manifold. If there is none, the projection fails. In derivatives, components at a bound
    are constant. Of a complex component both parts are bounded. Default: none.

**Raises:**

`TypeError` if an option is not a number; `ValueError` if a tolerance is negative, `max_steps` is
less than 1, a weight is not positive, a lower bound is above its upper bound, or, in use, the
weights or bounds are not shaped like the state.
"""


def positive_weights(metric: PyTree[ArrayLike] | None) -> PyTree[ArrayLike] | None:
    """`metric`, checked now if its values are known, and at run time if they are tracers."""
    message = "`metric` has a weight that is not positive. Give one per component, not a matrix."

    def check(weight: ArrayLike) -> ArrayLike:
        check_number("metric", weight)
        if isinstance(weight, jax.core.Tracer):
            return eqx.error_if(weight, ~jnp.all(weight > 0), message)
        if not np.all(np.asarray(weight) > 0):  # known, also within a jitted function
            raise ValueError(message)
        return weight

    return jtu.tree_map(check, metric)


def units_of(metric: PyTree[ArrayLike], like: Any) -> Float[Array, " n"]:
    """The units `M^(-1/2)` of a metric, as a vector; that of an infinite weight is zero."""
    return 1 / jnp.sqrt(spread("metric", metric, like))


def spread(name: str, option: PyTree[ArrayLike], like: Any) -> Float[Array, " n"]:
    """An option of numbers or arrays for the parts of a state, as a vector like the state."""

    def spread_leaf(given: ArrayLike, leaf: Any) -> Any:
        shape = jnp.shape(given)
        try:
            fits = np.broadcast_shapes(shape, leaf.shape) == leaf.shape
        except ValueError:
            fits = False
        if not fits:
            raise ValueError(
                f"`{name}` has a leaf of shape {shape} for one of shape {leaf.shape} of the state. "
                "Give a number or an array that broadcasts against it."
            )
        view = jax.eval_shape(real_view, leaf)  # both parts of a complex component are alike
        return jnp.broadcast_to(jnp.asarray(given, view.dtype), view.shape)

    def spread_part(given: ArrayLike, part: Any) -> Any:
        return jtu.tree_map(lambda leaf: spread_leaf(given, leaf), part)

    try:
        jtu.tree_map(lambda given, part: None, option, like)
    except ValueError as error:
        raise ValueError(
            f"`{name}` has the structure {jtu.tree_structure(option)}, but the state has "
            f"{jtu.tree_structure(like)}. Give one number, or one number or array for each part of "
            "the state."
        ) from error
    return ravel(jtu.tree_map(spread_part, option, like))


def check_state(y: Y, user: str = "a projection", kind: Any = jnp.floating) -> None:
    """Raises unless every leaf of the state is a floating-point array, as `user` needs."""
    dtypes = [dtype_of(x) for x in jtu.tree_leaves(y)]
    for leaf, dtype in zip(jtu.tree_leaves(y), dtypes, strict=True):
        if not jnp.issubdtype(dtype, kind):
            got = f"a leaf of dtype {dtype}" if eqx.is_array_like(leaf) else f"the leaf {leaf!r}"
            wanted = "floating-point states, real or complex"
            if kind is jnp.floating:
                wanted = "real floating-point states; split a complex leaf into two"
            raise TypeError(
                f"The state has {got}, but {user} needs {wanted}. Convert it, for example by "
                "`jnp.asarray(..., dtype=float)`."
            )
    if len({jnp.finfo(dtype).dtype for dtype in dtypes}) > 1:
        raise TypeError(
            f"The state has leaves of the dtypes {', '.join(map(str, dtypes))}, but {user} needs "
            "one precision. Convert them to one."
        )
