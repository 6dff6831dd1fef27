"""Properties of a solve that its terms, given to a solver's `init` and `step`, reveal."""

from typing import Any

import diffrax as dfx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree, Real

from .._custom_types import RealScalarLike
from .diffrax_private import AdjointTerm, WrapTerm


def time_direction(terms: PyTree[dfx.AbstractTerm], t: RealScalarLike) -> Real[Array, ""]:
    """`-1` in a solve with `t1 < t0`, for which `diffeqsolve` negates all times before it calls the
    solver; otherwise `1`. In the dtype of `t`."""
    directions = [x.direction for x in _nested(terms) if isinstance(x, WrapTerm)]
    return jnp.asarray(directions[0] if directions else 1, jnp.result_type(t))


def is_backsolve(terms: PyTree[dfx.AbstractTerm]) -> bool:
    """Whether this is the backward solve of a `diffrax.BacksolveAdjoint`."""
    return any(isinstance(x, AdjointTerm) for x in _nested(terms))


def is_ode(terms: PyTree[dfx.AbstractTerm]) -> bool:
    """Whether every term is a `diffrax.ODETerm`, whose control is time."""
    return not _others(terms)


def check_ode(terms: PyTree[dfx.AbstractTerm], name: str) -> None:
    """Raises unless every term is a `diffrax.ODETerm`."""
    for term in _others(terms):
        raise TypeError(
            f"`{name}` solves ordinary differential equations, but is given a "
            f"`{type(term).__name__}`. Pass a `diffrax.ODETerm`; for a stochastic equation take a "
            "solver of diffrax, for example `diffrax.Heun()`."
        )


def _others(terms: PyTree[dfx.AbstractTerm]) -> list[Any]:
    return [x for x in _nested(terms) if not isinstance(x, (dfx.ODETerm, *_COMPOSED))]


_COMPOSED = dfx.MultiTerm, WrapTerm, AdjointTerm


def _nested(terms: Any) -> list[Any]:
    """All terms, those inside `MultiTerm`, `WrapTerm` and `AdjointTerm` too."""
    found = jtu.tree_leaves(terms, is_leaf=lambda x: isinstance(x, dfx.AbstractTerm))
    parts = [
        x.terms if isinstance(x, dfx.MultiTerm) else x.term
        for x in found
        if isinstance(x, _COMPOSED)
    ]
    return found + (_nested(parts) if parts else [])
