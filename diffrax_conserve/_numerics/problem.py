"""A manifold at one time, as equations `g(y) = 0` for a state in one real vector.

For a first integral `g = I(t, y, args) - I₀`, for a constraint `g` is its function.

A residual in floating-point arithmetic is rarely exactly zero. So this file also says when it
counts as zero. The roundoff of a residual is proportional to the size of the terms that cancel in
it, its *scale*: `|I₀| + Σ_k |y_k ∂g/∂y_k|`. To first order it is the largest change of the residual
by relative errors `ε` of `I₀` and of each component, divided by `ε`. Terms that cancel inside a
function and leave no trace in its gradient, as in `1 - cos(q)` near zero, are missing in this sum.
The file `roundoff` measures them, and they are added as the *cancellation* of the scale. A
component that has changed by `c_k` in a step of the solver is known to roundoff of `c_k` only,
which matters where it vanishes, as on `q[0] = 0`. So its size counts as `|y_k| + c_k` in a step.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, final

import equinox as eqx
import jax
import jax.core
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from .._constants import MAX_ELIMINATION, NOISE_IN_EPS, TOLERANCE_IN_EPS
from .._custom_types import Args, IntScalarLike, Manifold, RealScalarLike, Values, Y
from .._large.sparse import Pattern, pattern_of
from .._manifold import at_full_precision, entry_names, evaluate, is_entry
from .._tree import eps_of, key_of, ravel, tree_stop_gradient, unflatten, unravel
from .closures import ClosureConverted
from .metric import AbstractFactor, Identity
from .report import ProjectionInfo
from .rows import AbstractRows, DenseRows, HasSizes
from .sparse_rows import SparseRows

# The status of a residual: infinite or NaN; beyond its tolerance; within it; noise. That of a state
# is the least of its residuals.
NOT_FINITE, ABOVE_TOLERANCE, WITHIN_TOLERANCE, AT_ROUNDOFF = -1, 0, 1, 2
# The residuals of one entry of a manifold, as a function of the vector of the state.
Residual = Callable[[Float[Array, " n"]], Float[Array, " k"]]


@final
class Step(eqx.Module):
    r"""The step of a solve in which a projection is called.

    Times are those of the vector field, states are real vectors. At a saved time inside the step
    and in dense output this is the same step, and the candidate is the dense output at `Problem.t`.

    **Attributes:**

    - `t0`, `t1`: the ends of the step; in a solve backwards in time `t1 < t0`.
    - `y0`: the state $y_n$ at `t0`. After the first step it is on the manifold.
    - `error`: the error estimate of the wrapped solver at `t1`, or `None` if the solver has none.
    """

    t0: RealScalarLike
    t1: RealScalarLike
    y0: Float[Array, " n"]
    error: Float[Array, " n"] | None


class Problem(eqx.Module):
    """The equations `g(y) = 0` of a manifold at one time, which a projection solves. States are
    vectors of `n` real numbers; see `state`.

    **Attributes:**

    - `t`, `args`: the time and the parameters.
    - `values`: the conserved values, shaped like the manifold.
    - `like`: the shapes and dtypes of the state, `jax.ShapeDtypeStruct`s.
    - `names`, `keys`: for each entry of the manifold its name, `manifold['energy']`, and its first
        key, such as a key of a dictionary.
    - `step`: the [`diffrax_conserve.Step`][] of the solve; `None` outside a solve, as in
        [`diffrax_conserve.project`][], and for a projection whose `sees_step` is false.
    - `functions`, `sizes`: for each entry its residuals, as a function of the vector, and their
        number.
    - `magnitude`: the part of the scale that does not depend on the state: the size of the
        conserved value, and `cancellation`.
    - `cancellation`: the part of the scale that the gradients do not show.
    - `factor`: the metric, as a factor $S$ of $M^{-1} = S S^\\top$.
    - `changes`: how far each component moves in the step of a solve; `None` outside a solve.
    - `rtol`, `atol`: a residual within `rtol * scale + atol` counts as zero.
    - `clip`: used within bounds only. Then the argument of all methods is not the state but a
        vector without bounds, which `clip` maps to the state.
    - `pattern`: the places of the elements of a sparse Jacobian; `None` if it is dense.
    """

    t: RealScalarLike
    args: Args
    values: Values
    like: Any
    names: tuple[str, ...] = eqx.field(static=True)
    keys: tuple[Any, ...] = eqx.field(static=True)
    functions: tuple[Residual, ...]
    sizes: tuple[int, ...] = eqx.field(static=True)
    magnitude: Float[Array, " m"]
    cancellation: Float[Array, " m"]
    pattern: Pattern | None = eqx.field(static=True)
    factor: AbstractFactor = Identity()
    changes: Float[Array, " n"] | None = None
    rtol: float | Array | None = None
    atol: float | Array | None = None
    clip: Callable[[Float[Array, " n"]], Float[Array, " n"]] | None = None
    step: Step | None = None

    @property
    def num_residuals(self) -> int:
        return sum(self.sizes)

    def state(self, y: Float[Array, " n"]) -> Y:
        """The state of the solve whose numbers are `y`."""
        return unravel(y, self.like)

    def residual(self, y: Float[Array, " n"]) -> Float[Array, " m"]:
        """The `m` residuals at a state, in the order in which the manifold is flattened."""
        return jnp.concatenate([part(y) for part in self.functions])

    @eqx.filter_jit  # traced once for all uses
    def linearise(self, y: Float[Array, " n"]) -> tuple[Float[Array, " m"], AbstractRows]:
        """`g(y)` and the constraint Jacobian `G(y)`.

        Each entry of the manifold is differentiated by itself. In one reverse pass over all of them
        the row of one would contain zeros times the gradients of the others, which are NaN where
        those gradients are infinite.
        """
        if self.pattern is not None and not self.factor.is_dense:
            return SparseRows.linearised(self.pattern, self.functions, y)
        residuals, rows = zip(*(linearised(part, y) for part in self.functions), strict=True)
        return jnp.concatenate(residuals), DenseRows(jnp.concatenate(rows))

    def gradients(self, y: Float[Array, " n"]) -> AbstractRows:
        """`G(y) S`, the gradients in the coordinates in which the metric is Euclidean."""
        return self.factor.scaled_rows(self.linearise(y)[1])

    def with_dense_jacobian(self) -> "Problem":
        """The same problem, with the Jacobian computed as a dense matrix."""
        return dataclasses.replace(self, pattern=None)

    def scale(self, jacobian: HasSizes, y: Float[Array, " n"]) -> Float[Array, " m"]:
        size = jnp.abs(y if self.clip is None else self.clip(y))
        size = size if self.changes is None else size + self.changes
        return self.magnitude + jacobian.absolute_matvec(size)

    def tolerance(self, scale: Float[Array, " m"]) -> Float[Array, " m"]:
        eps = eps_of(scale)
        rtol = TOLERANCE_IN_EPS * eps if self.rtol is None else self.rtol
        limit = jnp.asarray(rtol, scale.dtype) * scale
        return limit if self.atol is None else limit + jnp.asarray(self.atol, scale.dtype)

    def status(
        self, g: Float[Array, " m"], scale: Float[Array, " m"]
    ) -> tuple[Int[Array, ""], Float[Array, " m"]]:
        """The status of a state with these residuals and scales, and the residuals that are to be
        corrected, with zeros for those that are noise."""
        limit = self.tolerance(scale)
        noise = jnp.abs(g) <= NOISE_IN_EPS / TOLERANCE_IN_EPS * limit
        # Where the tolerance underflows, the residual may have underflowed too, and an infinite one
        # would accept any state, so neither counts as met. With a scale of exactly zero only a
        # residual of exactly zero is accepted, unless `atol` is given.
        valid = (limit >= float(jnp.finfo(scale.dtype).tiny)) | (scale == 0)
        met_tolerance = valid & (limit < jnp.inf) & (jnp.abs(g) <= limit)
        # The status is a minimum of integers. A maximum of the residuals would be
        # shorter, but on a CPU a maximum can lose a NaN.
        within = jnp.where(noise, jnp.int8(AT_ROUNDOFF), jnp.int8(WITHIN_TOLERANCE))
        beyond = jnp.where(jnp.abs(g) < jnp.inf, jnp.int8(ABOVE_TOLERANCE), jnp.int8(NOT_FINITE))
        return jnp.min(jnp.where(met_tolerance, within, beyond)), jnp.where(noise, 0, g)

    def is_on_manifold(self, y: Float[Array, " n"]) -> Bool[Array, ""]:
        """Whether `y` is on the manifold."""
        return self.holds(y, *self.linearise(y))

    def holds(
        self, y: Float[Array, " n"], g: Float[Array, " m"], jacobian: AbstractRows
    ) -> Bool[Array, ""]:
        """Whether a state with these values and this Jacobian is on the manifold."""
        return self.status(g, self.scale(jacobian, y))[0] >= WITHIN_TOLERANCE

    def per_residual(self, of_entries: Sequence[Any]) -> np.ndarray:
        """One element for each residual, from one for each entry of the manifold."""
        return np.repeat(np.asarray(of_entries), self.sizes)

    def report(
        self,
        candidate: Float[Array, " n"],
        y: Float[Array, " n"],
        num_iterations: IntScalarLike = 1,
        *,
        ok: Bool[Array, ""] | None = None,
        converged: Bool[Array, ""] | bool = False,
        linearised: tuple[Float[Array, " m"], AbstractRows] | None = None,
    ) -> ProjectionInfo:
        """The report on a projection from `candidate` to `y`, as `solve` must return it.

        **Arguments:**

        - `num_iterations`: the number of iterations.
        - `ok`: whether the projection succeeded. By default: whether every residual is within
            its tolerance at `y`, or `converged`.
        - `converged`: whether the iteration tells that it succeeded.
        - `linearised`: the values and the Jacobian at `y`, if they are known.
        """
        # A report has no derivative.
        problem, candidate, y = tree_stop_gradient((self, candidate, y))
        after, jacobian = problem.linearise(y) if linearised is None else linearised
        scale = problem.scale(jacobian, y)
        sizes = [jnp.abs(relative_to_scale(g, scale)) for g in (problem.residual(candidate), after)]
        # On a CPU a maximum can lose a NaN, so NaN counts as infinite.
        sizes = [jnp.where(jnp.isnan(x), jnp.inf, x) for x in sizes]
        success = ok
        if success is None:
            success = converged | (problem.status(after, scale)[0] >= WITHIN_TOLERANCE)
        before, after = (jnp.max(x) for x in sizes)
        results = optx.RESULTS
        missed, diverged = results.nonlinear_max_steps_reached, results.nonlinear_divergence
        failed = results.where(jnp.isfinite(after), missed, diverged)
        failed = results.where(jnp.isfinite(before), failed, results.nonfinite)
        entry = jnp.asarray(self.per_residual(range(len(self.functions))))
        return ProjectionInfo(
            ok=success,
            result=results.where(success, results.successful, failed),
            num_iterations=jnp.asarray(num_iterations),
            residual_before=before,
            residual_after=after,
            correction=problem.factor.norm(y - candidate),
            roundoff=jnp.max(relative_to_scale(problem.cancellation, scale)),
            # An iteration that diverged makes every residual large. So the entry is named whose
            # residual is large both before and after, by the minimum of both.
            worst=entry[jnp.argmax(jnp.minimum(*sizes))],
            names=self.names,
        )


def linearised(fn: Residual, y: Float[Array, " n"]) -> tuple[Array, Float[Array, "m n"]]:
    """The values of a function and its Jacobian. With many values and not many more unknowns, as of
    a mechanism in space, it is found in forward mode: there reverse mode compiled up to twice as
    long, and took as long."""
    size = jax.eval_shape(fn, y).size
    if size > MAX_ELIMINATION and 2 * size > y.size:
        along = jax.vmap(lambda v: jax.jvp(fn, (y,), (v,)), out_axes=(None, 1))
        try:
            return along(np.eye(y.size, dtype=y.dtype))
        except TypeError:  # by a function that has a rule for reverse mode alone
            pass
    value, vjp = jax.vjp(fn, y)
    if size == 1:
        return value, vjp(jnp.ones_like(value))[0][None]
    return value, jax.vmap(vjp)(np.eye(size, dtype=value.dtype))[0]


def step_norm(
    changes: Float[Array, " n"], end: Float[Array, " n"], factor: AbstractFactor
) -> Float[Array, ""]:
    """The length in the metric of a step to `end` in which the components change by `changes`. The
    length of a correction is compared with it.

    Each component counts as moved by at least `√ε` of itself. Where gradients are nearly parallel,
    the roundoff of the residuals alone moves a state by about that much. Without this floor a step
    at rest would have no length, and every correction would be longer than it.

    A length has no derivative: that of a norm whose squares underflow is NaN.
    """
    changes, end, factor = tree_stop_gradient((changes, end, factor))
    floor = eps_of(end) ** 0.5 * jnp.abs(end)
    return factor.norm(jnp.maximum(changes, floor))


def relative_to_scale(residual: Any, scale: Any) -> Any:
    """Residuals divided by their scales. A scale of zero counts as one, so that a residual that is
    exactly zero stays zero instead of becoming NaN."""
    return jtu.tree_map(lambda g, s: g / jnp.where(s > 0, s, jnp.ones_like(s)), residual, scale)


def residuals_and_scales(
    manifold: Manifold, values: Values, t: RealScalarLike, y: Y, args: Args
) -> tuple[Values, Values]:
    """The residuals at `y` and their scales there, both shaped like the values of the manifold."""
    vector = ravel(y)
    problem = problem_of(manifold, ravel(values).astype(vector.dtype), t, y, args)
    g, jacobian = problem.linearise(vector)
    like = jax.eval_shape(lambda: evaluate(manifold, t, y, args))
    return unflatten(g, like), unflatten(problem.scale(jacobian, vector), like)


def functions_of(manifold: Manifold, t: RealScalarLike, like: Any, args: Args) -> list[Residual]:
    """The function of each entry, from the numbers of a state to a vector."""

    def flat(entry: Any) -> Residual:
        fn = lambda y: at_full_precision(entry.fn, t, unravel(y, like), args)  # noqa: E731
        return lambda y: ravel(fn(y)).astype(y.dtype)

    return [flat(entry) for entry in jtu.tree_leaves(manifold, is_leaf=is_entry)]


def problem_of(
    manifold: Manifold,
    values: Float[Array, " m"],
    t: RealScalarLike,
    like: Any,
    args: Args,
    cancellation: Float[Array, " m"] | None = None,
    **more: Any,
) -> Problem:
    """The problem of a manifold with these conserved values, for states like `like`, with `more` of
    its fields."""
    cancellation = jnp.zeros_like(values) if cancellation is None else cancellation
    like = jax.eval_shape(lambda: like)
    vector = jax.eval_shape(ravel, like)
    functions = functions_of(manifold, t, like, args)
    sizes = [jax.eval_shape(fn, vector).size for fn in functions]

    def converted(fn: Residual, value: Array) -> Residual:
        """The residuals of an entry."""
        return ClosureConverted(lambda y: fn(y) - value, vector)

    flat, _ = jtu.tree_flatten_with_path(manifold, is_leaf=is_entry)
    shapes = jax.eval_shape(lambda y: evaluate(manifold, t, y, args), like)
    return Problem(
        t=t,
        args=args,
        values=unflatten(values, shapes),
        like=like,
        names=entry_names(manifold),
        keys=tuple(key_of(path[0]) if path else None for path, _ in flat),
        functions=tuple(map(converted, functions, jnp.split(values, np.cumsum(sizes[:-1])))),
        sizes=tuple(sizes),
        magnitude=lax.stop_gradient(jnp.abs(values) + cancellation),
        cancellation=cancellation,
        pattern=pattern_of(functions, sizes, vector),
        **more,
    )
