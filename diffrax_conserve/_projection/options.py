"""The options that projections share: defaults, checks, and the text that documents them."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._custom_types import Y
from .._options import check_counts, check_number, dtype_of


def option(default: Any, **kwargs: Any) -> Any:
    """An optional, keyword-only field."""
    return eqx.field(default=default, kw_only=True, **kwargs)


def check_options(projection: Any) -> None:
    """Raises unless the tolerances and the number of iterations are valid."""
    for name in ("rtol", "atol"):
        check_number(name, getattr(projection, name), least=0.0)
    check_counts(max_steps=projection.max_steps)


# The options that the Newton iterations share.
NEWTON_OPTIONS = r"""**Arguments:**

- `rtol`: the largest accepted residual, relative to the scale of its constraint at the projected
    state, to which roundoff is proportional. Default: 16 units of roundoff of the dtype.
- `atol`: an absolute tolerance, added to the relative one. Default: 0.
- `max_steps`: the largest number of iterations; twice as many with bounds, or in all by `Newton`.
- `metric`: positive weights $M_k$ (masses, or $1/\text{scale}^2$): distances are
    $\sum_k M_k (y_k - \hat y_k)^2$. One number or array, or a PyTree of them for the parts of the
    state, which broadcast against their leaves; or, for a part, a symmetric, positive definite
    matrix of the size of the part, or a function `(t, y, args)` that returns one, such as the mass
    matrix $M(q)$ of generalised coordinates. An infinite weight freezes its component;
    `metric=1.0` is the Euclidean distance in the numbers of the state. Default: in the steps of an
    ordinary differential equation the *metric of motion*, see `ManifoldProjection`; elsewhere, as
    in [`diffrax_conserve.project`][] and with noise, Euclidean.
- `lower`, `upper`: bounds of the components, such as `lower=0` for concentrations: numbers, arrays
    or PyTrees that broadcast like `metric`. The result, always within the bounds, is
    $\mathrm{clip}(\hat y + M^{-1} G^\top \lambda)$, for linear constraints and a metric without
    matrices the nearest such point of the manifold. If no such point is on it, the projection
    fails. A start that is outside is moved by the first projection. In derivatives, components that
    were beyond a bound are constant, and those exactly at one move with $\hat y$. Of a complex
    component both parts are bounded. Default: none.

**Raises:**

`TypeError` if an option is not a number; `ValueError` if a tolerance is negative, `max_steps` is
less than 1, a weight is not positive, a lower bound is above its upper bound, or, in use, the
weights or bounds are not shaped like the state.
"""


def refuse_half_precision(user: str, y: Y, remedy: str = "") -> None:
    """Raises if a leaf of the state has half precision, which LAPACK does not have."""
    for dtype in (jnp.finfo(dtype_of(x)).dtype for x in jtu.tree_leaves(y)):
        if np.promote_types(dtype, np.float32) != dtype:
            raise TypeError(
                f"{user} cannot solve linear systems in the dtype of the state, {dtype}. Convert "
                f"the state to float32{remedy}."
            )


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
