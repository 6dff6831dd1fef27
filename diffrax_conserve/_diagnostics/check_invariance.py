"""A check by autodiff that a manifold is conserved by a vector field."""

import dataclasses
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
from .._manifold import AbstractConserved, Constraint, check_manifold, conserved_values, rate_of
from .._projection.equations import Equations, equations_of, measure, relative
from .._projection.roundoff import hidden_terms
from .._tree import ravel, tree_all_finite, tree_max, unravel


@dataclasses.dataclass(frozen=True)
class InvarianceEntry:
    """The result of `check_invariance` for one entry of the manifold.

    `kind` is "first integral", "balance" (with a `rate`) or "constraint". `defect` is the largest
    relative defect over all states and elements, and `state` the index of the state where it was
    found. `is_constant` tells that the gradient is zero at every state: a function that does not
    depend on the state, or that autodiff does not see through, is conserved by any field.
    """

    name: str
    kind: str
    defect: float
    state: int
    ok: bool
    is_constant: bool


@dataclasses.dataclass(frozen=True)
class InvarianceReport:
    """The verdict of `check_invariance`; print it to read it as a table.

    `ok` is true if every entry is conserved, to within the relative tolerance `rtol`, at every one
    of the `num_states` states.
    """

    entries: tuple[InvarianceEntry, ...]
    num_states: int
    rtol: float

    @property
    def ok(self) -> bool:
        return all(entry.ok for entry in self.entries)

    def __str__(self) -> str:
        width = max(len(entry.name) for entry in self.entries)
        verdict = "conserved" if self.ok else "NOT CONSERVED"
        lines = [
            f"{verdict}: derivatives along the flow at {self.num_states} states, "
            f"relative tolerance {self.rtol:.1e}",
            f"  {'':{width}}  {'':14}  largest relative defect",
        ]
        for entry in self.entries:
            result = "conserved" if entry.ok else f"NOT conserved, see state {entry.state}"
            if entry.is_constant:
                result += "; its gradient is zero at every state: nothing is kept"
            lines.append(f"  {entry.name:{width}}  {entry.kind:14}  {entry.defect:<8.1e}  {result}")
        return "\n".join(lines)


