"""Projection in stages, for example positions first and then velocities."""

import dataclasses
import itertools as it
from typing import Any, ClassVar, final

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from .._large.sparse import pattern_of
from .._numerics.problem import Problem
from .._numerics.report import ProjectionInfo
from .base import AbstractProjection, with_options


@final
class Staged(AbstractProjection):
    r"""Projects to the parts of a manifold in a given order, keeping the earlier ones satisfied.

    Stage $k$ projects the result of the previous one to the set where the parts $1, \dots, k$ hold,
    by its own projection in its own metric, where an infinite weight freezes its component. In the
    example errors of the velocities do not move the positions. Compare it with the joint
    projection, which may be more or less accurate.

    The projection succeeds if all parts hold at the returned state.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        manifold = {
            "circle": dfc.Constraint(lambda t, y, args: jnp.sum(y[0] ** 2) - 1),
            "tangent": dfc.Constraint(lambda t, y, args: jnp.sum(y[0] * y[1])),
        }
        staged = dfc.Staged(
            ("circle", dfc.SimplifiedNewton(metric=(1.0, jnp.inf))),
            ("tangent", dfc.SimplifiedNewton(metric=(jnp.inf, 1.0))),
        )
        solver = dfc.ManifoldProjection(diffrax.Tsit5(), manifold, projection=staged)
        ```

    ??? cite "Reference"

        Hairer, Lubich and Wanner, *Geometric Numerical Integration*, Springer 2006, Section VII.1;
        CVODE's example `cvPendulum_dns`.
    """

    names: tuple[Any, ...] = eqx.field(static=True)
    projections: tuple[AbstractProjection, ...]
    metric: None = eqx.field(default=None, init=False)
    sees_step: ClassVar[bool] = False

    @property
    def has_bounds(self) -> bool:
        return any(projection.has_bounds for projection in self.projections)

    def clip(self, y: Float[Array, " n"], like: Any) -> Float[Array, " n"]:
        for projection in self.projections:
            y = projection.clip(y, like)
        return y

    def __init__(self, *stages: Any):
        for stage in stages:
            pair = isinstance(stage, tuple) and len(stage) == 2
            if not (pair and isinstance(stage[1], AbstractProjection)) or stage[1].sees_step:
                raise TypeError(
                    f"A stage of `Staged` is {stage!r}, but it must be a pair of a key of the "
                    "manifold and a projection with `sees_step = False`, such as "
                    '`("positions", SimplifiedNewton())`.'
                )
        self.names = tuple(name for name, _ in stages)
        self.projections = tuple(projection for _, projection in stages)

    def solve(
        self, problem: Problem, candidate: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], ProjectionInfo]:
        if len({*self.names}) != len(self.names) or {*self.names} != {*problem.keys}:
            raise ValueError(
                f"The stages of `Staged` are {self.names}, but the entries of `manifold` are "
                f"{tuple(dict.fromkeys(problem.keys))}. Give each entry one stage."
            )
        y, infos = candidate, []
        for number, projection in enumerate(self.projections, start=1):
            y, info = projection.solve(_restricted(problem, self.names[:number], projection, y), y)
            infos.append(info)
        count = sum(info.num_iterations for info in infos)
        # The last stage has tested all parts, by its own tolerances.
        return y, problem.report(candidate, y, count, ok=infos[-1].ok)


Staged.__init__.__doc__ = r"""**Arguments:**

- `stages`: pairs of a key of the manifold (of a dictionary, or the index in a tuple or list) and
    the projection of that stage, in order. Each key of the manifold is named once.

**Raises:**

`TypeError` if a stage is not such a pair; `ValueError`, in use, if the manifold has other keys.
"""


def _restricted(
    problem: Problem, keys: tuple[Any, ...], projection: AbstractProjection, candidate: Array
) -> Problem:
    """The problem restricted to the entries with these keys, in the metric and with the tolerances
    of the projection. A metric that is a function is evaluated at the candidate of the stage."""
    wanted = [key in keys for key in problem.keys]
    rows = np.flatnonzero(problem.per_residual(wanted))
    functions = tuple(it.compress(problem.functions, wanted))
    sizes = tuple(it.compress(problem.sizes, wanted))
    restricted = dataclasses.replace(
        problem,
        functions=functions,
        sizes=sizes,
        magnitude=problem.magnitude[rows],
        cancellation=problem.cancellation[rows],
        pattern=pattern_of(functions, sizes, jax.eval_shape(lambda: candidate)),
    )
    return with_options(restricted, projection, candidate)
