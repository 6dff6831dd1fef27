"""A check by autodiff that a manifold is conserved by a vector field."""

import dataclasses
import functools as ft
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PRNGKeyArray, PyTree, Real

from .._balance import rates
from .._custom_types import Args, Manifold, RealScalarLike
from .._manifold import (
    Constraint,
    FirstIntegral,
    LieDerivative,
    check_manifold,
    check_vector_field,
    conserved_values,
    evaluate,
    is_entry,
    named_entries,
    noting_call_of,
    slope_of,
)
from .._numerics.problem import problem_of, relative_to_scale
from .._numerics.roundoff import cancellation_terms
from .._numerics.rows import AbstractRows
from .._options import ONE_STATE, check_function, one_of
from .._printing import printed
from .._tree import eps_of, irregular_weights, key_of, ravel, unravel

Entry = FirstIntegral | Constraint

# By default a defect of this many units of roundoff counts as roundoff. The number is a choice: the
# roundoff of a derivative grows with the number of operations, and a wrong integral has a defect of
# order one at almost every state. In half precision so many units
# are more than one, so that there a tenth of order one is the limit.
_ROUNDOFF, _LEAST_DEFECT = 1e4, 0.1
# The distance to another state at which a derivative is looked at too, as a share of each
# component.
_BESIDE = 0.1
# A second time, at which what depends on time should have another value: a number that is no
# multiple of a likely period.
LATER = 0.7390851332151607


@dataclasses.dataclass(frozen=True)
class InvarianceEntry:
    """The result of `check_invariance` for one entry of the manifold.

    `kind` is "first integral", "balance" or "constraint"; `defect` is the largest relative defect,
    at the state with the index `state`. `is_constant` tells that the gradient is zero at every
    state: such a function is conserved by any field. `is_tested` is false if all terms of
    the derivative are zero at every state, but not beside it: then nothing is known, and `ok` is
    false.
    """

    name: str
    kind: str
    defect: float
    state: int
    ok: bool
    is_constant: bool
    is_tested: bool


@dataclasses.dataclass(frozen=True)
class InvarianceReport:
    """What `check_invariance` found, printed as a table: `ok` if every entry is conserved, within
    `rtol`, at each of the `num_states` states."""

    entries: tuple[InvarianceEntry, ...]
    num_states: int
    rtol: float

    @property
    def ok(self) -> bool:
        return all(entry.ok for entry in self.entries)

    def __str__(self) -> str:
        tested = all(entry.is_tested for entry in self.entries)
        title = "conserved" if self.ok else "NOT CONSERVED" if tested else "NOT TESTED"
        title += f": derivatives along the flow at {self.num_states} states"
        title += f", relative tolerance {self.rtol:.1e}"
        rows = {"": f"{'':14}  largest relative defect"}
        for entry in self.entries:
            result = "conserved" if entry.ok else f"NOT conserved, see state {entry.state}"
            if not entry.is_tested:
                result = "NOT TESTED: each term of its derivative is zero at every state"
            if entry.is_constant:
                result += "; its gradient is zero at every state: nothing is kept"
            rows[entry.name] = f"{entry.kind:14}  {entry.defect:<8.1e}  {result}"
        return printed(title, rows)


