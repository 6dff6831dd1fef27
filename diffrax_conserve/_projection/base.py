"""The interface of projections: the problem, the report, and the checks of options."""

import abc
import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from .._custom_types import Args, IntScalarLike, RealScalarLike, Values, Y
from .._options import check_count, check_number, check_numbers
from .._printing import is_traced, printed
from .._tree import tree_stop_gradient, unravel
from .equations import Equations, relative
from .step import Step


class ProjectionInfo(eqx.Module):
    """The report on a projection.

    **Attributes:**

    - `ok`: whether every residual is within its tolerance at the state that is returned.
    - `result`: an `optimistix.RESULTS`, successful if and only if `ok`; `nonfinite` if the
        candidate has no finite residual, divergence if only the result has none.
    - `num_steps`: the number of iterations.
    - `residual_before`, `residual_after`: the largest residual of the candidate and of the
        projected state, each relative to the scale of its own constraint at the projected state,
        $|\\text{conserved value}| + \\sum_k |y_k \\, \\partial g/\\partial y_k|$ plus the terms
        that cancel inside `fn`.
    - `correction`: the Euclidean norm of the projected state minus the candidate.
    - `roundoff`: the largest share of a scale that the gradient does not show: near one where `fn`
        is less accurate than its gradient tells, as `1 - cos(q)` near zero.
    - `worst`: if the projection failed, the position of the entry of the manifold with the largest
        relative residual (the smaller of its residuals before and after), as
        [`diffrax_conserve.entry_name`][] takes it; otherwise 0.
    """

    ok: Bool[Array, ""]
    result: optx.RESULTS
    num_steps: Int[Array, ""]
    residual_before: Float[Array, ""]
    residual_after: Float[Array, ""]
    correction: Float[Array, ""]
    roundoff: Float[Array, ""]
    worst: Int[Array, ""]

    def __str__(self) -> str:
        if is_traced(self):
            return repr(self)
        ok = np.asarray(self.ok)
        if ok.ndim > 0:
            title = f"{ok.sum()} of {ok.size} projections succeeded"
        else:
            title = "projected" if ok else f"NOT PROJECTED: {optx.RESULTS[self.result]}"
        names = ("num_steps", "residual_before", "residual_after", "correction", "roundoff")
        rows = {name: getattr(self, name) for name in names}
        return printed(title, rows if ok.all() else rows | {"worst": self.worst})


class Problem(eqx.Module):
    """The problem that a projection solves. States are real vectors of `n` numbers; `state` makes
    one a state of the solve.

    **Attributes:**

    - `equations`: the residuals `g` and their scales; `residual(y)` is the vector of the `m`
        residuals.
    - `t`, `args`, `values`: the time, the parameters, and the conserved values, shaped like the
        manifold.
    - `like`: the shapes and dtypes of the state, `jax.ShapeDtypeStruct`s.
    - `keys`: for each entry of the manifold its first key, such as a key of a dictionary.
    - `step`: the [`diffrax_conserve.Step`][] of the solve; `None` outside a solve, as in
        [`diffrax_conserve.project`][], and for a projection whose `sees_step` is false.
    """

    equations: Equations
    t: RealScalarLike
    args: Args
    values: Values
    like: Any
    keys: tuple[Any, ...] = eqx.field(static=True)
    step: Step | None = None

    def residual(self, y: Float[Array, " n"]) -> Float[Array, " m"]:
        """The residuals at a state, in the order in which the manifold is flattened."""
        return self.equations.residual(y)

    def state(self, y: Float[Array, " n"]) -> Y:
        """The state of the solve whose numbers are `y`."""
        return unravel(y, self.like)

    def tolerating(self, rtol: float | Array | None, atol: float | Array | None) -> Equations:
        """The equations with these tolerances."""
        return dataclasses.replace(self.equations, rtol=rtol, atol=atol)

    def judge(
        self,
        candidate: Float[Array, " n"],
        y: Float[Array, " n"],
        num_steps: IntScalarLike = 1,
        *,
        rtol: float | Array | None = None,
        atol: float | Array | None = None,
        ok: Bool[Array, ""] | None = None,
    ) -> ProjectionInfo:
        """The report on a projection from `candidate` to `y`, as `solve` must return it.

        **Arguments:**

        - `candidate`, `y`: the states before and after.
        - `num_steps`: the number of iterations.
        - `rtol`, `atol`: the tolerances for residuals; see `SimplifiedNewton`.
        - `ok`: the verdict, if it is known. By default it is given here.

        **Returns:**

        A [`diffrax_conserve.ProjectionInfo`][], successful if every residual is small at `y`.
        """
        # The verdict has no derivative.
        given = self.tolerating(rtol, atol), candidate, y
        equations, candidate, y = tree_stop_gradient(given)
        after, jacobian = equations.linearise(y)
        scale = equations.scale(jacobian, y)
        sizes = [jnp.abs(relative(g, scale)) for g in (equations.residual(candidate), after)]
        success = equations.verdict(after, jacobian, y) > 0 if ok is None else ok
        before, after = (jnp.max(x) for x in sizes)
        kinds = optx.RESULTS
        reached = kinds.where(
            jnp.isfinite(after), kinds.nonlinear_max_steps_reached, kinds.nonlinear_divergence
        )
        failed = kinds.where(jnp.isfinite(before), reached, kinds.nonfinite)
        # The smaller of both, so that none is blamed for an iteration that diverged.
        least = jnp.minimum(*(jnp.where(jnp.isnan(x), jnp.inf, x) for x in sizes))
        parts = [eqx.filter_eval_shape(part, y).size for part in equations.parts]
        entry = jnp.asarray(np.repeat(np.arange(len(parts)), parts))
        return ProjectionInfo(
            ok=success,
            result=kinds.where(success, kinds.successful, failed),
            num_steps=jnp.asarray(num_steps),
            residual_before=before,
            residual_after=after,
            correction=jnp.linalg.norm(y - candidate),
            roundoff=jnp.max(relative(equations.hidden, scale)),
            worst=jnp.where(success, 0, entry[jnp.argmax(least)]),
        )