def check_invariance(
    vector_field: Callable[[RealScalarLike, Any, Args], Any],
    manifold: Manifold,
    states: Any,
    *,
    t: Real[ArrayLike, "*states"] = 0.0,
    args: Args = None,
    key: PRNGKeyArray | None = None,
    num_states: int = 100,
    rtol: float | None = None,
) -> InvarianceReport:
    r"""Checks, by automatic differentiation, that a vector field conserves a manifold.

    At each state the derivative along the flow, relative to the size of its own terms, is

    $$\frac{|\partial_t I + \sum_i \partial_i I\, f_i|}{|\partial_t I| + \sum_i |\partial_i I\,
    f_i|},$$

    which is a few units of roundoff if $I$ is a first integral, and of order one at almost every
    state if it is not. This tests the equations without a solver; it reveals a misprint in either
    $I$ or $f$. For a [`diffrax_conserve.Constraint`][] the same derivative must vanish where the
    constraints hold, so the states must satisfy all constraints of the manifold. A
    [`diffrax_conserve.FirstIntegral`][] next to constraints is thus tested only where they hold, as
    it should be. A `rate` is subtracted from the derivative, and its size is added to the
    denominator.

    **Arguments:**

    - `vector_field`: $f$, called as `vector_field(t, y, args)`, or a `diffrax.ODETerm` of it.
    - `manifold`: a [`diffrax_conserve.FirstIntegral`][], a [`diffrax_conserve.Constraint`][] or a
        PyTree of them.
    - `states`: a sampler `key -> y` such as `system.sample`, or a PyTree of arrays like `y` with an
        additional leading axis over the states. Take states in general position: at an equilibrium
        every function is conserved.
    - `t`: the time, or one for each state. Give several for integrals that depend on time.
    - `args`: passed to `vector_field` and to the functions of the manifold.
    - `key`: seeds the sampler; by default `jax.random.key(0)`.
    - `num_states`: how many states to draw from the sampler.
    - `rtol`: the largest relative defect that is attributed to roundoff; by default ten thousand
        times the machine epsilon of the states.

    **Returns:**

    An `InvarianceReport`: `ok` is the verdict, `str` returns a table, and `entries` has the largest
    relative defect of each entry of the manifold.

    **Raises:**

    `ValueError` if a state violates a constraint, or if the value of `vector_field` is not shaped
    like `y`; `TypeError` or `ValueError` if `manifold` is not valid.

    !!! example

        ```python
        import diffrax_conserve as dfc

        system = dfc.systems.RigidBody()
        report = dfc.check_invariance(system.vector_field, system.manifold, system.sample)
        print(report)
        assert report.ok
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
    ys = _batch(states, jr.key(0) if key is None else key, num_states)
    ts = _times(t, ys)
    if rtol is None:
        rtol = 1e4 * float(jnp.finfo(ts.dtype).eps)
    _check_like_y(vector_field, ts[0], jtu.tree_map(lambda x: x[0], ys), args)
    found = _measure(vector_field, manifold, ts, ys, args)
    entries = [
        _verdict(
            name, entry, np.asarray(defects), np.asarray(residuals), np.asarray(constant), rtol
        )
        for (name, entry), (defects, residuals, constant) in zip(
            _entries(manifold), found, strict=True
        )
    ]
    return InvarianceReport(tuple(entries), ts.size, rtol)


_KINDS = ("first integral", "balance")
_ONE_STATE = "For one state `y` write `jax.tree.map(lambda x: x[None], y)`."


def _batch(states: Any, key: PRNGKeyArray, num_states: int) -> PyTree[Array]:
    if callable(states):
        states = eqx.filter_jit(eqx.filter_vmap(states))(jr.split(key, num_states))
    states = jtu.tree_map(jnp.asarray, states)
    leaves = jtu.tree_leaves(states)
    sizes = {x.shape[0] if x.ndim else None for x in leaves}
    if len(sizes) != 1 or sizes & {None, 0} or not all(map(eqx.is_inexact_array, leaves)):
        raise ValueError(
            "`states` must be a sampler `key -> y`, or a PyTree of floating point arrays with the "
            f"same leading axis over the states, but it is {eqx.tree_pformat(states)}. "
            + _ONE_STATE
        )
    return states


def _times(t: Real[ArrayLike, "*states"], ys: PyTree[Array]) -> Float[Array, " states"]:
    leaves = jtu.tree_leaves(ys)
    t = jnp.asarray(t, jnp.finfo(jnp.result_type(*leaves)).dtype)
    shape = (leaves[0].shape[0],)
    if t.shape not in ((), shape):
        raise ValueError(
            f"`t` must be one time or one for each of the {shape[0]} states, but it has shape "
            f"{t.shape}."
        )
    return jnp.broadcast_to(t, shape)


def _check_like_y(vector_field: Callable, t: RealScalarLike, y: Any, args: Args) -> None:
    try:
        out = eqx.filter_eval_shape(vector_field, t, y, args)
    except (IndexError, TypeError, ValueError) as error:
        if any(jnp.ndim(x) for x in jtu.tree_leaves(y)):
            raise
        raise ValueError(
            "`vector_field` cannot be called with one of the `states`, which is "
            f"{eqx.tree_pformat(y)}. " + _ONE_STATE
        ) from error
    same_structure = jtu.tree_structure(out) == jtu.tree_structure(y)
    if not same_structure or not all(
        getattr(a, "shape", ()) == b.shape
        for a, b in zip(jtu.tree_leaves(out), jtu.tree_leaves(y), strict=True)
    ):
        raise ValueError(
            f"`vector_field(t, y, args)` must return a PyTree like `y`, {eqx.tree_pformat(y)}, but "
            f"it returns {eqx.tree_pformat(out)}."
        )


def _entries(manifold: Manifold) -> list[tuple[str, AbstractConserved]]:
    flat, _ = jtu.tree_flatten_with_path(
        manifold, is_leaf=lambda x: isinstance(x, AbstractConserved)
    )
    return [(jtu.keystr(path, simple=True, separator=".") or "manifold", e) for path, e in flat]


@eqx.filter_jit
def _measure(
    vector_field: Callable, manifold: Manifold, ts: Float[Array, " states"], ys: Any, args: Args
) -> list[tuple[Float[Array, " states"], Float[Array, " states"], Bool[Array, " states"]]]:
    """The relative defects and residuals of each entry at each state, largest over elements, and
    whether its gradient is zero there."""

    def at_one_state(t: Float[Array, ""], y: Any) -> list[tuple[Array, Array, Array]]:
        return [_relative_sizes(entry, t, y, vector_field, args) for _, entry in _entries(manifold)]

    return jax.vmap(at_one_state)(ts, ys)


def _relative_sizes(
    entry: AbstractConserved, t: Float[Array, ""], y: Any, vector_field: Callable, args: Args
) -> tuple[Array, Array, Array]:
    """The largest relative defect and residual of an entry, and whether its gradient is zero."""
    values = conserved_values(entry, t, y, args)
    vector = ravel(y)
    numbers = ravel(values).astype(vector.dtype)

    def equations(t: Array) -> Equations:
        return equations_of(entry, numbers, t, y, args)

    t = jnp.asarray(t, vector.dtype)
    now, in_time = jax.jvp(lambda t: equations(t).residual(vector), (t,), (jnp.ones_like(t),))
    rate = ravel(rates(entry, t, y, args)).astype(vector.dtype)
    _, jacobian = equations(t).linearise(vector)

    def along(vector: Array) -> Array:
        slope = vector_field(t, unravel(vector, y), args)
        slope = jtu.tree_map(lambda a, b: jnp.asarray(a, b.dtype), slope, y)
        return jax.jvp(equations(t).residual, (vector,), (ravel(slope),))[1]

    f = jtu.tree_map(lambda a, b: jnp.asarray(a, b.dtype), vector_field(t, y, args), y)
    terms = jnp.sum(jnp.abs(jacobian * ravel(f)), axis=1) + jnp.abs(in_time) + jnp.abs(rate)
    # Forces may cancel inside the field.
    hidden = hidden_terms(along, vector)
    terms = jnp.where(hidden > 4 * terms, hidden, terms)
    change = along(vector) + in_time - rate
    defect = tree_max(relative(change, terms))
    # An integral that is not finite at `y` counts as not conserved, although its derivative may
    # vanish.
    defect = jnp.where(tree_all_finite(now), defect, jnp.nan)
    violation = tree_max(relative(*measure(entry, values, t, y, args)))
    violation = violation if isinstance(entry, Constraint) else jnp.zeros_like(violation)
    return defect, violation, jnp.all(jacobian == 0) & jnp.all(in_time == 0)


def _verdict(
    name: str,
    entry: AbstractConserved,
    defects: np.ndarray,
    residuals: np.ndarray,
    constant: np.ndarray,
    rtol: float,
) -> InvarianceEntry:
    if not np.all(residuals <= rtol):
        worst = _worst(residuals)
        raise ValueError(
            f"The constraint `{name}` is not zero at state {worst} of `states` (relative residual "
            f"{residuals[worst]:.1e}), so its derivative along the flow need not vanish there. "
            "Give states on the manifold, for example `dfc.project(manifold, y)[0]`, or make it a "
            "`FirstIntegral` if it is conserved at any value."
        )
    worst = _worst(defects)
    return InvarianceEntry(
        name=name,
        kind="constraint" if isinstance(entry, Constraint) else _KINDS[rate_of(entry) is not None],
        defect=float(defects[worst]),
        state=worst,
        ok=bool(defects[worst] <= rtol),
        is_constant=bool(np.all(constant)),
    )


def _worst(ratios: np.ndarray) -> int:
    return int(np.argmax(np.where(np.isnan(ratios), np.inf, ratios)))
