"""A projection by a formula that the user gives."""

from collections.abc import Callable
from typing import Any, ClassVar, final

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._custom_types import RealScalarLike, Values
from .._options import check_function
from .._tree import ravel
from .base import AbstractProjection, Problem, ProjectionInfo, check_options, option


@final
class ClosedForm(AbstractProjection):
    r"""Projects by a formula: $y = \mathrm{fn}(t, \hat y, args, values)$.

    For manifolds with a known projection, such as spheres, unit quaternions and rotation matrices.
    The residual at the returned state is checked as in every projection: if the state is not on the
    manifold, the projection has failed.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        def unit(t, y, args):
            return jnp.sum(y**2) - 1

        def normalise(t, y, args, values):
            return y / jnp.linalg.norm(y)

        solver = dfc.ManifoldProjection(
            diffrax.Tsit5(), dfc.Constraint(unit), projection=dfc.ClosedForm(normalise)
        )
        ```
    """

    fn: Callable[[RealScalarLike, Any, Any, Values], Any]
    rtol: float | Array | None = option(None)
    atol: float | Array | None = option(None)
    metric: None = eqx.field(default=None, init=False)
    sees_step: ClassVar[bool] = False

    def __check_init__(self):
        check_function(
            "`fn` of a `ClosedForm`", self.fn, "fn(t, y, args, values)", "the projected state"
        )
        check_options(self)

    def solve(
        self, problem: Problem, candidate: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], ProjectionInfo]:
        state = problem.state(candidate)
        y = self.fn(problem.t, state, problem.args, problem.values)
        got, expected = _shapes_and_dtypes(y), _shapes_and_dtypes(state)
        if not eqx.tree_equal(got, expected):
            raise ValueError(
                f"`fn` of a `ClosedForm` returned {got}, but the state is {expected}. Return a "
                "state of the same structure, shapes and dtypes."
            )
        y = ravel(y)
        return y, problem.judge(candidate, y, rtol=self.rtol, atol=self.atol)


ClosedForm.__init__.__doc__ = r"""**Arguments:**

- `fn`: a function `fn(t, y, args, values)` of the time, the candidate, the parameters and the
    conserved values (a PyTree like the manifold, with zeros in the place of each `Constraint`),
    which returns the state on the manifold, shaped like `y`. Derivatives of the projection are
    those of `fn`.
- `rtol`, `atol`: the tolerances for residuals; see `SimplifiedNewton`.

**Raises:**

`TypeError` if `fn` is not callable; `ValueError`, when the projection is used, if the value of `fn`
is not shaped like the state.
"""


def _shapes_and_dtypes(tree: Any) -> Any:
    return jtu.tree_map(lambda x: (jnp.shape(x), jnp.result_type(x)), tree)
