"""Refuses a solve that starts off its constraints."""

import functools as ft

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu

from .._custom_types import Args, Manifold, RealScalarLike, Values, Y
from .._manifold import Constraint, evaluate, is_entry, named_entries, scales

# A message of a compiled program cannot hold a number, but it can be one of several.
_DECADES = range(-4, 4)


def refuse_violated_constraints(
    manifold: Manifold, values: Values, t: RealScalarLike, y: Y, args: Args
) -> Values:
    """The conserved values, with a run-time error attached if the initial state violates a
    `Constraint`.

    A first integral with a `value` of its own is not checked: to move there can be meant. The
    limit, the fourth root of roundoff, leaves room for a perturbed initial state, as in a finite
    difference; the first step projects that to the manifold.
    """
    outputs = evaluate(manifold, t, y, args)
    scale = scales(manifold, values, t, y, args)
    treedef = jtu.tree_structure(manifold, is_leaf=is_entry)
    trees = (treedef.flatten_up_to(tree) for tree in (values, outputs, scale))
    checked = [
        _refuse(name, value, output, size) if isinstance(entry, Constraint) else value
        for (name, entry), value, output, size in zip(named_entries(manifold), *trees, strict=True)
    ]
    return jtu.tree_unflatten(treedef, checked)


def _refuse(name: str, value: Values, output: Values, scale: Values) -> Values:
    ratios = jtu.tree_map(
        lambda g, s: jnp.max(jnp.where(s > 0, jnp.abs(g) / jnp.where(s > 0, s, 1), jnp.abs(g))),
        output,
        scale,
    )
    violation = ft.reduce(jnp.maximum, jtu.tree_leaves(ratios))
    limit = jnp.finfo(violation.dtype).eps ** 0.25
    decade = jnp.floor(jnp.log10(jnp.maximum(violation, limit)))
    index = jnp.clip(decade, _DECADES[0], _DECADES[-1]).astype(int) - _DECADES[0]
    messages = [
        f"The initial state violates the constraint `{name}` by about 1e{k} of its scale. Start on "
        "the manifold: `y0, info = diffrax_conserve.project(manifold, y0, t=t0, args=args)`."
        for k in _DECADES
    ]
    return eqx.branched_error_if(value, ~(violation <= limit), index, messages)
