"""The interface of projections: the problem, the report, and the target of a solver."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, final

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree, Real

from .._balance import integrated_rates
from .._constants import NOISE, ROUNDOFF
from .._custom_types import Args, IntScalarLike, Manifold, RealScalarLike, Values, Y
from .._hashable import Hashable
from .._manifold import evaluate, is_entry, named_entries
from .._printing import is_traced, names_at, printed
from .._step.equations import ON, Equations, equations_of, relative
from .._step.metric import AbstractFactor, Identity, Preferring, factor_of
from .._tree import key_of, ravel, tree_all_finite, tree_stop_gradient, unflatten, unravel


@final
class Step(eqx.Module):
    r"""The step of a solve in which a projection is called.

    Times are those of the vector field, states are real vectors. At a saved time inside the step
    and in dense output this is the same step, and the candidate is the dense output at `Problem.t`.

    **Attributes:**

    - `t0`, `t1`: the ends of the step; in a solve backwards in time `t1 < t0`.
    - `y0`: the state $y_n$ at `t0`, on the manifold unless only every few steps are projected.
    - `error`: the error estimate of the wrapped solver at `t1`, or `None` if the solver has none.
    """

    t0: RealScalarLike
    t1: RealScalarLike
    y0: Float[Array, " n"]
    error: Float[Array, " n"] | None


# What `print` says of a projection that has not reached the manifold.
_MISSED = """the manifold was not reached. What is asked for may contradict itself: entries that
exclude each other, bounds, or a `value` that no state has. If `residual_after` is small, redundant
entries agree only to that: leave one out, or pass a larger `rtol` to the projection. From a state
where a gradient is zero no direction leads to the manifold: start beside it."""


class ProjectionInfo(eqx.Module):
    """The report on a projection.

    **Attributes:**

    - `ok`: whether the projection succeeded: every residual is within its tolerance at the state
        that is returned, and what else the projection asks of it holds.
    - `result`: an `optimistix.RESULTS`, successful if and only if `ok`; `nonfinite` if the
        candidate has no finite residual, divergence if only the result has none.
    - `num_steps`: the number of iterations.
    - `residual_before`, `residual_after`: the largest residual of the candidate and of the
        projected state, relative to the scale of its constraint at the latter,
        $|I_0| + \\sum_k |y_k \\partial g/\\partial y_k|$ plus the terms that cancel inside `fn`.
    - `correction`: the length of the projected state minus the candidate in the metric of the
        projection.
    - `roundoff`: the largest share of a scale that the gradient does not show: near one where `fn`
        is less accurate than its gradient tells, as `1 - cos(q)` near zero.
    - `worst`: the position in `names` of the entry whose relative residual is large both before and
        after, which tells the cause of a failure. `print` shows the name.
    - `names`: the names of the entries of the manifold, such as `manifold['energy']`.
    """

    ok: Bool[Array, ""]
    result: optx.RESULTS
    num_steps: Int[Array, ""]
    residual_before: Float[Array, ""]
    residual_after: Float[Array, ""]
    correction: Float[Array, ""]
    roundoff: Float[Array, ""]
    worst: Int[Array, ""]
    names: tuple[str, ...] = eqx.field(static=True)

    def __str__(self) -> str:
        if is_traced(self):
            return repr(self)
        ok = np.asarray(self.ok)
        if ok.ndim > 0:
            title = f"{ok.sum()} of {ok.size} projections succeeded"
        else:
            missed = self.result == optx.RESULTS.nonlinear_max_steps_reached
            reason = _MISSED if missed else optx.RESULTS[self.result]
            title = "projected" if ok else f"NOT PROJECTED: {reason}"
        numbers = ("num_steps", "residual_before", "residual_after", "correction", "roundoff")
        rows = {name: getattr(self, name) for name in numbers}
        worst = {} if ok.all() else {"worst": names_at(self.worst, self.names)}
        return printed(title, rows | worst)


class Problem(eqx.Module):
    """The problem that a projection solves. States are vectors of `n` real numbers; see `state`.

    **Attributes:**

    - `equations`: the residuals `g` and their scales.
    - `t`, `args`: the time and the parameters.
    - `values`: the conserved values, shaped like the manifold.
    - `like`: the shapes and dtypes of the state, `jax.ShapeDtypeStruct`s.
    - `names`, `keys`: for each entry of the manifold its name, `manifold['energy']`, and its first
        key, such as a key of a dictionary.
    - `step`: the [`diffrax_conserve.Step`][] of the solve; `None` outside a solve, as in
        [`diffrax_conserve.project`][], and for a projection whose `sees_step` is false.
    """

    equations: Equations
    t: RealScalarLike
    args: Args
    values: Values
    like: Any
    names: tuple[str, ...] = eqx.field(static=True)
    keys: tuple[Any, ...] = eqx.field(static=True)
    step: Step | None = None

    def residual(self, y: Float[Array, " n"]) -> Float[Array, " m"]:
        """The `m` residuals at a state, in the order in which the manifold is flattened."""
        return self.equations.residual(y)

    def state(self, y: Float[Array, " n"]) -> Y:
        """The state of the solve whose numbers are `y`."""
        return unravel(y, self.like)

    def report(
        self,
        candidate: Float[Array, " n"],
        y: Float[Array, " n"],
        num_steps: IntScalarLike = 1,
        *,
        ok: Bool[Array, ""] | None = None,
    ) -> ProjectionInfo:
        """The report on a projection from `candidate` to `y`, as `solve` must return it.

        **Arguments:**

        - `num_steps`: the number of iterations.
        - `ok`: whether the projection succeeded, if that is known. By default: whether every
            residual is within its tolerance at `y`.
        """
        # A report has no derivative.
        equations, candidate, y = tree_stop_gradient((self.equations, candidate, y))
        after, jacobian = equations.linearise(y)
        scale = equations.scale(jacobian, y)
        sizes = [jnp.abs(relative(g, scale)) for g in (equations.residual(candidate), after)]
        # On a CPU a maximum can lose a NaN, so NaN counts as infinite.
        sizes = [jnp.where(jnp.isnan(x), jnp.inf, x) for x in sizes]
        success = equations.level(after, scale)[0] >= ON if ok is None else ok
        before, after = (jnp.max(x) for x in sizes)
        kinds = optx.RESULTS
        missed, diverged = kinds.nonlinear_max_steps_reached, kinds.nonlinear_divergence
        failed = kinds.where(jnp.isfinite(after), missed, diverged)
        failed = kinds.where(jnp.isfinite(before), failed, kinds.nonfinite)
        parts = [eqx.filter_eval_shape(part, y).size for part in equations.parts]
        entry = jnp.asarray(np.repeat(np.arange(len(parts)), parts))
        return ProjectionInfo(
            ok=success,
            result=kinds.where(success, kinds.successful, failed),
            num_steps=jnp.asarray(num_steps),
            residual_before=before,
            residual_after=after,
            correction=equations.factor.length(y - candidate),
            roundoff=jnp.max(relative(equations.hidden, scale)),
            # An iteration that diverged makes every residual large. So we look for the entry whose
            # residual is large both before and after: of both the smaller one counts.
            worst=entry[jnp.argmax(jnp.minimum(*sizes))],
            names=self.names,
        )


class AbstractProjection(Hashable):
    """A map from a candidate to a state on the manifold.

    Write your own as a subclass with a field `metric` and the method `solve`; see [Your own
    projection][your-own-projection]. The tolerances of the residuals are its fields `rtol` and
    `atol`, if it has them.
    Set `sees_step = False` in the class if it does not use `Problem.step`: then it needs no step,
    as in a stage of [`diffrax_conserve.Staged`][].
    """

    metric: eqx.AbstractVar[PyTree[Any] | None]
    # Whether `Problem.step` is set. If it is, dense output stores the error estimate too, which
    # costs memory.
    sees_step: ClassVar[bool] = True

    @abc.abstractmethod
    def solve(
        self, problem: Problem, candidate: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], ProjectionInfo]:
        """The state on the manifold that belongs to `candidate`, and the report on it.

        Never raises at run time; `info.ok` is true only if every residual is small.
        """


def adapted(
    equations: Equations, projection: AbstractProjection, t: RealScalarLike, y: Y, args: Args
) -> Equations:
    """The equations with the tolerances of a projection, and with its metric at a state, if it has
    one; otherwise they keep theirs."""
    changed = {name: getattr(projection, name, None) for name in ("rtol", "atol")}
    if projection.metric is not None:
        changed["factor"] = factor_of(projection.metric, t, y, args)
    return dataclasses.replace(equations, **changed)


def check_projection(projection: Any) -> None:
    if not isinstance(projection, AbstractProjection):
        name = getattr(projection, "__name__", "SimplifiedNewton")
        raise TypeError(
            f"`projection` is {projection!r}, which is not a projection. Pass `{name}()`."
        )


class Target(eqx.Module):
    """Everything that a projection needs except the time and the candidate. Within a step only
    `gained` changes, by `advanced`, so that dense output can project by the target too.

    - `values`: the conserved values at the start of the solve.
    - `hidden`: the part of the scales that the gradients do not show.
    - `moved`: how far each component moves in the step; `None` outside a solve.
    - `factor`: that of the metric where the projection has none of its own: of the motion, or of
      the numbers of the state, with noise and outside a solve.
    - `direction`: -1 if the solver's time is the negative of the manifold's, as in a solve
      backwards in time, otherwise 1.
    - `gained`: in the first row the integrals of the rates since the start of the solve, in the
      second what rounding has added to them; `None` if no entry has a rate.
    - `preferred`: changes of the state in this step and the last one, if corrections are to stay
      in their span; see `Preferring`.
    """

    projection: AbstractProjection
    manifold: Manifold
    values: Float[Array, " m"]
    hidden: Float[Array, " m"]
    args: Args
    direction: Real[Array, ""]
    moved: Float[Array, " n"] | None = None
    factor: AbstractFactor = Identity()
    gained: Float[Array, "2 m"] | None = None
    preferred: Float[Array, "k n"] | None = None

    def advanced(
        self, start: RealScalarLike, end: RealScalarLike, path: Callable[[RealScalarLike], Y]
    ) -> "Target":
        """The target at a time `end` in a step, given the `path` of the solution from `start`.

        The integral over the step is added to the integrals so far by compensated summation (W.
        Kahan, "Further remarks on reducing truncation errors", *Comm. ACM* 8 (1965), 40). So their
        roundoff does not grow with the number of steps.
        """
        if self.gained is None:
            return self
        last, excess = self.gained
        more = integrated_rates(self.manifold, start, end, path, self.args, self.direction)
        more = ravel(more).astype(last.dtype) - excess
        total = last + more
        return dataclasses.replace(self, gained=jnp.stack([total, (total - last) - more]))

    def following(self, t: RealScalarLike, y: Y) -> "Target":
        """The target with values that a state `y` on the manifold can keep.

        A balance comes to rest, for example when friction has stopped a pendulum. The integral of
        its rate then keeps a rest of roundoff, say an energy of -1e-17, which no state has: all
        later projections would fail. So where the residual at the start of a step is within the
        tolerance, but more than half of what counts as noise, the value follows the state until it
        is that.
        """
        if self.gained is None:
            return self
        equations, y = tree_stop_gradient((self.equations(t, y), ravel(y)))
        off, jacobian = equations.linearise(y)
        limit = equations.tolerance(equations.scale(jacobian, y))
        within = (self.gained[0] != 0) & (jnp.abs(off) <= limit)
        noise = NOISE / ROUNDOFF * limit / 2
        follow = jnp.where(within, off - jnp.clip(off, -noise, noise), 0)
        # The next integral is added minus the second row, so that it is larger by `follow`.
        return dataclasses.replace(self, gained=self.gained.at[1].add(-follow))

    @property
    def value(self) -> Float[Array, " m"]:
        """What the functions must be now: the conserved values, plus what balances have gained."""
        return self.values if self.gained is None else self.values + self.gained[0]

    def equations(self, t: RealScalarLike, y: Y) -> Equations:
        """The equations at a time of the solver, for states like `y`."""
        hidden, like = self.hidden, jax.eval_shape(lambda: y)
        if self.gained is not None:
            # An energy that has been lost leaves a small value, which is a difference of large
            # numbers and has their roundoff. So its scale is at least that of the start.
            hidden = hidden + jnp.maximum(jnp.abs(self.values) - jnp.abs(self.value), 0)
        t = t * self.direction
        equations = equations_of(self.manifold, self.value, t, like, self.args, hidden)
        equations = dataclasses.replace(equations, factor=self.factor, moved=self.moved)
        equations = adapted(equations, self.projection, t, y, self.args)
        if self.preferred is None:
            return equations
        factor = Preferring.along(equations.factor, self.preferred)
        return dataclasses.replace(equations, factor=factor)

    def metric(self, t: RealScalarLike, y: Y) -> AbstractFactor:
        """The factor of the metric of the projection, at a time of the solver."""
        own = self.projection.metric
        return self.factor if own is None else factor_of(own, t * self.direction, y, self.args)

    def step(
        self, start: RealScalarLike, end: RealScalarLike, y0: Y, error: Y | None
    ) -> Step | None:
        """The `Step` for a projection whose `sees_step` is true, otherwise `None`."""
        if not self.projection.sees_step:
            return None
        error = None if error is None else ravel(error)
        return Step(start * self.direction, end * self.direction, ravel(y0), error)

    def problem(self, t: RealScalarLike, candidate: Y, step: Step | None = None) -> Problem:
        """The problem at a time of the solver."""
        equations, like = self.equations(t, candidate), jax.eval_shape(lambda: candidate)
        manifold, t, args = self.manifold, t * self.direction, self.args
        flat, _ = jtu.tree_flatten_with_path(manifold, is_leaf=is_entry)
        keys = tuple(key_of(path[0]) if path else None for path, _ in flat)
        names = tuple(name for name, _ in named_entries(manifold))
        values = jax.eval_shape(lambda y: evaluate(manifold, t, y, args), like)
        return Problem(equations, t, args, unflatten(self.value, values), like, names, keys, step)

    @eqx.filter_jit  # traced once, though `project_if` asks for its shapes too
    def project(
        self, t: RealScalarLike, candidate: Y, step: Step | None = None
    ) -> tuple[Y, ProjectionInfo]:
        problem = self.problem(t, candidate, step)
        y, info = self.projection.solve(problem, ravel(candidate))
        return problem.state(y), info

    def project_if(
        self, due: Bool[Array, ""] | None, t: RealScalarLike, candidate: Y, step: Step | None = None
    ) -> tuple[Y, ProjectionInfo]:
        """As `project` where a projection is `due`, otherwise the candidate with an empty report.
        A candidate that is not finite is projected in any case, so that the report tells of it."""
        if due is None:
            return self.project(t, candidate, step)
        needed = due | ~tree_all_finite(candidate)
        like = eqx.filter_eval_shape(self.project, t, candidate, step)[1]
        idle = jtu.tree_map(lambda x: jnp.zeros(x.shape, x.dtype), like)
        idle = dataclasses.replace(idle, ok=jnp.asarray(True))
        return lax.cond(needed, lambda: self.project(t, candidate, step), lambda: (candidate, idle))
