"""A residual to first order: its value and its constraint Jacobian at a state.

`linearise` chooses the form of the Jacobian. Up to ten constraints are handled as scalars: each
product, sum and 2×2 solve is elementwise arithmetic that XLA fuses into the surrounding step (a
`linalg` call on a 2×2 matrix costs more than the step itself). More constraints form a matrix. For
more than `DENSE_MAX` the rows are never formed.

A vector of `m` numbers (residuals, multipliers) is accordingly one array of shape `(m,)` or a tuple
of `m` scalars. Code that uses one treats it as a PyTree.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Real

from .._custom_types import Y
from .elimination import Vector
from .jacobian import UNROLLED_MAX, AbstractJacobian, Dense, MatrixFree, Unrolled
from .scalars import elements_in_scalars

Residual = Callable[[Y], Vector]

# Above this many constraints the gradients are never formed, only products with them.
DENSE_MAX = 128


def linearise(residual: Residual, y: Y) -> tuple[Vector, AbstractJacobian]:
    """`g(y)` and `G(y)`."""
    struct = eqx.filter_eval_shape(residual, y)
    if isinstance(struct, tuple):
        # One reverse pass per constraint, each of which touches only what that constraint depends
        # on; XLA merges the forward passes.
        fns = [lambda y, i=i: residual(y)[i] for i in range(len(struct))]
        fns = residual.fns if isinstance(residual, Elements) else fns
        outs, rows = zip(*(jax.value_and_grad(fn)(y) for fn in fns), strict=True)
        return outs, Unrolled(rows)
    out, vjp = jax.vjp(residual, y)
    if out.size > DENSE_MAX:
        _, jvp = jax.linearize(residual, y)
        return out, MatrixFree(jvp, lambda multiplier: vjp(multiplier)[0])
    (rows,) = jax.vmap(vjp)(jnp.eye(out.size, dtype=out.dtype))
    return out, Dense(rows)


class Joined(eqx.Module):
    """A residual of shape `(m,)`, joined from the arrays that `parts` returns."""

    parts: Callable[[Y], list[Array]]

    def __call__(self, y: Y) -> Real[Array, " m"]:
        return jnp.concatenate([x.reshape(-1) for x in self.parts(y)])


class Elements(eqx.Module):
    """A residual given as a list of functions, whose values are a tuple of scalars."""

    fns: list[Residual]

    @classmethod
    def of(cls, residual: Joined, y: Y) -> "Elements":
        # Elements of the parts, not of the joined vector: the gradient of an element of that would
        # contain the gradients of all parts, most of them multiplied by zero.
        sizes = [x.size for x in eqx.filter_eval_shape(residual.parts, y)]

        def element(part: int, i: int) -> Residual:
            return lambda y: residual.parts(y)[part].reshape(-1)[i]

        return cls([element(part, i) for part, size in enumerate(sizes) for i in range(size)])

    def __call__(self, y: Y) -> tuple[Array, ...]:
        return tuple(fn(y) for fn in self.fns)


# A residual in another form, and the maps to the new form of the state and back.
Converted = tuple[Joined | Elements, Callable[[Y], Y], Callable[[Y], Y]]


def written_out(residual: Joined, y: Y) -> Converted:
    """The same residual as scalars if there are few constraints, with states as scalars too if
    these are small."""
    if eqx.filter_eval_shape(residual, y).size > UNROLLED_MAX:
        return residual, _same, _same
    converted = elements_in_scalars(residual, y)
    if converted is None:
        return Elements.of(residual, y), _same, _same
    fns, split, join = converted
    return Elements(fns), split, join


def flattened(residual: Joined, y: Y) -> Converted:
    """The same residual as a function of the state in one vector, if all leaves have one dtype.
    This gives fewer operations, each on more numbers."""
    if len({x.dtype for x in jtu.tree_leaves(y)}) > 1:
        return residual, _same, _same
    _, join = jfu.ravel_pytree(jtu.tree_map(jnp.zeros_like, y))
    return Joined(lambda x: residual.parts(join(x))), lambda y: jfu.ravel_pytree(y)[0], join


def _same(y: Y) -> Y:
    return y


def as_array(vector: Vector) -> Real[Array, " m"]:
    """A vector of either form as an array of shape `(m,)`."""
    return jnp.stack(vector) if isinstance(vector, tuple) else vector
