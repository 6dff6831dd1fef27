"""The result of a step whose projection failed: one message for each cause and each entry."""

import itertools

import diffrax as dfx
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jaxtyping import Array, Bool

from .._custom_types import Manifold, Values
from .._manifold import is_entry
from .._projection.base import ProjectionInfo
from .diffrax_private import member, register
from .initial import FINE, Initial

# The entries of a manifold from this position on share one message.
_POSITIONS = 16

_STEP, _START = "the projection of a step failed: ", "the solve cannot start: "
_REMEDY = (
    "Take smaller steps, or pass `projection=diffrax_conserve.Newton()`, which copes with "
    "candidates far from the manifold. Check by `check_invariance` that the quantity is conserved "
    "at all."
)
_CAUSES = (
    _STEP + "{name} is not finite at the state that the wrapped solver proposed, or the state "
    "itself is not. Take smaller steps, and check the vector field and `fn` there.",
    _STEP + "the correction that satisfies {name} and the others moved the state further than "
    "`max_correction` allows. Perhaps the quantity is not conserved at all, which "
    "`check_invariance` tells, or the state jumped to another part of the manifold. Take smaller "
    "steps, or pass another `max_correction`.",
    _STEP + "{name} is still not satisfied, and the iteration diverged. " + _REMEDY,
    _STEP + "{name} is still not satisfied when the iteration ends. " + _REMEDY + " If it is, the "
    "constraints may contradict each other or the bounds, or `fn` is less accurate than roundoff: "
    "then pass its accuracy, `projection=SimplifiedNewton(rtol=...)`. `statistics` has the "
    "residual.",
    _START + "{name} is not finite at the initial state. Check `fn`, `y0` and `args`.",
    _START + "the initial state violates {name}. Start on the manifold: "
    "`y0, info = diffrax_conserve.project(manifold, y0, t=t0, args=args)`.",
    _START + "the conserved `value` of {name} cannot be reached from the initial state. Check the "
    "value, or find a state that has it by `diffrax_conserve.project`.",
    _START + "the `jacobian` of {name} is not the derivative of its `fn` at the initial state. "
    "Compare it with difference quotients, by `jax.test_util.check_grads` for example.",
    _START + "{name} is not a first integral: it changes along the vector field, as "
    "`check_invariance` tells. If it has sources, give their `rate`. To keep it all the same, for "
    "example of a network that is not trained, pass `max_correction=jax.numpy.inf`.",
)
_NONFINITE, _TOO_FAR, _DIVERGED, _UNSATISFIED = range(4)
# The index of the first cause from `initial.py` other than `FINE`.
_INITIAL = 4


def _names() -> list[str]:
    named = [
        f"entry {i} of the manifold (`diffrax_conserve.entry_name(manifold, {i})` names it)"
        for i in range(_POSITIONS)
    ]
    return ["`manifold`", *named, f"an entry of the manifold from {_POSITIONS} on"]


_FIRST = register(*(cause.format(name=name) for name in _names() for cause in _CAUSES))


def failure(
    info: ProjectionInfo,
    too_far: Bool[Array, ""],
    initial: Initial,
    manifold: Manifold,
    values: Values,
) -> dfx.RESULTS:
    """The result of a step whose projection failed as `info` reports or moved the state `too_far`,
    or whose solve has an invalid initial state."""
    treedef = jtu.tree_structure(manifold, is_leaf=is_entry)
    sizes = [
        sum(jnp.size(x) for x in jtu.tree_leaves(entry)) for entry in treedef.flatten_up_to(values)
    ]
    # Written out, because it is computed at every step.
    position = jnp.asarray(0, jnp.int32)
    for end in itertools.islice(itertools.accumulate(sizes[:-1]), _POSITIONS):
        position = position + (info.worst >= end).astype(jnp.int32)
    kinds = optx.RESULTS
    cause = jnp.where(info.result == kinds.nonlinear_divergence, _DIVERGED, _UNSATISFIED)
    cause = jnp.where(info.result == kinds.nonfinite, _NONFINITE, cause)
    cause = jnp.where(too_far, _TOO_FAR, cause)
    started = initial.cause == FINE
    cause = jnp.where(started, cause, _INITIAL + initial.cause - 1)
    position = jnp.where(started, position, jnp.minimum(initial.position, _POSITIONS))
    name = 0 if len(sizes) == 1 else 1 + position
    return member(_FIRST + len(_CAUSES) * name + cause)
