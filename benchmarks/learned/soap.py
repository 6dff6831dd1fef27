"""SOAP: Adam in the eigenbasis of Shampoo's two matrices for each matrix of weights.

On the networks of this folder it is an order of magnitude ahead of Adam after the same time.

N. Vyas et al., "SOAP: improving and stabilizing Shampoo using Adam", arXiv:2409.11321.
"""

from typing import Any, NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
import optax


class Moments(NamedTuple):
    """Of one matrix of weights: means of the gradient, of its square, and of its two products."""

    first: Any
    second: Any
    products: tuple[Any, Any]
    bases: tuple[Any, Any]


def soap(schedule, decay=0.95, every=10, eps=1e-8):
    """The optimiser, as optax has them; the bases are brought up to date `every` so many steps."""

    def init(weights):
        def of_one(w):
            shape = w.shape if w.ndim == 2 else (0, 0)
            eyes = tuple(jnp.eye(n, dtype=w.dtype) for n in shape)
            return Moments(jnp.zeros_like(w), jnp.zeros_like(w), tuple(0 * e for e in eyes), eyes)

        return jnp.zeros((), int), [of_one(w) for w in jax.tree.leaves(weights)]

    def update(gradient, state, weights=None):
        del weights
        count, moments = state
        leaves, treedef = jax.tree.flatten(gradient)
        pairs = [one(g, m, count + 1) for g, m in zip(leaves, moments, strict=True)]
        rate = schedule(count)
        steps = treedef.unflatten([(-rate * u).astype(u.dtype) for u, _ in pairs])
        return steps, (count + 1, [m for _, m in pairs])

    def one(g, moments, count):
        correction = (1 - decay**count).astype(g.dtype)
        first = mean(moments.first, g)
        left, right = moments.bases
        turned = (lambda x: left.T @ x @ right) if g.ndim == 2 else (lambda x: x)
        second = mean(moments.second, turned(g) ** 2)
        step = turned(first) / correction / (jnp.sqrt(second / correction) + eps)
        if g.ndim < 2:
            return step, moments._replace(first=first, second=second)
        products = mean(moments.products[0], g @ g.T), mean(moments.products[1], g.T @ g)
        bases = lax.cond(
            (count % every == 0) | (count == 1),
            # One step of orthogonal iteration towards the eigenvectors.
            lambda: tuple(
                jnp.linalg.qr(p @ b)[0] for p, b in zip(products, moments.bases, strict=True)
            ),
            lambda: moments.bases,
        )
        return left @ step @ right.T, Moments(first, second, products, bases)

    def mean(old, new):
        return decay * old + (1 - decay) * new

    return optax.GradientTransformation(init, update)
