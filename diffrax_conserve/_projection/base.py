"""The interface of projections: the problem, the report, and the checks of options."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from .._custom_types import Args, IntScalarLike, RealScalarLike, Values, Y
from .._options import check_count, check_number, check_numbers
from .._tree import from_view, tree_stop_gradient
from .elimination import Vector
from .equations import Equations, ProjectionInfo
from .linearise import Joined, linearise
from .residual import Tolerance
from .step import Step


class Problem(eqx.Module):
    """The problem that a projection solves.

    **Attributes:**

    - `residual`: `y ↦ g(y)`, of shape `(m,)`, whose closed-over arrays are part of its PyTree.
    - `magnitude`: the absolute conserved values, as `residual` returns them.
    - `weights`: `M⁻¹`, the inverse of the metric, shaped like the state.
    - `t`, `args`, `values`: the time, the parameters, and the conserved values, shaped like the
        manifold, from which `residual` was made.
    - `like`: the shapes and dtypes of the state, `jax.ShapeDtypeStruct`s. For a complex leaf, all
        other attributes, the candidate and the result have the real and the imaginary part along a
        new first axis; `state` combines them.
    - `anchor`: a state near the manifold, from which an iteration can start if it fails from the
        candidate: in dense output the nearer end of the step, in a step `None`.
    - `step`: the [`diffrax_conserve.Step`][] of the solve; `None` outside a solve, as in
        [`diffrax_conserve.project`][], and for a projection whose `sees_step` is false.
    """

    residual: Joined
    magnitude: Vector
    weights: Y
    t: RealScalarLike
    args: Args
    values: Values
    like: Any
    anchor: Y | None = None
    step: Step | None = None

    def state(self, y: Y) -> Any:
        """Converts a candidate to a state of the solve, with its complex leaves.

        **Arguments:**

        - `y`: a candidate.

        **Returns:**

        The state, complex where the state of the solve is.
        """
        return from_view(y, self.like)

    def judge(
        self,
        candidate: Y,
        y: Y,
        num_steps: IntScalarLike = 1,
        *,
        rtol: float | Array | None = None,
        atol: float | Array | None = None,
    ) -> "ProjectionInfo":
        """The report on a projection from `candidate` to `y`, as `solve` must return it.

        **Arguments:**

        - `candidate`, `y`: the states before and after.
        - `num_steps`: the number of iterations.
        - `rtol`, `atol`: the tolerances for residuals; see `SimplifiedNewton`.

        **Returns:**

        A [`diffrax_conserve.ProjectionInfo`][], successful if every residual is small at `y`.
        """
        # The verdict has no derivative, and the derivative of a given Jacobian may not exist.
        equations = self.equations(candidate, Tolerance(rtol, atol))
        equations, y = tree_stop_gradient((equations, y))
        before, jacobian = linearise(equations.residual, equations.candidate)
        rank = equations.gram_solver(jacobian).rank
        return equations.report(y, before, equations.measure(y), jnp.asarray(num_steps), rank)

    def equations(self, candidate: Y, tolerance: Tolerance, linear_solver: Any = None) -> Equations:
        weights, magnitude = self.weights, self.magnitude
        return Equations(self.residual, candidate, weights, magnitude, tolerance, linear_solver)


def option(default: Any, **kwargs: Any) -> Any:
    """An optional, keyword-only field."""
    return eqx.field(default=default, kw_only=True, **kwargs)


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
    def solve(self, problem: Problem, candidate: Y) -> tuple[Y, ProjectionInfo]:
        """The state on the manifold that belongs to `candidate`, shaped like it.

        Never raises at run time; `info.result` is successful only if every residual is small.
        """


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
    solver = getattr(projection, "linear_solver", None)
    if solver is not None and not isinstance(solver, lx.AbstractLinearSolver):
        raise TypeError(
            f"`linear_solver` is {solver!r}, but it must be a solver of lineax, such as "
            "`lineax.Cholesky()`, or `None`."
        )
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
- `atol`: an absolute tolerance, added to the relative one. Default: 0. Set it where the functions
    of the manifold are less accurate than roundoff.
- `max_steps`: the largest number of iterations (in `Newton`, of each phase). A projection that is
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
- `linear_solver`: a solver of lineax for the systems of the iterations with the matrix
    $G M^{-1} G^\top$: `lineax.Cholesky()`, `lineax.CG(...)` or `lineax.SVD()`. It is positive
    definite even if constraints depend on each other, because $\varepsilon^{3/4}$ of its diagonal
    is added to it. The systems of derivatives and those with two different Jacobians are solved as
    by default: by an elimination that leaves out dependent constraints, and with more than 128
    constraints by conjugate gradients.

**Raises:**

`TypeError` if an option is not a number, or `linear_solver` is not a solver of lineax; `ValueError`
if a tolerance is negative, `max_steps` is less than 1, a weight is not positive, a lower bound is
above its upper bound, or, when the projection is used, the bounds are not shaped like the state.
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
