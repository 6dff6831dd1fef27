"""Messages of failed steps, which say what failed, how far off it is, and what to do: of a failed
projection one for each entry of a manifold and each order of magnitude.
"""

import itertools

import diffrax as dfx
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jaxtyping import Array, Bool

from .._custom_types import Manifold, Values
from .._manifold import is_entry, named_entries
from .._projection import DECADES, ProjectionInfo
from ._results import member, register

# The kinds of messages for one entry; the decades follow.
_NONFINITE, _TOO_FAR, _FIRST_DECADE = 0, 1, 2
_KINDS = _FIRST_DECADE + len(DECADES)
# Of a manifold with more entries, none is named.
_NAMED_MAX = 50


def failure(info: ProjectionInfo, manifold: Manifold, values: Values) -> dfx.RESULTS:
    """The result of a step whose projection failed as `info` says."""
    names = tuple(name for name, _ in named_entries(manifold))
    treedef = jtu.tree_structure(manifold, is_leaf=is_entry)
    sizes = [
        sum(jnp.size(x) for x in jtu.tree_leaves(entry)) for entry in treedef.flatten_up_to(values)
    ]
    if len(names) > _NAMED_MAX:
        names, sizes = ("manifold",), [sum(sizes)]
    first = register(names, lambda: [text for name in names for text in _messages(name)])
    if first is None:
        return dfx.RESULTS.promote(info.result)
    # Written out: this is computed at every step, needed or not.
    entry = jnp.asarray(0, jnp.int32)
    for end in itertools.accumulate(sizes[:-1]):
        entry = entry + (info.failure.index >= end).astype(jnp.int32)
    unsatisfied = info.failure.decade - DECADES[0]
    kind = jnp.where(unsatisfied < 0, _TOO_FAR, _FIRST_DECADE + unsatisfied)
    kind = jnp.where(info.failure.nonfinite, _NONFINITE, kind)
    return member(first + _KINDS * entry + kind)


def unsolved(found: Bool[Array, ""]) -> dfx.RESULTS:
    """The result of a step of a `RandomFeatureSolver`, by whether its equations were solved."""
    first = register("RandomFeatureSolver", lambda: [_UNSOLVED])
    failed = (
        dfx.RESULTS.promote(optx.RESULTS.nonlinear_max_steps_reached)
        if first is None
        else member(first)
    )
    return dfx.RESULTS.where(found, dfx.RESULTS.successful, failed)


_UNSOLVED = (
    "diffrax_conserve: the equations of a step of `RandomFeatureSolver` were not solved. Newton's "
    "method diverged, or the vector field is not finite near the step. Take smaller steps: a "
    "smaller `dt0`, or with `diffrax.PIDController`, which tries them by itself, a smaller `dtmin`."
)


def _messages(name: str) -> list[str]:
    start = "diffrax_conserve: the projection of a step failed. "
    nonfinite = (
        f"`{name}` is not finite at the state that the wrapped solver proposed, or the state "
        "itself is not. Take smaller steps, and check the vector field and `fn` there."
    )
    too_far = (
        f"It moved the state further than `max_correction` allows, to satisfy `{name}` among "
        "others: perhaps to another part of the manifold. Take smaller steps, or raise "
        "`max_correction`. If the conserved `value` is not that of the initial state, project "
        "that first, with `diffrax_conserve.project`."
    )

    def unsatisfied(decade: int) -> str:
        remedy = (
            "That is close: if `fn` is not accurate to roundoff, pass `projection="
            "SimplifiedNewton(rtol=...)` with its accuracy"
            if decade < -8
            else "Take smaller steps, or pass `projection=diffrax_conserve.Newton()`, which copes "
            "with candidates far from the manifold. If that fails too, the constraints may "
            "contradict each other"
        )
        size = "1e3 or more" if decade == DECADES[-1] else f"about 1e{decade}"
        return f"`{name}` is still off by {size} of its scale. {remedy}."

    return [start + x for x in (nonfinite, too_far, *map(unsatisfied, DECADES))]
