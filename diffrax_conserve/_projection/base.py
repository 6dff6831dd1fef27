"""The interface of projections."""

import abc
import dataclasses
from typing import Any, ClassVar

import equinox as eqx
from jaxtyping import Array, Float, PyTree

from .._constants import MAX_STEPS
from .._hashable import Hashable
from .._numerics.metric import factor_of
from .._numerics.problem import Problem
from .._numerics.report import ProjectionInfo


class AbstractProjection(Hashable):
    """A map from a candidate to a state on the manifold.

    Write your own as a subclass with a field `metric` and the method `solve`; see [Your own
    projection][your-own-projection]. The tolerances of the residuals are its fields `rtol` and
    `atol`, if it has them.
    Set `sees_step = False` in the class if it does not use `Problem.step`: then it needs no step,
    as in a stage of [`diffrax_conserve.Staged`][].
    """

    metric: eqx.AbstractVar[PyTree[Any] | None]
    # Whether the projection reads `Problem.step`. Then dense output stores the error estimate too,
    # which costs memory.
    sees_step: ClassVar[bool] = True
    # Whether corrections are along the gradients of the functions, from any candidate. Then dense
    # output tries the damped Newton method where the projection fails.
    follows_gradients: ClassVar[bool] = False
    # The tolerances, `None` for that of roundoff, and the number of iterations of the damped Newton
    # method. No annotations, so that these are no fields.
    rtol = None
    atol = None
    max_steps = MAX_STEPS

    @property
    def needs_signed_error(self) -> bool:
        """Whether the direction of the error estimate is used, and not only its length."""
        return False

    @property
    def has_bounds(self) -> bool:
        """Whether states are kept within bounds, beside the manifold."""
        return False

    def clip(self, y: Float[Array, " n"], like: Any) -> Float[Array, " n"]:
        """The state within the bounds, if there are any, for states with the shapes of `like`."""
        del like
        return y

    @abc.abstractmethod
    def solve(
        self, problem: Problem, candidate: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], ProjectionInfo]:
        """The state on the manifold that belongs to `candidate`, and the report on it.

        Never raises at run time; `info.ok` is true only if every residual is small.
        """


def with_options(
    problem: Problem, projection: AbstractProjection, y: Float[Array, " n"]
) -> Problem:
    """The problem with the tolerances of a projection, and with its metric at a state. If the
    projection has no metric, the problem keeps its own."""
    changed: dict[str, Any] = dict(rtol=projection.rtol, atol=projection.atol)
    if projection.metric is not None:
        state = problem.state(y)
        changed["factor"] = factor_of(projection.metric, problem.t, state, problem.args)
    return dataclasses.replace(problem, **changed)


def check_projection(projection: Any) -> None:
    if not isinstance(projection, AbstractProjection):
        name = getattr(projection, "__name__", "SimplifiedNewton")
        raise TypeError(
            f"`projection` is {projection!r}, which is not a projection. Pass `{name}()`."
        )
