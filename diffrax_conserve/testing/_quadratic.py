"""Random quadratic first integrals, with a vector field that conserves them."""

import itertools
import math
from typing import Any, final

import equinox as eqx
import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Args, RealScalarLike
from .._manifold import FirstIntegral
from ._states import rounded


@final
class QuadraticSystem(eqx.Module):
    r"""A vector field in $n$ dimensions with one or two quadratic first integrals.

    For symmetric $Q_k$ and an alternating form $A$ (one that changes sign when two of its indices
    are exchanged),

    $$I_k(y) = \tfrac12 y^\top Q_k y, \qquad
    f_i(y) = \sum_j A_{ij} (Q_1 y)_j \quad\text{or}\quad
    f_i(y) = \sum_{jl} A_{ijl} (Q_1 y)_j (Q_2 y)_l.$$

    Then $\nabla I_k \cdot f = 0$. The first is a linear Hamiltonian system with a constant Poisson
    structure, the second a Nambu system: for $n = 3$ the free rigid body.

    **Attributes:** `forms`, the $Q_k$, of shape `(integrals, n, n)`; `alternating`, $A$, of shape
    `(n, n)` or `(n, n, n)`; `y0`, the initial state, of shape `(n,)`.

    Source: Hairer, Lubich and Wanner, "Geometric Numerical Integration", IV.1 and VII.2.
    """

    forms: Float[Array | np.ndarray, "integrals n n"]
    alternating: Float[Array | np.ndarray, "..."]
    y0: Float[Array | np.ndarray, " n"]

    def vector_field(self, t: RealScalarLike, y: Any, args: Args) -> Any:
        del t, args
        out = jnp.asarray(self.alternating, y.dtype)
        for form in reversed(list(self.forms)):
            out = out @ (jnp.asarray(form, y.dtype) @ y)
        return out

    def quadratic(self, t: RealScalarLike, y: Any, args: Args) -> Any:
        """The values of all the first integrals, of shape `(integrals,)`."""
        del t, args
        return jnp.stack([y @ (jnp.asarray(form, y.dtype) @ y) for form in self.forms]) / 2

    @property
    def manifold(self) -> dict[str, FirstIntegral]:
        return {"quadratic": FirstIntegral(self.quadratic)}

    def __repr__(self) -> str:
        fields = (f"{name}={np.asarray(x).tolist()}" for name, x in vars(self).items())
        return f"QuadraticSystem({', '.join(fields)})"


def quadratic_systems(dimension: int, *, integrals: int = 1) -> st.SearchStrategy[QuadraticSystem]:
    """Random quadratic first integrals with a vector field that conserves them, and a state.

    Draws are [`diffrax_conserve.testing.QuadraticSystem`][]s, which are PyTrees with arrays of
    fixed shapes, so that a function of one compiles once for all draws.

    **Arguments:**

    - `dimension`: the dimension of the state; greater than `integrals`, or a `ValueError`.
    - `integrals`: the number of integrals, 1 or 2; otherwise a `ValueError`.

    **Returns:**

    A strategy of systems with positive definite forms, so that solutions stay bounded, and initial
    states with components in [-2, 2], not all zero. It shrinks to diagonal forms, a vector field of
    zero, and a state with a single 1 and otherwise zeros.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import diffrax_conserve.testing as dct
        from hypothesis import given, settings

        @settings(deadline=None, max_examples=5)
        @given(system=dct.quadratic_systems(4, integrals=2))
        def test(system):
            states = system.y0[None]
            assert dfc.check_invariance(system.vector_field, system.manifold, states, rtol=1e-3).ok

        test()
        ```
    """
    if integrals not in (1, 2) or dimension <= integrals:
        raise ValueError(
            "`quadratic_systems` draws 1 or 2 integrals in a larger number of dimensions, but got "
            f"dimension={dimension} and integrals={integrals}."
        )
    n, degree = dimension, integrals + 1
    forms = hnp.arrays(np.float64, (integrals, n, n), elements=rounded(0.5))
    coefficients = hnp.arrays(np.float64, math.comb(n, degree), elements=rounded(1.0))
    y0s = hnp.arrays(np.float64, n, elements=rounded(2.0))
    return st.builds(
        QuadraticSystem,
        forms.map(_definite),
        coefficients.map(lambda a: _alternating(a, n, degree)),
        y0s.map(lambda y: y if np.max(np.abs(y)) >= 0.1 else np.eye(n)[0]),
    )


def _definite(b: np.ndarray) -> np.ndarray:
    """Symmetric and diagonally dominant. The diagonals differ; otherwise the gradients would be
    parallel at every state if `b` is zero."""
    n = b.shape[-1]
    diagonals = np.stack([1 + k * np.arange(n) for k in range(len(b))])
    return (b + np.swapaxes(b, 1, 2)) / (2 * n) + diagonals[:, :, None] * np.eye(n)


def _alternating(coefficients: np.ndarray, n: int, degree: int) -> np.ndarray:
    """The alternating form with these coefficients at increasing indices."""
    out = np.zeros((n,) * degree)
    for a, indices in zip(coefficients, itertools.combinations(range(n), degree), strict=True):
        for order in itertools.permutations(range(degree)):
            sign = round(np.linalg.det(np.eye(degree)[list(order)]))
            out[tuple(indices[i] for i in order)] = sign * a
    return out
