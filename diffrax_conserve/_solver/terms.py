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
    wrapped = [x for x in _leaves(terms, WrapTerm) if isinstance(x, WrapTerm)]
    direction = wrapped[0].direction if wrapped else 1
    return jnp.asarray(direction, jnp.result_type(t))


def is_backsolve(terms: PyTree[dfx.AbstractTerm]) -> bool:
    """Whether this is the backward solve of a `diffrax.BacksolveAdjoint`."""
    inner = [x.term if isinstance(x, WrapTerm) else x for x in _leaves(terms, WrapTerm)]
    return any(isinstance(x, AdjointTerm) for x in inner)


def check_ode(terms: PyTree[dfx.AbstractTerm], name: str) -> None:
    """Raises unless every term is a `diffrax.ODETerm`, whose control is time."""
    for term in _innermost(terms):
        if not isinstance(term, dfx.ODETerm):
            raise TypeError(
                f"`{name}` solves ordinary differential equations, but is given a "
                f"`{type(term).__name__}`. Pass a `diffrax.ODETerm`; for a stochastic equation "
                "take a solver of diffrax, for example `diffrax.Heun()`."
            )


def is_ode(terms: PyTree[dfx.AbstractTerm]) -> bool:
    """Whether every term is a `diffrax.ODETerm`."""
    return all(isinstance(term, dfx.ODETerm) for term in _innermost(terms))


def _innermost(terms: PyTree[dfx.AbstractTerm]) -> list[Any]:
    """The terms inside `MultiTerm`, `WrapTerm` and `AdjointTerm`."""
    found = []
    for term in _leaves(terms, (dfx.AbstractTerm, WrapTerm)):
        if isinstance(term, dfx.MultiTerm):
            found += _innermost(term.terms)
        elif isinstance(term, WrapTerm | AdjointTerm):
            found += _innermost(term.term)
        else:
            found.append(term)
    return found


def _leaves(terms: PyTree[dfx.AbstractTerm], kind: type | tuple[type, ...]) -> list[Any]:
    return jtu.tree_leaves(terms, is_leaf=lambda x: isinstance(x, kind))