def check_invariance(
    vector_field: Callable[[RealScalarLike, Any, Args], Any],
    manifold: Manifold,
    states: Any,
    *,
    t: Real[ArrayLike, "*states"] = 0.0,
    args: Args = None,
    key: PRNGKeyArray | None = None,
    # A misprint shows at almost every state, and more states cost little.
    num_states: int = 100,
    rtol: float | None = None,
) -> InvarianceReport:
    r"""Checks, by automatic differentiation, that a vector field conserves a manifold.

    At each state the derivative along the flow, relative to the size of its own terms, is

    $$\frac{|\partial_t I + \sum_i f_i \partial_i I|}{|\partial_t I| + \sum_i |f_i \partial_i I|},$$

    which is a few units of roundoff if $I$ is a first integral, and of order one at almost every
    state if it is not: a misprint in either $I$ or $f$ is found without a solver, if the terms that
    it changes are not below `rtol` of the others, as those of a light body beside a heavy one. A
    `rate` is subtracted from the derivative, and its size is added to the denominator.

    **Arguments:**

    - `vector_field`: $f$, called as `vector_field(t, y, args)`, or a `diffrax.ODETerm` of it.
    - `manifold`: a PyTree of `FirstIntegral`s and `Constraint`s.
    - `states`: a sampler `key -> y` such as `system.sample`, or a PyTree like `y` with a leading
        axis over the states. At an equilibrium every function is conserved, so they must be in
        general position: a sampler that multiplies a state leaves its zeros zero, and an entry
        whose derivative has no other terms is not tested. With a [`diffrax_conserve.Constraint`][]
        they must be on the manifold.
    - `t`: the time, or one for each state, as what depends on time needs it: at one time, such as
        the default, a derivative that is missing may be zero.
    - `args`: passed to `vector_field` and to the functions of the manifold.
    - `key`, `num_states`: the seed (default: `jax.random.key(0)`) and the number of sampled states.
    - `rtol`: the largest defect that counts as roundoff. Default: 10,000 machine epsilons, at
        most 0.1.

    **Returns:**

    An `InvarianceReport`.

    **Raises:**

    `ValueError` if a state violates a constraint, if an entry is conserved at the one time `t` but
    not at another, or if the value of `vector_field` is not shaped like `y`; `TypeError` or
    `ValueError` if `manifold` is not valid.

    !!! example

        ```python
        import diffrax_conserve as dfc

        system = dfc.systems.RigidBody()
        print(dfc.check_invariance(system.vector_field, system.manifold, system.sample))
        ```

        ```text
        conserved: derivatives along the flow at 100 states, relative tolerance 1.2e-03
                                                    largest relative defect
          energy                    first integral  1.2e-07   conserved
          squared angular momentum  first integral  1.2e-07   conserved
        ```
    """
    check_manifold(manifold)
    if isinstance(vector_field, dfx.ODETerm):
        vector_field = vector_field.vector_field
    check_vector_field(vector_field)
    ts, ys = batch(t, states, jr.key(0) if key is None else key, num_states)
    if rtol is None:
        rtol = min(_ROUNDOFF * eps_of(ts), _LEAST_DEFECT)
    with one_of(ys):
        found = _measure(vector_field, manifold, ts, ys, args)
        one_time = np.all(ts == ts[0])
        later = _measure(vector_field, manifold, ts + LATER, ys, args) if one_time else found
    entries = [
        _entry_of_report(name, entry, rtol, *map(np.asarray, measured))
        for (name, entry), measured in zip(entries_of(manifold), found, strict=True)
    ]
    for entry, (defect, violation, *_) in zip(entries, later, strict=True):
        # A state need not satisfy a moving constraint at another time. Such a one tells nothing.
        if entry.ok and np.any((defect > rtol) & (violation <= rtol)):
            raise ValueError(
                f"`{entry.name}` is conserved at t = {ts[0]:.3g}, the one time `t` of all states, "
                f"but not at t = {ts[0] + LATER:.3g}: it, its `rate` or `vector_field` depends on "
                f"time. Give one time for each state, such as `t=jnp.linspace(0, 10, {ts.size})`."
            )
    return InvarianceReport(tuple(entries), ts.size, rtol)


def batch(
    t: Real[ArrayLike, "*states"], states: Any, key: PRNGKeyArray, num_states: int
) -> tuple[Float[Array, " states"], PyTree[Array]]:
    """A time for each state, and the states, sampled if they are given by a sampler."""
    if callable(states):
        check_function("`states`", states, "states(key)", "a state")
        states = eqx.filter_jit(eqx.filter_vmap(states))(jr.split(key, num_states))
    states = jtu.tree_map(jnp.asarray, states)
    leaves = jtu.tree_leaves(states)
    sizes = {x.shape[:1] for x in leaves}
    if len(sizes) != 1 or sizes & {(), (0,)} or not all(map(eqx.is_inexact_array, leaves)):
        raise ValueError(
            "`states` must be a sampler `key -> y`, or floating-point arrays with the same leading "
            f"axis over the states, but it is {eqx.tree_pformat(states)}. " + ONE_STATE
        )
    (shape,) = sizes
    t = jnp.asarray(t, jnp.finfo(jnp.result_type(*leaves)).dtype)
    if t.shape not in ((), shape):
        raise ValueError(f"`t` has shape {t.shape}. Give one time, or one per state.")
    return jnp.broadcast_to(t, shape), states


def entries_of(manifold: Manifold) -> list[tuple[str, Entry]]:
    """The entries with their names in a report, such as `energy` for `manifold["energy"]`."""
    flat, _ = jtu.tree_flatten_with_path(manifold, is_leaf=is_entry)
    return [(".".join(str(key_of(x)) for x in path) or "manifold", e) for path, e in flat]


