"""Vector fields that see only admissible states."""

from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import ArrayLike, PyTree

from .._custom_types import VF, Args, RealScalarLike, Y
from .._manifold import check_vector_field
from .._tree import ravel, unravel
from .options import check_state
from .within_bounds import Bounds, check_bounds


def clipped(
    vector_field: Callable[[RealScalarLike, Any, Args], Any],
    *,
    lower: PyTree[ArrayLike] | None = None,
    upper: PyTree[ArrayLike] | None = None,
) -> Callable[[RealScalarLike, Any, Args], Any]:
    r"""The vector field $f(t, \mathrm{clip}(y), args)$, which is never evaluated out of its bounds.

    The stages of a step can lie outside of the bounds of the solution, even if its end does not:
    there a root or a logarithm is NaN. An exact solution that stays within the bounds is one of
    this field too. If all stages stay within, nothing changes. Outside, the field is continued
    constantly from the bound, so it has a kink there: a step across it has an error of second order
    in its length, whatever the order of the method.

    The end of a step is not clipped. For that use the bounds of a projection: see [Bounds inside
    the stages][bounds-inside-the-stages].

    **Derivatives.** At a bound the derivative by the component is that from inside, so that a
    concentration may start at zero. By a component outside it is zero, as the field does not depend
    on it there: in a solve its sensitivity then neither grows nor decays, and a parameter that acts
    only through components outside has no gradient. Choose the bound of a root or a logarithm
    above zero, such as 1e-30: at zero their derivatives are infinite, and a derivative through the
    solve is NaN.

    **Arguments:**

    - `vector_field`: $f$, called as `vector_field(t, y, args)`.
    - `lower`, `upper`: the bounds: numbers, arrays or PyTrees of them, which broadcast against the
        state.

    **Returns:**

    A function `(t, y, args)` for a [`diffrax.ODETerm`][].

    **Raises:**

    `TypeError` or `ValueError` if the vector field cannot be called so, if a bound is not a number,
    if there is none, if a lower bound is above its upper bound, or, when it is called, if they do
    not fit the state. Where such bounds are traced, the field is NaN.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        # A tank runs empty at t = 2.
        outflow = dfc.clipped(lambda t, y, args: -jnp.sqrt(y), lower=0.0)
        sol = diffrax.diffeqsolve(
            diffrax.ODETerm(outflow), diffrax.Tsit5(), 0, 3, 0.1, jnp.array(1.0)
        )
        print(bool(abs(sol.ys[0]) < 1e-3))
        ```

        ```text
        True
        ```
    """
    check_vector_field(vector_field)
    check_bounds(lower, upper)
    if lower is None and upper is None:
        raise ValueError("`clipped` needs a bound. Pass `lower=` or `upper=`, or both.")
    return _Clipped(vector_field, lower, upper)


@final
class _Clipped(eqx.Module):
    vector_field: Callable[[RealScalarLike, Any, Args], Any]
    lower: PyTree[ArrayLike] | None
    upper: PyTree[ArrayLike] | None

    def __call__(self, t: RealScalarLike, y: Y, args: Args) -> VF:
        y = jtu.tree_map(jnp.asarray, y)
        check_state(y, "`clipped`", jnp.inexact)
        x = Bounds.of(self.lower, self.upper, y).clip(ravel(y))
        return self.vector_field(t, unravel(x, y), args)
