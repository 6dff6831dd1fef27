"""An assertion about derivatives."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from .._custom_types import RealScalarLike
from .._tree import eps_of, ravel, unravel


def assert_gradients(
    f: Callable[..., Any],
    *args: Any,
    rtol: RealScalarLike | None = None,
    atol: RealScalarLike | None = None,
    forward: bool = True,
    reverse: bool = True,
    seed: int = 0,
) -> None:
    r"""Asserts that forward and reverse mode agree with finite differences.

    For each array in `args`, with one random direction $v$ in it and one random $w$ shaped like the
    output, three values of $w^\top J v$ are compared: forward mode gives $J v$, reverse mode
    $J^\top w$, and the differences, of fourth order, use $f(x \pm h v)$ and $f(x \pm 2 h v)$ with
    $h \approx \epsilon^{1/5} \max(1, |x|) / 4$.

    **Arguments:**

    - `f`: a function of PyTrees that returns a PyTree. It is compiled. In a solve, use fixed steps:
        changes of adaptive steps affect the differences but not the derivatives.
    - `*args`: the arguments at which to differentiate. Floating-point and complex arrays and
        numbers are varied, also those in an [`equinox.Module`][]; everything else is constant. A
        complex number is two, its real and its imaginary part.
    - `rtol`: relative to the sum of the absolute terms of $w^\top J v$. Default: the square root of
        the machine epsilon, 1.5e-8 in float64, of the coarsest dtype in `args` and in the result.
    - `atol`: absolute. Default: `rtol` times the largest output, the resolution of the differences.
    - `forward`, `reverse`: whether to check these modes. The default adjoint of `diffeqsolve` has
        no forward mode, and `diffrax.ForwardMode` no reverse mode.
    - `seed`: the seed of the directions.

    **Raises:**

    `AssertionError` that names the argument; NaN never passes. `ValueError` if nothing can be
    varied or compared.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import diffrax_conserve.testing as dct
        import jax.numpy as jnp

        circle = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - 1)
        dct.assert_gradients(lambda y: dfc.project(circle, y)[0], jnp.array([3.0, 4.0]), rtol=1e-2)
        ```
    """
    args = jtu.tree_map(lambda x: jnp.asarray(x) if isinstance(x, float | complex) else x, args)
    varied, fixed = eqx.partition(args, eqx.is_inexact_array)
    names = [f"args{jtu.keystr(path)}" for path, _ in jtu.tree_flatten_with_path(varied)[0]]
    if not names:
        raise ValueError("`args` holds no floating-point array, so there is nothing to vary.")
    # The leaves in one vector, and to which of them each number belongs.
    x, leaves = ravel(varied), jtu.tree_leaves(varied)
    leaf = np.repeat(np.arange(len(names)), [ravel(leaf).size for leaf in leaves])

    @jax.jit
    def values(x: Array) -> Any:
        return eqx.filter(f(*eqx.combine(unravel(x, varied), fixed)), eqx.is_inexact_array)

    outputs = jtu.tree_leaves(values(x))
    if not outputs:
        raise ValueError("`f` returns no floating-point array, so there is nothing to compare.")
    value, output = lambda x: ravel(values(x)), ravel(outputs)
    eps = max(map(eps_of, leaves + outputs))
    rng = np.random.default_rng(seed)
    cotangent = jnp.asarray(rng.normal(size=output.shape), output.dtype)
    pullback = jax.jit(lambda x: jax.vjp(value, x)[1](cotangent)[0])
    by_reverse = pullback(x) if reverse else jnp.zeros_like(x)
    pushforward = jax.jit(lambda x, v: jax.jvp(value, (x,), (v,))[1])
    direction = rng.normal(size=x.shape)
    relative = eps**0.5 if rtol is None else float(rtol)
    floor = relative * float(jnp.max(jnp.abs(output), initial=0)) if atol is None else float(atol)
    lines = []
    for index, name in enumerate(names):
        v = np.where(leaf == index, direction, 0)
        v = jnp.asarray(v / np.linalg.norm(v), x.dtype)
        size = max(1.0, float(jnp.max(jnp.abs(x), where=leaf == index, initial=0)))
        # A power of two, so that the displacements have as little roundoff as possible.
        h = 2.0 ** round(np.log2(eps**0.2 * size / 4))
        a, b, c, d = (value(x + k * h * v) for k in (2, 1, -1, -2))
        terms = np.asarray(cotangent * (8 * (b - c) - (a - d)) / (12 * h), np.float64)
        expected, limit = np.sum(terms), relative * np.sum(np.abs(terms)) + floor
        got = {}
        if forward:
            got["forward mode"] = float(cotangent @ pushforward(x, v))
        if reverse:
            got["reverse mode"] = float(by_reverse @ v)
        lines += [
            f"  with respect to `{name}`, {mode} gives {found:.9g}, finite differences "
            f"{expected:.9g}: they differ by {abs(found - expected):.2e}, tolerance {limit:.2e}"
            for mode, found in got.items()
            if not abs(found - expected) <= limit
        ]
    if lines:
        raise AssertionError(
            "Derivatives along random directions are wrong.\n"
            + "\n".join(lines)
            + "\nTo look at: a `stop_gradient`, a custom rule, or a `where` that hides an infinite "
            "derivative; adaptive steps; if both modes agree, the accuracy of the differences."
        )
