"""Functions with a Jacobian given by the user, for functions that autodiff cannot differentiate."""

import functools as ft
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool

from ._custom_types import Args, ConstraintFn, RealScalarLike, Values, Y
from ._options import check_function
from ._tree import tree_add, tree_max, tree_tangents, working_dtype


class WithJacobian(eqx.Module):
    """`fn`, whose derivative by the state is `jacobian`; by everything else autodiff differentiates
    it."""

    fn: ConstraintFn
    jacobian: Any  # a function like `fn`; checked below, with a remedy

    def __check_init__(self):
        what = "the derivative of `fn` by the state"
        check_function("jacobian", "manifold's entry", self.jacobian, "t, y, args", what)

    def __call__(self, t: RealScalarLike, y: Y, args: Args) -> Values:
        return _call((self.fn, self.jacobian, t, args), y)

    def is_wrong(self, t: RealScalarLike, y: Y, args: Args) -> Bool[Array, ""]:
        """Whether derivatives at `y`, along two directions, differ from central difference
        quotients by more than these can be wrong."""
        info = jnp.finfo(working_dtype(y))
        eps = float(info.eps)
        step, tolerance = eps ** (1 / 3), eps ** (1 / 8)
        # A state of zeros has no size, and steps from one that is nearly zero underflow.
        largest = jnp.where(tree_max(y) > float(info.tiny) / eps, tree_max(y), 1)
        rng = np.random.default_rng(0)
        value, rows = self.fn(t, y, args), self.jacobian(t, y, args)

        def signs(x: Array) -> Array:
            return jnp.asarray(rng.choice([-1.0, 1.0], jnp.shape(x)), jnp.real(x).dtype)

        def along(x: Array, phase: Array) -> Array:
            return (jnp.abs(x) + 0.1 * largest.astype(jnp.real(x).dtype)) * phase

        def combined(value: Array, row: Any) -> Y:
            return jtu.tree_map(lambda r: jnp.tensordot(signs(value), r, axes=value.ndim), row)

        # Along the first direction the terms of a single gradient have the same sign.
        sums = jtu.tree_leaves(value), jtu.tree_structure(value).flatten_up_to(rows)
        total = ft.reduce(tree_add, map(combined, *sums))
        phases = jtu.tree_map(lambda r: jnp.where(r == 0, 1, jnp.conj(r) / jnp.abs(r)), total)
        directions = [jtu.tree_map(along, y, x) for x in (phases, jtu.tree_map(signs, y))]

        def moved(direction: Y, factor: float) -> Values:
            there = jtu.tree_map(lambda x, v: (x + factor * v).astype(x.dtype), y, direction)
            return self.fn(t, there, args)

        def differs(value: Array, ahead: Array, behind: Array, row: Any, v: Y) -> Array:
            quotient = (ahead - behind) / (2 * step)
            terms = _product(value, jtu.tree_map(jnp.abs, row), jtu.tree_map(jnp.abs, v))
            size = tolerance * jnp.maximum(terms, jnp.abs(quotient))
            roundoff = 100 * eps / step * jnp.maximum(jnp.abs(value), jnp.abs(ahead))
            # NaN tells nothing: `fn` need not be defined there.
            return jnp.any(jnp.abs(quotient - _product(value, row, v)) > size + roundoff)

        wrong = []
        for v in directions:
            ahead, behind = moved(v, step), moved(v, -step)
            differ = ft.partial(differs, v=v)
            wrong += jtu.tree_leaves(jtu.tree_map(differ, value, ahead, behind, rows))
        return jnp.any(jnp.stack(wrong))


@eqx.filter_custom_jvp
def _call(others: Any, y: Y) -> Values:
    fn, _, t, args = others
    return jtu.tree_map(jnp.asarray, fn(t, y, args))


@_call.def_jvp
def _call_jvp(primals, tangents):
    """`J ẏ`, plus the derivatives by the time, the parameters and the arrays of `fn` by
    autodiff."""
    others, y = primals
    t_others, t_y = tangents
    fn, jacobian, t, args = others
    value = _call(others, y)
    total = jtu.tree_map(jnp.zeros_like, value)
    if any(x is not None for x in jtu.tree_leaves(t_y)):
        t_y = tree_tangents(y, t_y)
        rows = jacobian(t, y, args)
        total = jtu.tree_map(lambda v, row: _product(v, row, t_y), value, rows)
    t_fn, _, t_t, t_args = t_others
    if jtu.tree_leaves((t_fn, t_t, t_args)):
        given = (fn, t, args), (t_fn, t_t, t_args)
        _, rest = eqx.filter_jvp(lambda f, t, args: f(t, y, args), *given)
        total = tree_add(total, tree_tangents(value, rest))
    return value, total


def _product(value: Array, row: Any, t_y: Y) -> Array:
    """`row · ẏ`, where `row` is shaped like the state with the axes of `value` prepended to each
    leaf."""
    expected = jtu.tree_map(lambda t: value.shape + t.shape, t_y)
    got = jtu.tree_map(jnp.shape, row)
    if got != expected:
        raise ValueError(
            f"`jacobian` returned arrays of the shapes {got}, but they must be {expected}: for "
            "each array that `fn` returns a PyTree like the state, each leaf with the axes of that "
            "array first, as `jax.jacrev(fn, argnums=1)` returns them."
        )
    terms = jtu.tree_map(
        lambda r, t: jnp.real(jnp.tensordot(jnp.asarray(r), t, axes=t.ndim)).astype(value.dtype),
        row,
        t_y,
    )
    return sum(jtu.tree_leaves(terms))  # pyright: ignore[reportReturnType]
