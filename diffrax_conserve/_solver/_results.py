"""Results of a step with messages of our own, in diffrax's list of results.

A step reports its failure by a member of `diffrax.RESULTS`, which diffrax turns into an error where
the solve really ends (an adaptive solver rejects the step and goes on). The members that diffrax
has speak of implicit solvers and cannot hold a name or a number. So messages of ours are added to
the end of its list when a solver is traced, one for each name and each number.
"""

from collections.abc import Callable, Hashable, Iterable

import diffrax as dfx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Int

from .._custom_types import IntScalarLike, RealScalarLike

# Where in the list the messages of each key start.
_FIRST: dict[Hashable, int] = {}


def register(key: Hashable, messages: Callable[[], Iterable[str]]) -> int | None:
    """The index of the first of `messages()`, added once for each `key`; `None` if diffrax's list
    is not what it was, and the members that it has must do."""
    # private: `equinox.Enumeration` has no public way to add to one.
    known = getattr(dfx.RESULTS, "_index_to_message", None)
    if not isinstance(known, list):
        return None
    if key not in _FIRST:
        _FIRST[key] = len(known)
        known.extend(messages())
    return _FIRST[key]


def member(index: IntScalarLike) -> dfx.RESULTS:
    """The result at an index of the list."""
    kind = type(dfx.RESULTS.successful)
    return kind(jnp.asarray(index, jnp.int32), dfx.RESULTS)  # pyright: ignore


def numbered(
    template: str, number: RealScalarLike, *, digits: int, decades: tuple[int, int]
) -> dfx.RESULTS:
    """The result with the message `template`, in whose one place `number` is written to `digits`
    digits. Its modulus is cut off at the powers of ten `decades`; zero is zero."""
    first = register(
        (template, digits, decades),
        lambda: [template.format(text) for text in _texts(digits, decades)],
    )
    if first is None:
        return dfx.RESULTS.promote(optx.RESULTS.nonlinear_divergence)
    return member(first + _position(jnp.asarray(number, jnp.float32), digits, decades))


def _texts(digits: int, decades: tuple[int, int]) -> list[str]:
    """All positive numbers, zero, and all negative ones."""
    low, high = decades
    mantissas = range(10 ** (digits - 1), 10**digits)
    texts = [
        f"{m * 10.0 ** (k - digits + 1):.{digits}g}" for k in range(low, high) for m in mantissas
    ]
    texts.append(f"{10.0**high:.{digits}g} or more")
    return [*texts, "0", *("-" + text for text in texts)]


def _position(x: Array, digits: int, decades: tuple[int, int]) -> Int[Array, ""]:
    """Where `x` is in `_texts`; NaN is put with the largest numbers."""
    low, high = decades
    smallest = 10 ** (digits - 1)
    count = 9 * smallest * (high - low) + 1
    modulus = jnp.where(jnp.isnan(x), jnp.inf, jnp.abs(x))
    modulus = jnp.clip(modulus, 10.0**low, 10.0**high)
    decade = jnp.floor(jnp.log10(modulus))
    # Where roundoff gives the decade below or above, the mantissa makes up for it.
    mantissa = jnp.round(modulus / 10.0 ** (decade - digits + 1))
    position = 9 * smallest * (decade - low) + mantissa - smallest
    position = jnp.clip(position, 0, count - 1).astype(int)
    return jnp.where(x == 0, count, jnp.where(x < 0, position + count + 1, position))