class AbstractProjection(eqx.Module):
    """A map from a candidate to a state on the manifold.

    Write your own as a subclass with a field `metric` and the method `solve`; see "Your own
    projection" in the guide. Set `sees_step = False` in the class if it does not use
    `Problem.step`: then it needs no step, as in a stage of [`diffrax_conserve.Staged`][].
    """

    metric: eqx.AbstractVar[PyTree[ArrayLike] | None]
    # Whether `Problem.step` is set. If so, dense output also stores the error estimate.
    sees_step: ClassVar[bool] = True

    @abc.abstractmethod
    def solve(
        self, problem: Problem, candidate: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], ProjectionInfo]:
        """The state on the manifold that belongs to `candidate`, and the report on it.

        Never raises at run time; `info.ok` is true only if every residual is small.
        """


def option(default: Any, **kwargs: Any) -> Any:
    """An optional, keyword-only field."""
    return eqx.field(default=default, kw_only=True, **kwargs)


def check_like(name: str, option: PyTree[ArrayLike], y: Y, remedy: str) -> None:
    """Raises unless `option` is structured like the state, with scalars or arrays as leaves."""
    if jtu.tree_structure(option) != jtu.tree_structure(y):
        raise ValueError(
            f"`{name}` has the structure {jtu.tree_structure(option)}, but the state has "
            f"{jtu.tree_structure(y)}. {remedy}"
        )
    for given, leaf in zip(jtu.tree_leaves(option), jtu.tree_leaves(y), strict=True):
        if jnp.shape(given) not in ((), jnp.shape(leaf)):
            raise ValueError(
                f"`{name}` has a leaf of shape {jnp.shape(given)} for a leaf of the state of shape "
                f"{jnp.shape(leaf)}. Give a scalar or an array of the same shape."
            )


def check_options(projection: Any) -> None:
    """Raises unless the options common to the projections are valid."""
    for name in ("rtol", "atol"):
        check_number(name, getattr(projection, name), least=0.0)
    if hasattr(projection, "max_steps"):
        check_count("max_steps", projection.max_steps)
    for name in ("lower", "upper"):
        check_numbers(name, getattr(projection, name, None), least=-np.inf)


def check_projection(projection: Any) -> None:
    """Raises unless `projection` is an instance of a projection, not a class."""
    if not isinstance(projection, AbstractProjection):
        raise TypeError(
            f"`projection` is {projection!r}, which is not a projection. Pass an instance, for "
            "example `projection=SimplifiedNewton()`."
        )


# The options that the Newton iterations share.
NEWTON_OPTIONS = r"""**Arguments:**

- `rtol`: the largest accepted residual, relative to the scale of its constraint at the projected
    state, to which roundoff is proportional. Default: 16 units of roundoff of the dtype. Nearly
    every projection ends well below it.
- `atol`: an absolute tolerance, added to the relative one. Default: 0.
- `max_steps`: the largest number of iterations, with bounds twice as many. A projection that is
    not within its tolerance by then has failed.
- `metric`: a PyTree like the state of positive weights (masses, or $1/\text{scale}^2$), scalars or
    arrays shaped like the leaves: distances are $\sum_k M_k (y_k - \hat y_k)^2$. An infinite weight
    freezes its component. Default: Euclidean.
- `lower`, `upper`: bounds of the components, such as `lower=0` for concentrations: numbers, or
    PyTrees like the state of scalars or arrays. The result is
    $\mathrm{clip}(\hat y + M^{-1} G^\top \lambda)$, which is always within the bounds and for
    linear constraints is the nearest such point of the manifold. If there is no such point, the
    projection fails. In derivatives, components at a bound are constant. For a complex component
    the bounds apply to both parts. Default: none.

**Raises:**

`TypeError` if an option is not a number; `ValueError` if a tolerance is negative, `max_steps` is
less than 1, a weight is not positive, a lower bound is above its upper bound, or, when the
projection is used, the bounds are not shaped like the state.
"""


def positive_weights(metric: PyTree[ArrayLike] | None) -> PyTree[ArrayLike] | None:
    """`metric`, checked now if its values are known, and at run time if they are tracers."""
    message = (
        "`metric` has a weight that is not positive. Every weight must be greater than 0; they are "
        "per component, not a matrix."
    )

    def check(weight: ArrayLike) -> ArrayLike:
        check_number("metric", weight)
        if isinstance(weight, jax.core.Tracer):
            return eqx.error_if(weight, ~jnp.all(weight > 0), message)
        if not np.all(np.asarray(weight) > 0):
            raise ValueError(message)
        return weight

    return jtu.tree_map(check, metric)
