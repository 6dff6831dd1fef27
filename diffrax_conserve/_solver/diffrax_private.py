"""All uses of private names of diffrax: `_term.WrapTerm`, `_term.AdjointTerm` and
`RESULTS._index_to_message`. No other file has one.

Only by `WrapTerm` can a solver tell that `t1 < t0`, where `diffeqsolve` negates its times, and only
by `AdjointTerm` that it is called by `BacksolveAdjoint`, whose state is not on the manifold.

A step reports its failure by a member of `diffrax.RESULTS`, whose messages are about implicit
solvers. Ours are appended to its private list `_index_to_message` when this package is imported, so
that an index into it has the same meaning in every process, in a pickled solution and in a cached
compiled program. The list belongs to the enumerations of equinox.
"""

import diffrax as dfx
import jax.numpy as jnp
from diffrax._term import AdjointTerm as AdjointTerm
from diffrax._term import WrapTerm as WrapTerm

from .._custom_types import IntScalarLike


def register(*messages: str) -> int:
    """Appends `messages` and returns the index of the first. Call it when a module is imported."""
    try:
        known = dfx.RESULTS._index_to_message
        known.extend(f"diffrax_conserve: {message}" for message in messages)
    except AttributeError as error:
        raise ImportError(
            "This version of diffrax has no list `diffrax.RESULTS._index_to_message` for messages. "
            "Install a version of diffrax_conserve that was made for it."
        ) from error
    return len(known) - len(messages)


def result_at(index: IntScalarLike) -> dfx.RESULTS:
    """The result with the given index in the list."""
    kind = type(dfx.RESULTS.successful)
    return kind(jnp.asarray(index, jnp.int32), dfx.RESULTS)  # pyright: ignore
