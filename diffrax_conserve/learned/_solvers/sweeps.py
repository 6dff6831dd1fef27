r"""Collocation on the Chebyshev points of a step, by correction sweeps.

A path $u$ through a step of length $h$ is stored as its states at the fractions $c_i$, one row
each. The collocation solution satisfies

$$u(c_i) = y_0 + h \int_0^{c_i} f(u(c))\,dc,$$

at all points, where the integral is that of the polynomial through the increments $h f$.
"""

import abc
from collections.abc import Callable
from typing import final

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Inexact

from ..._custom_types import Args, RealScalarLike, Y
from .chebyshev import fractions, integrals

Path = Inexact[Array, "nodes n"]
# `(fraction of the step, state as a vector) -> h f`.
Increment = Callable[[Array, Inexact[Array, " n"]], Inexact[Array, " n"]]


def increment(
    terms: dfx.AbstractTerm, t0: RealScalarLike, t1: RealScalarLike, like: Y, args: Args
) -> Increment:
    """The vector field of the term times the length of the step."""
    control = terms.contr(t0, t1)
    length = jnp.asarray(t1 - t0)
    _, unravel = ravel_pytree(like)

    def evaluate(fraction: Array, vector: Array) -> Array:
        t = t0 + fraction.astype(length.dtype) * length
        change, _ = ravel_pytree(terms.vf_prod(t, unravel(vector), args, control))
        return change.astype(vector.dtype)

    return evaluate


class AbstractSweep(eqx.Module):
    """An iteration for the collocation equations of a step."""

    @abc.abstractmethod
    def __call__(self, increment: Increment, path: Path) -> Path:
        """The path after one iteration."""

    @abc.abstractmethod
    def power(self, power: int) -> int:
        """The power of the step size in the error of the new path, given that of the old one."""


@final
class Picard(AbstractSweep):
    r"""The sweep $u \leftarrow y_0 + h \int f(u)$, at all points in parallel."""

    def __call__(self, increment: Increment, path: Path) -> Path:
        return path[0] + integrals(jax.vmap(increment)(_fractions(path), path))

    def power(self, power: int) -> int:
        return power + 1


@final
class NewtonSweep(AbstractSweep):
    """A Newton iteration, with a dense linear system of the size of the state times the nodes."""

    def __call__(self, increment: Increment, path: Path) -> Path:
        if jnp.issubdtype(path.dtype, jnp.complexfloating):
            raise TypeError(
                "`NewtonSweep` needs a real state, but this one is complex. Split it into its real "
                "and its imaginary part, or use `sweep=diffrax_conserve.learned.Picard()`."
            )
        count, n = path.shape
        residual = Picard()(increment, path) - path
        jacobians = jax.vmap(jax.jacfwd(increment, argnums=1))(_fractions(path), path)
        # The first point is the initial state, which is known.
        weights = integrals(jnp.eye(count, dtype=path.dtype))[1:, 1:]
        blocks = jnp.einsum("ij,jab->iajb", weights, jacobians[1:])
        size = (count - 1) * n
        matrix = jnp.eye(size, dtype=path.dtype) - blocks.reshape(size, size)
        change = jnp.linalg.solve(matrix, residual[1:].reshape(size)).reshape(count - 1, n)
        return path.at[1:].add(change)

    def power(self, power: int) -> int:
        return 2 * power + 1


def correct(
    sweep: AbstractSweep, increment: Increment, path: Path, count: int
) -> tuple[Path, Inexact[Array, " n"]]:
    """The path after `count` sweeps, and the change by the last of them at the end of the step."""
    previous = path
    for _ in range(count):
        previous, path = path, sweep(increment, path)
    return path, path[-1] - previous[-1]


def _fractions(path: Path) -> Array:
    return fractions(path.shape[0], jnp.finfo(path.dtype).dtype)
