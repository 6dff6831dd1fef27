"""What only private names of diffrax give: no other file touches one.

`WrapTerm` alone tells a solver that `t1 < t0`, where `diffeqsolve` negates its times, and
`AdjointTerm` that it is called by `BacksolveAdjoint`, whose state is not on the manifold.

`register` adds messages of our own to diffrax's list of results. A step reports its failure by a
member of `diffrax.RESULTS`, which diffrax turns into an error where the solve really ends. Its own
members speak of implicit solvers. So messages are added to the end of its list, once, when a module
of this package is imported: the list is the same in every process, and an index into it means the
same in a pickled solution and in a cached compiled program.
"""

import diffrax as dfx
import jax.numpy as jnp
from diffrax._term import AdjointTerm as AdjointTerm
from diffrax._term import WrapTerm as WrapTerm

from .._custom_types import IntScalarLike


def register(*messages: str) -> int:
    """The index of the first of `messages`, which are added. Call it when a module is imported."""
    known = getattr(dfx.RESULTS, "_index_to_message", None)
    if not isinstance(known, list):
        raise ImportError(
            "diffrax_conserve adds its messages to the list `diffrax.RESULTS._index_to_message`, "
            "which this version of diffrax does not have. Install a version of diffrax_conserve "
            "that was made for it."
        )
    known.extend(f"diffrax_conserve: {message}" for message in messages)
    return len(known) - len(messages)


def member(index: IntScalarLike) -> dfx.RESULTS:
    """The result at an index of the list."""
    kind = type(dfx.RESULTS.successful)
    return kind(jnp.asarray(index, jnp.int32), dfx.RESULTS)  # pyright: ignore
