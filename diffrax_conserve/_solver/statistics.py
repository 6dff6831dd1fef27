"""Statistics of the projections of a solve, carried in the solver state."""

import dataclasses
from typing import Any, final

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, Int

from .._options import check_solution
from .._printing import is_traced, printed
from .._projection.base import ProjectionInfo


@final
class ProjectionStatistics(eqx.Module):
    """Totals over the accepted steps of a solve, including those of earlier solves that it
    continues.

    **Attributes:**

    - `num_projections`: the number of projected steps.
    - `num_iterations`, `max_iterations`: the number of iterations of all projections, and the
        largest number of a single one.
    - `residual_before`, `residual_after`: the largest residual of a candidate and of a projected
        state, relative to the scale of its constraint.
    - `correction`: the largest Euclidean norm of a projected state minus its candidate.
    - `roundoff`: the largest share of a scale that the gradient does not show; see
        [`diffrax_conserve.ProjectionInfo`][].
    - `worst`: the position of the entry of the manifold that failed last, as
        [`diffrax_conserve.entry_name`][] takes it; -1 if none failed.
    """

    num_projections: Int[Array, "..."]
    num_iterations: Int[Array, "..."]
    max_iterations: Int[Array, "..."]
    residual_before: Float[Array, "..."]
    residual_after: Float[Array, "..."]
    correction: Float[Array, "..."]
    roundoff: Float[Array, "..."]
    worst: Int[Array, "..."]

    @classmethod
    def zero(cls, dtype: jnp.dtype) -> "ProjectionStatistics":
        count, size = jnp.asarray(0), jnp.zeros((), dtype)
        return cls(count, count, count, size, size, size, size, jnp.asarray(-1))

    def __str__(self) -> str:
        if is_traced(self):
            return repr(self)
        rows = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        if np.all(np.asarray(self.worst) < 0):
            del rows["worst"]
        return printed("projections of the accepted steps", rows)

    def add(self, info: ProjectionInfo, due: Array | None) -> "ProjectionStatistics":
        return ProjectionStatistics(
            self.num_projections + (1 if due is None else due.astype(int)),
            self.num_iterations + info.num_steps,
            jnp.maximum(self.max_iterations, info.num_steps),
            jnp.maximum(self.residual_before, info.residual_before),
            jnp.maximum(self.residual_after, info.residual_after),
            jnp.maximum(self.correction, info.correction),
            jnp.maximum(self.roundoff, info.roundoff),
            jnp.where(info.ok, self.worst, info.worst),
        )


def statistics(sol: dfx.Solution) -> ProjectionStatistics:
    """The statistics of the projections of a solve.

    They are part of the state of a `ManifoldProjection`, so `diffeqsolve` must return it, by
    `SaveAt(solver_state=True)`. Otherwise they are not computed.

    diffrax discards the solver state of a rejected step, so rejected steps appear only in
    `sol.stats["num_rejected_steps"]`. A failed step that ends a solve is kept: from `worst`,
    `entry_name(manifold, int(statistics(sol).worst))` is the name of the entry that failed.

    **Arguments:**

    - `sol`: the solution from `diffrax.diffeqsolve` with `saveat=SaveAt(..., solver_state=True)`,
        or a batch of them from `jax.vmap`.

    **Returns:**

    A [`diffrax_conserve.ProjectionStatistics`][].

    **Raises:**

    `ValueError` if `sol` holds no state of a `ManifoldProjection`; `TypeError` if `sol` is not a
    solution.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        square = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))
        term = diffrax.ODETerm(lambda t, y, args: jnp.array([-y[1], y[0]]))
        sol = diffrax.diffeqsolve(
            term,
            dfc.ManifoldProjection(diffrax.Tsit5(), square),
            t0=0,
            t1=9,
            dt0=0.5,
            y0=jnp.array([1.0, 0.0]),
            saveat=diffrax.SaveAt(t1=True, solver_state=True),
        )
        print(dfc.statistics(sol))
        ```

        ```text
        projections of the accepted steps
          num_projections  18
          num_iterations   3
          max_iterations   1
          residual_before  3.6e-07
          residual_after   1.5e-07
          correction       1.0e-06
          roundoff         4.7e-01
        ```
    """
    check_solution(sol, "statistics")
    found = _instances(sol.solver_state, ProjectionStatistics)
    if not found:
        raise ValueError(
            "`sol` holds no state of a `ManifoldProjection`. Solve with a `ManifoldProjection`, "
            "and with `saveat=SaveAt(..., solver_state=True)`."
        )
    return found[0]


def _instances(tree: Any, kind: type) -> list[Any]:
    leaves = jtu.tree_leaves(tree, is_leaf=lambda x: isinstance(x, kind))
    return [x for x in leaves if isinstance(x, kind)]
