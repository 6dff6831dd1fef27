"""The checks that the learned solvers share, made when they are traced."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import PyTree

from ..._custom_types import Y
from ..._solver.terms import is_backsolve
from ..._tree import tree_shapes


def check_nodes(nodes: int) -> None:
    if not isinstance(nodes, int) or nodes < 2:
        raise ValueError(f"`nodes` must be an integer of at least 2, but is {nodes!r}.")


def check_learned_terms(terms: PyTree[dfx.AbstractTerm], name: str) -> None:
    """Raises if the solver is given the adjoint equations, for which it was not trained."""
    if is_backsolve(terms):
        raise ValueError(
            f"`{name}` cannot solve the adjoint equations of `diffrax.BacksolveAdjoint`: it was "
            "trained for the equations themselves. Name another solver for them, for example "
            "`BacksolveAdjoint(solver=diffrax.Tsit5())`, or use "
            "`diffrax.RecursiveCheckpointAdjoint()`."
        )


def check_output(function: Callable[..., Any], arguments: tuple, y0: Y, name: str) -> None:
    """Raises unless `function(*arguments)` is shaped like the state."""
    arguments = jtu.tree_map(jnp.asarray, arguments)
    output = eqx.filter_eval_shape(function, *arguments)
    got, expected = tree_shapes(output), tree_shapes(y0)
    if got != expected:
        raise ValueError(
            f"`{name}` returns the structure {got}, but the state has {expected}. "
            "Both must be the same."
        )