@eqx.filter_jit
@ft.partial(eqx.filter_vmap, in_axes=(None, None, 0, 0, None))
def _measure(
    vector_field: Callable, manifold: Manifold, t: Float[Array, ""], y: Any, args: Args
) -> list[tuple[Float[Array, ""], Float[Array, ""], Bool[Array, ""], Bool[Array, " m"]]]:
    """At one state, for each entry: the largest relative defect of its derivative; its largest
    relative residual, zero for a first integral; whether its gradient is zero; and for each of its
    elements whether all terms of the derivative are zero here but not beside this state."""
    return [_relative_sizes(*entry, t, y, vector_field, args) for entry in named_entries(manifold)]


def _relative_sizes(
    name: str, entry: Entry, t: Float[Array, ""], y: Any, vector_field: Callable, args: Args
) -> tuple[Array, Array, Array, Array]:
    vector = ravel(y)
    dtype = vector.dtype
    t = t.astype(dtype)
    values = ravel(conserved_values(entry, t, y, args, root=name)).astype(dtype)
    problem = problem_of(entry, values, t, y, args)
    with noting_call_of(name, t, y, args):  # JAX refuses to differentiate some loops
        residual, jacobian = problem.linearise(vector)
    in_time = lambda t: ravel(evaluate(entry, t, y, args)).astype(dtype)  # noqa: E731
    _, partial = jax.jvp(in_time, (t,), (jnp.ones_like(t),))
    rate = ravel(rates(entry, t, y, args)).astype(dtype)

    def excess(vector: Array) -> Array:
        """The derivative along the flow, minus the rate."""
        along = LieDerivative(entry.fn, vector_field)(t, unravel(vector, y), args)
        return ravel(along).astype(dtype) - rate

    def terms_at(vector: Array, jacobian: AbstractRows) -> Array:
        """The sum of the sizes of its terms."""
        state = unravel(vector, y)
        slope = ravel(slope_of(vector_field, t, state, args))
        return jacobian.absolute_matvec(jnp.abs(slope)) + jnp.abs(partial) + jnp.abs(rate)

    terms = terms_at(vector, jacobian)
    # If each term of the derivative is zero, its sum tells nothing, as at an equilibrium. Only if
    # the terms are zero beside the state too they are zero everywhere, such as those of an integral
    # which is a parameter among the components. The other state is in a direction without pattern.
    # Components may have different units, so each moves by a share of itself. Only a zero has the
    # size of the others.
    sizes = jnp.abs(vector)
    sizes = _BESIDE * jnp.where(sizes == 0, jnp.max(sizes, initial=0), sizes)
    beside = vector + sizes * irregular_weights(vector.size, dtype)
    idle = (terms == 0) & (terms_at(beside, problem.linearise(beside)[1]) > 0)
    # Forces may cancel inside the field, so that its value is less accurate than its size tells. If
    # that roundoff is much larger than the terms, the defect is relative to it.
    if problem.pattern is None:
        _, _, hidden = cancellation_terms(excess, vector)
        terms = jnp.where(hidden > 4 * terms, hidden, terms)
    # An integral that is not finite counts as not conserved, though its derivative may vanish.
    defect = jnp.where(jnp.isfinite(residual), relative_to_scale(excess(vector), terms), jnp.nan)
    violation = jnp.zeros_like(residual)
    if isinstance(entry, Constraint):
        violation = relative_to_scale(residual, problem.scale(jacobian, vector))
    defect, violation = (jnp.max(jnp.abs(x), initial=0) for x in (defect, violation))
    return (
        defect,
        violation,
        ~jnp.any(jacobian.absolute_matvec(jnp.ones_like(vector))) & jnp.all(partial == 0),
        idle,
    )


def _entry_of_report(name: str, entry: Entry, rtol: float, *found: np.ndarray) -> InvarianceEntry:
    """The line of the report on an entry of the manifold, from what was measured at all states.
    Raises if a state violates a constraint."""
    defects, residuals, constant, idle = found
    # `argmax` finds the first NaN, or without one the largest.
    state, worst = int(np.argmax(defects)), int(np.argmax(residuals))
    if not residuals[worst] <= rtol:
        raise ValueError(
            f"The constraint `{name}` is not zero at state {worst} of `states` (relative residual "
            f"{residuals[worst]:.1e}). Give states on the manifold, such as `dfc.project(manifold, "
            "y)[0]`, or make it a `FirstIntegral` if it is conserved at any value."
        )
    kind = "first integral" if entry.rate is None else "balance"
    kind = "constraint" if isinstance(entry, Constraint) else kind
    defect, is_constant = float(defects[state]), bool(np.all(constant))
    is_tested = not np.any(np.all(idle, axis=0))
    ok = defect <= rtol and is_tested
    return InvarianceEntry(name, kind, defect, state, ok, is_constant, is_tested)
