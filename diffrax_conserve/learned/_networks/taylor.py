"""The Taylor polynomial of a flow, the known part of a flow map."""

import math
from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from ..._custom_types import Args, RealScalarLike, Y
from ..._options import check_counts


@final
class Taylor(eqx.Module):
    r"""The Taylor polynomial of the flow of an autonomous system, as the start of a flow map.

    $$T_q(u_0, h) = \sum_{j=0}^q \frac{h^j}{j!} u^{(j)}(0), \qquad
    u'(0) = f(u_0), \quad u''(0) = f'(u_0) f(u_0), \quad \dots$$

    A [`diffrax_conserve.DeepONet`][] with it learns the remainder, $u(h) = T_q(u_0, h) +
    (h/\Delta)^{q+1} S N(u_0, h)$, and is a method of order $q$. The cost doubles with each order,
    which pays only if $h$ times the rate of change of $f$ is not much above one.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax

        system = dfc.systems.get("conservative-lorenz")
        states = jax.vmap(system.sample)(jax.random.split(jax.random.key(0), 100))
        taylor = dfc.learned.Taylor(system.vector_field)
        flow_map = dfc.DeepONet(states, 0.25, taylor=taylor, key=jax.random.key(1))
        ```
    """

    vector_field: Callable[[RealScalarLike, Any, Args], Any]
    order: int = eqx.field(static=True, default=1)
    args: Args = eqx.field(kw_only=True, default=None)

    def __check_init__(self):
        check_counts(order=self.order)
        if not callable(self.vector_field):
            raise TypeError(
                f"`vector_field` is {self.vector_field!r}, not a function `(t, y, args)`."
            )

    def __call__(self, y0: Y, h: RealScalarLike) -> Y:
        """The value of the polynomial."""

        def field(y: Y) -> Y:
            return self.vector_field(0.0, y, self.args)

        derivative, terms = field, []
        for j in range(1, self.order + 1):
            terms.append(jtu.tree_map(lambda x, d=j: x / math.factorial(d), derivative(y0)))
            derivative = lambda y, g=derivative: jax.jvp(g, (y,), (field(y),))[1]  # noqa: E731
        y = terms[-1]
        for term in reversed(terms[:-1]):
            y = jtu.tree_map(lambda a, b: a + h * b, term, y)
        return jtu.tree_map(lambda a, b: jnp.asarray(a) + (h * b).astype(jnp.result_type(a)), y0, y)


Taylor.__init__.__doc__ = r"""**Arguments:**

- `vector_field`: $f(t, y, args)$, which must not depend on $t$.
- `order`: the degree $q$, a positive integer; otherwise a `ValueError`.
- `args`: passed to `vector_field`.
"""
