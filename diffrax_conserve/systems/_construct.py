"""Vector fields from their first integrals: Hamilton's and Nambu's equations by autodiff."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._custom_types import Args, RealScalarLike
from .._options import check_function

ScalarFn = Callable[[RealScalarLike, Any, Args], Float[Array, ""]]


def hamiltonian_vector_field(hamiltonian: ScalarFn) -> Callable[[RealScalarLike, Any, Args], Any]:
    r"""The vector field of Hamilton's equations.

    $$q' = \frac{\partial H}{\partial p}, \qquad p' = -\frac{\partial H}{\partial q}.$$

    **Arguments:**

    - `hamiltonian`: $H$, called as `hamiltonian(t, y, args)`, a real scalar. The state `y` is a
        pair `(q, p)` of PyTrees of the same structure, or one array of even length along its first
        axis, whose first half is $q$ and whose second half is $p$.

    **Returns:**

    A callable `vector_field(t, y, args)`, a PyTree that holds `hamiltonian`: the parameters of an
    [`equinox.Module`][] remain differentiable. It raises a `TypeError` if `y` has another form.

    !!! example

        ```python
        import jax.numpy as jnp
        import diffrax_conserve as dfc

        def energy(t, y, args):
            q, p = y
            return 0.5 * p**2 - jnp.cos(q)

        pendulum = dfc.systems.hamiltonian_vector_field(energy)
        pendulum(0.0, (jnp.array(0.1), jnp.array(0.0)), None)
        ```

    Source: Hairer, Lubich and Wanner, "Geometric Numerical Integration", VI.1.
    """
    check_function("`hamiltonian`", hamiltonian, "hamiltonian(t, y, args)", "a real number")
    return eqx.Partial(_hamilton, hamiltonian)


def nambu_vector_field(h: ScalarFn, l: ScalarFn) -> Callable[[RealScalarLike, Any, Args], Any]:
    r"""The vector field of Nambu's equations in three dimensions.

    $$y' = \nabla h(y) \times \nabla l(y),$$

    along which both $h$ and $l$ are first integrals.

    **Arguments:**

    - `h`, `l`: called as `h(t, y, args)` with `y` of shape `(3,)`, each a real scalar.

    **Returns:**

    A callable `vector_field(t, y, args)`, a PyTree that holds `h` and `l`. It raises a `TypeError`
    if `y` is not an array of shape `(3,)`.

    !!! example

        ```python
        import jax.numpy as jnp
        import diffrax_conserve as dfc

        f = dfc.systems.nambu_vector_field(
            lambda t, y, args: 0.5 * jnp.sum(y**2),
            lambda t, y, args: 0.5 * (y[0] ** 2 + 2 * y[1] ** 2 + 3 * y[2] ** 2),
        )
        f(0.0, jnp.array([1.0, 1.0, 1.0]), None)
        ```

    Source: Y. Nambu, "Generalized Hamiltonian dynamics", Phys. Rev. D 7 (1973).
    """
    return eqx.Partial(_nambu, h, l)


def _hamilton(hamiltonian: ScalarFn, t: RealScalarLike, y: Any, args: Args) -> Any:
    gradient = jax.grad(hamiltonian, argnums=1)
    if eqx.is_array(y) and y.ndim > 0 and y.shape[0] % 2 == 0:
        dq, dp = jnp.split(gradient(t, y, args), 2)
        return jnp.concatenate([dp, -dq])
    if type(y) in (tuple, list) and len(y) == 2 and len(set(map(jtu.tree_structure, y))) == 1:
        dq, dp = gradient(t, y, args)
        return type(y)((dp, jtu.tree_map(jnp.negative, dq)))
    raise TypeError(
        "The state `y` of a `hamiltonian_vector_field` must be a pair `(q, p)` of PyTrees of the "
        "same structure, or an array of even length along its first axis that stacks q on p, but "
        f"it is {eqx.tree_pformat(y)}."
    )


def _nambu(h: ScalarFn, l: ScalarFn, t: RealScalarLike, y: Any, args: Args) -> Float[Array, "3"]:
    if not eqx.is_array(y) or y.shape != (3,):
        raise TypeError(
            "The state `y` of a `nambu_vector_field` must be an array of shape (3,), but it is "
            f"{eqx.tree_pformat(y)}."
        )
    return jnp.cross(jax.grad(h, argnums=1)(t, y, args), jax.grad(l, argnums=1)(t, y, args))
