"""A projection by a formula that the user gives."""

from collections.abc import Callable
from typing import Any, ClassVar, final

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike, Float, PyTree

from .._custom_types import RealScalarLike, Values
from .._numerics.metric import positive_weights
from .._numerics.problem import Problem
from .._numerics.report import ProjectionInfo
from .._options import check_function
from .._tree import ravel
from .base import AbstractProjection
from .options import check_options, option


@final
class ClosedForm(AbstractProjection):
    r"""Projects by a formula: $y = \mathrm{fn}(t, \hat y, args, values)$.

    For manifolds such as spheres, unit quaternions and rotation matrices. The projection fails if
    the returned state is not on the manifold.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        unit = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - 1)
        normalise = dfc.ClosedForm(lambda t, y, args, values: y / jnp.linalg.norm(y))
        solver = dfc.ManifoldProjection(diffrax.Tsit5(), unit, projection=normalise)
        ```
    """

    fn: Callable[[RealScalarLike, Any, Any, Values], Any]
    rtol: float | Array | None = option(None)
    atol: float | Array | None = option(None)
    metric: PyTree[ArrayLike] | None = eqx.field(
        default=None, converter=positive_weights, kw_only=True
    )
    sees_step: ClassVar[bool] = False

    def __check_init__(self):
        check_function("`fn` of a `ClosedForm`", self.fn, "fn(t, y, args, values)", "a state")
        check_options(self)

    def solve(
        self, problem: Problem, candidate: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], ProjectionInfo]:
        state = problem.state(candidate)
        y = self.fn(problem.t, state, problem.args, problem.values)
        kind = lambda x: (jnp.shape(x), jnp.result_type(x))  # noqa: E731
        got, expected = jtu.tree_map(kind, y), jtu.tree_map(kind, state)
        if not eqx.tree_equal(got, expected):
            raise ValueError(
                f"`fn` of a `ClosedForm` returned {got}, but the state is {expected}. Return the "
                "same structure, shapes and dtypes."
            )
        y = ravel(y)
        return y, problem.report(candidate, y)


ClosedForm.__init__.__doc__ = r"""**Arguments:**

- `fn`: a function `fn(t, y, args, values)` of the time, the candidate, the parameters and the
    conserved values (a PyTree like the manifold, with zeros in the place of each `Constraint`),
    which returns a state like `y`. Derivatives of the projection are those of `fn`.
- `rtol`, `atol`: the tolerances for residuals; see `SimplifiedNewton`.
- `metric`: that in which the length of a correction is limited, as at a saved time by the length of
    the step; see `SimplifiedNewton`.

**Raises:**

`TypeError` if `fn` cannot be called so; `ValueError`, when it is used, if it returns another state.
"""
