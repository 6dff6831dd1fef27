"""An assertion about derivatives."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from .._custom_types import RealScalarLike
from .._tree import tree_max, working_dtype


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

    - `f`: a function of PyTrees that returns a PyTree of real arrays. It is compiled. In a solve,
        use fixed steps: changes of adaptive steps affect the differences but not the derivatives.
    - `*args`: the arguments at which to differentiate. Floating-point arrays and numbers are
        varied, also those in an [`equinox.Module`][]; everything else is constant.
    - `rtol`: relative to the sum of the absolute terms of $w^\top J v$. Default: the square root of
        the machine epsilon, 1.5e-8 in float64.
    - `atol`: absolute. Default: `rtol` times the largest output, the resolution of the differences.
    - `forward`, `reverse`: whether to check these modes. `diffrax.RecursiveCheckpointAdjoint`, the
        default of `diffeqsolve`, has no forward mode, and `diffrax.ForwardMode` no reverse mode.
    - `seed`: the seed of the directions.

    **Raises:**

    `AssertionError` that names the argument; NaN never passes. `ValueError` if nothing can be
    varied.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import diffrax_conserve.testing as dct
        import jax.numpy as jnp

        circle = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - 1)
        dct.assert_gradients(lambda y: dfc.project(circle, y)[0], jnp.array([3.0, 4.0]), rtol=1e-2)
        ```
    """
    args = jtu.tree_map(lambda x: jnp.asarray(x) if isinstance(x, float) else x, args)
    varied, fixed = eqx.partition(args, eqx.is_inexact_array)
    names = [f"args{jtu.keystr(path)}" for path, _ in jtu.tree_flatten_with_path(varied)[0]]
    if not names:
        raise ValueError("`args` holds no floating-point array, so there is nothing to vary.")
    eps = float(jnp.finfo(working_dtype(varied)).eps)
    relative = eps**0.5 if rtol is None else float(rtol)

    @jax.jit
    def value(x: PyTree[Array]) -> PyTree[Array]:
        return eqx.filter(f(*eqx.combine(x, fixed)), eqx.is_inexact_array)

    rng = np.random.default_rng(seed)
    output = value(varied)
    cotangent = _random(rng, output)
    by_reverse = jax.jit(lambda x: jax.vjp(value, x)[1](cotangent)[0])(varied) if reverse else None
    pushforward = jax.jit(lambda x, v: jax.jvp(value, (x,), (v,))[1])
    direction = _random(rng, varied)
    lines = []
    for index, name in enumerate(names):
        v = _only(direction, index)
        slopes = _differences(value, varied, v, eps)
        expected, size = _dot(cotangent, slopes)
        got = {}
        if forward:
            got["forward mode"] = _dot(cotangent, pushforward(varied, v))[0]
        if reverse:
            got["reverse mode"] = _dot(by_reverse, v)[0]
        floor = relative * _largest(output) if atol is None else float(atol)
        limit = relative * size + floor
        for mode, found in got.items():
            if not abs(found - expected) <= limit:
                lines.append(
                    f"  with respect to `{name}`, {mode} gives {found:.9g}, finite differences "
                    f"{expected:.9g}: they differ by {abs(found - expected):.2e}, tolerance "
                    f"{limit:.2e}"
                )
    if lines:
        raise AssertionError(
            "Derivatives along random directions are wrong.\n"
            + "\n".join(lines)
            + "\nTo look at: a `stop_gradient`, a custom rule, or a `where` that hides an infinite "
            "derivative; adaptive steps; if both modes agree, the accuracy of the differences."
        )


def _random(rng: np.random.Generator, like: PyTree[Array]) -> PyTree[Array]:
    return jtu.tree_map(lambda x: jnp.asarray(rng.normal(size=x.shape), x.dtype), like)


def _only(direction: PyTree[Array], index: int) -> PyTree[Array]:
    """`direction` in one leaf, of norm one, and zero in the others."""
    leaves, treedef = jtu.tree_flatten(direction)
    kept = [
        x / jnp.linalg.norm(x.ravel()) if i == index else jnp.zeros_like(x)
        for i, x in enumerate(leaves)
    ]
    return jtu.tree_unflatten(treedef, kept)


def _differences(
    value: Callable[[PyTree[Array]], PyTree[Array]], x: PyTree[Array], v: PyTree[Array], eps: float
) -> PyTree[Array]:
    """The derivative of `value` along `v`, to fourth order."""
    touched = [a for a, b in zip(jtu.tree_leaves(x), jtu.tree_leaves(v), strict=True) if b.any()]
    h = eps**0.2 * max(1.0, _largest(touched)) / 4
    # A power of two, so that the displacements have as little roundoff as possible.
    h = 2.0 ** round(np.log2(h))

    def at(factor: float) -> PyTree[Array]:
        return value(jtu.tree_map(lambda a, b: a + jnp.asarray(factor * h, a.dtype) * b, x, v))

    return jtu.tree_map(
        lambda a, b, c, d: (8 * (b - c) - (a - d)) / (12 * h), at(2.0), at(1.0), at(-1.0), at(-2.0)
    )


def _dot(a: PyTree[Array], b: PyTree[Array]) -> tuple[float, float]:
    """The inner product, and the sum of its absolute terms."""
    products = [
        np.asarray(x, np.float64) * np.asarray(y, np.float64)
        for x, y in zip(jtu.tree_leaves(a), jtu.tree_leaves(b), strict=True)
    ]
    return float(sum(p.sum() for p in products)), float(sum(np.abs(p).sum() for p in products))


def _largest(tree: PyTree[Array]) -> float:
    return float(tree_max(tree)) if jtu.tree_leaves(tree) else 0.0
