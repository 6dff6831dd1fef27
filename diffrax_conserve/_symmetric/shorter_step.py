"""Dense output by a shorter step, and the root of an equation with its derivative."""

from collections.abc import Callable
from typing import Any, final

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._custom_types import RealScalarLike, Y
from .._interpolation import PackedTarget
from .._tree import tree_sub, unflatten


class StepOf(eqx.Module):
    """What a step needs beside its times and its state."""

    solver: dfx.AbstractSolver
    terms: PyTree[dfx.AbstractTerm]
    args: Any
    state: Any


@final
class ShorterStep(dfx.AbstractLocalInterpolation):
    """The state at a time inside a step is that of a step of the same solver to this time.

    So it is on the manifold and as accurate as the step, and it meets the states at both ends.
    There is no extrapolation: a time outside the step is replaced by the nearer end.
    """

    t0: RealScalarLike  # pyright: ignore[reportIncompatibleVariableOverride]
    t1: RealScalarLike  # pyright: ignore[reportIncompatibleVariableOverride]
    y0: Y
    step: PackedTarget

    @eqx.filter_jit  # traced once for all saved times
    def evaluate(
        self, t0: RealScalarLike, t1: RealScalarLike | None = None, left: bool = True
    ) -> PyTree[Array]:
        if t1 is not None:
            return tree_sub(self.evaluate(t1, left=left), self.evaluate(t0, left=left))
        # A time exactly at an end is inside, so that there is a derivative in time.
        t = jnp.where(t0 < self.t0, self.t0, jnp.where(t0 > self.t1, self.t1, t0))
        of: Any = self.step.unpack()
        return of.solver.step(of.terms, self.t0, t, self.y0, of.args, of.state, False)[0]


def root(
    residual: Callable[[Any], Any],
    guess: Any,
    iterate: Callable[[Any], tuple[Any, Any]],
    solve: Callable[[Float[Array, "n n"], Float[Array, " n"]], Float[Array, " n"]],
) -> tuple[Any, Any]:
    """The root of `residual` that `iterate(guess)` finds, and what else that returns. The
    derivative of the root follows from the implicit function theorem, by the dense Jacobian and
    `solve(matrix, vector)`. The rest has none."""

    def tangent(linear: Callable[[Any], Any], right: Any) -> Any:
        flat, like = _flat(right), jax.eval_shape(lambda: right)
        matrix = jax.jacfwd(lambda x: _flat(linear(unflatten(x, like))))(jnp.zeros_like(flat))
        return unflatten(solve(matrix, flat), like)

    # `custom_root` gives the rest a tangent of its own type, which integers and booleans cannot
    # have. So they pass as numbers of the type of the root.
    _, like = jax.eval_shape(iterate, guess)
    dtype = jax.tree.leaves(guess)[0].dtype

    def solution(_: Any, x: Any) -> tuple[Any, Any]:
        x, more = iterate(x)
        return x, jax.tree.map(lambda a: a.astype(dtype), more)

    found, more = lax.custom_root(residual, guess, solution, tangent, has_aux=True)
    return found, jax.tree.map(lambda a, b: a.astype(b.dtype), more, like)


def _flat(tree: Any) -> Float[Array, " n"]:
    """The elements of a tree of vectors as one vector."""
    return jnp.concatenate(jax.tree.leaves(tree))
