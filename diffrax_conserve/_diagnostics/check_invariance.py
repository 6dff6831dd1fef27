"""A check by autodiff that a manifold is conserved by a vector field."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray, PyTree, Real

from .._balance import rates
from .._custom_types import Args, Manifold, RealScalarLike, Values, Y
from .._manifold import AbstractConserved, Constraint, check_manifold, conserved_values
from .._projection.linearise import linearise
from .._projection.residual import largest, measure, relative, residual_of
from .._tree import real_view, tree_all_finite, tree_max, unflatten, working_dtype


@dataclasses.dataclass(frozen=True)
class InvarianceEntry:
    """The result of `check_invariance` for one entry of the manifold.

    `defect` is the largest relative defect over all states and elements, and `state` the index of
    the state where it was found.
    """

    name: str
    kind: str
    defect: float
    state: int
    ok: bool


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

    - `vector_field`: $f$, called as `vector_field(t, y, args)`.
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
    ys = _batch(states, jr.key(0) if key is None else key, num_states)
    ts = _times(t, ys)
    if rtol is None:
        rtol = 1e4 * float(jnp.finfo(ts.dtype).eps)
    _check_like_y(vector_field, ts[0], jtu.tree_map(lambda x: x[0], ys), args)
    found = _measure(vector_field, manifold, ts, ys, args)
    entries = [
        _verdict(name, entry, np.asarray(defects), np.asarray(residuals), rtol)
        for (name, entry), (defects, residuals) in zip(_entries(manifold), found, strict=True)
    ]
    return InvarianceReport(tuple(entries), ts.size, rtol)


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
) -> list[tuple[Float[Array, " states"], Float[Array, " states"]]]:
    """The relative defects and residuals of each entry at each state, largest over elements."""

    def at_one_state(t: Float[Array, ""], y: Any) -> list[tuple[Array, Array]]:
        f = vector_field(t, y, args)
        return [_relative_sizes(entry, t, y, f, args) for _, entry in _entries(manifold)]

    return jax.vmap(at_one_state)(ts, ys)


def _change_along(
    manifold: Manifold, values: Values, t: RealScalarLike, y: Y, args: Args, slope: Y
) -> Values:
    """The derivative of each residual by time along `slope`, less its rate, relative to the sum of
    the moduli of its terms. What may be roundoff of a slope in which larger terms cancel is
    relative to those of the largest component of the slope."""
    t, view, slope = jnp.asarray(t, working_dtype(y)), real_view(y), real_view(slope)
    fn, _ = residual_of(manifold, values, t, y, args)
    _, jacobian = linearise(fn, view)

    def at_time(t: Array) -> tuple[Array, Values]:
        fn, _ = residual_of(manifold, values, t, y, args)
        return fn(view), rates(manifold, t, y, args)

    (_, rate), (in_time, _) = jax.jvp(at_time, (t,), (jnp.ones_like(t),))
    rate = jnp.concatenate([jnp.ravel(x) for x in jtu.tree_leaves(rate)])
    change = jacobian.pushforward(slope) + in_time - rate
    terms = jacobian.scale(slope) + jnp.abs(in_time) + jnp.abs(rate)
    fastest = jtu.tree_map(lambda x: jnp.full_like(x, tree_max(slope)), slope)
    most = jacobian.scale(fastest)
    roundoff = 100 * jnp.finfo(change.dtype).eps * most
    terms = jnp.where(jnp.abs(change) <= roundoff, jnp.maximum(terms, most), terms)
    return unflatten(relative(change, terms), values)


def _relative_sizes(
    entry: AbstractConserved, t: Float[Array, ""], y: Any, f: Any, args: Args
) -> tuple[Array, Array]:
    f = jtu.tree_map(lambda a, b: jnp.asarray(a, b.dtype), f, y)
    values = conserved_values(entry, t, y, args)
    defect = largest(_change_along(entry, values, t, y, args, f))
    residual, scale = measure(entry, values, t, y, args)
    # An integral that is not finite at `y` counts as not conserved, although its derivative may
    # vanish.
    defect = jnp.where(tree_all_finite(residual), defect, jnp.nan)
    violation = largest(relative(residual, scale))
    return defect, violation if isinstance(entry, Constraint) else jnp.zeros_like(violation)


def _verdict(
    name: str, entry: AbstractConserved, defects: np.ndarray, residuals: np.ndarray, rtol: float
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
        kind="constraint" if isinstance(entry, Constraint) else "first integral",
        defect=float(defects[worst]),
        state=worst,
        ok=bool(defects[worst] <= rtol),
    )


def _worst(ratios: np.ndarray) -> int:
    return int(np.argmax(np.where(np.isnan(ratios), np.inf, ratios)))
