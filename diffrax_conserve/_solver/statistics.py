"""The statistics of the projections of a solve."""

import dataclasses
from typing import final

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._custom_types import Manifold
from .._manifold import named_entries
from .._numerics.report import ProjectionInfo
from .._options import found_in
from .._printing import is_traced, names_at, printed

# Corrections are usually shorter than the error estimate of their step, because that is the
# estimate for a method of lower order. If one is longer by this factor, the quantity is probably
# not conserved. The number is a choice.
_SUSPICIOUS = 10


@final
class ProjectionStatistics(eqx.Module):
    """Totals over the accepted steps of a solve, and of earlier solves that it continues.

    **Attributes:**

    - `num_projections`: the number of projected steps.
    - `num_iterations`, `max_iterations`: the number of iterations of all, and the largest of one.
    - `residual_before`, `residual_after`, `correction`, `roundoff`: the largest of each, as in a
        `ProjectionInfo`.
    - `error`: the largest error estimate of the wrapped solver, in the metric of `correction`; NaN
        if it has none. Corrections that are much longer tell that a quantity is not conserved.
    - `worst`: the position in `names` of the entry of the manifold that failed last; -1 if none
        failed. `print` shows the name.
    - `names`: the names of the entries of the manifold, such as `manifold['energy']`.
    - `bounded`: whether the projection has bounds, where corrections may be long.
    """

    num_projections: Int[Array, "..."]
    num_iterations: Int[Array, "..."]
    max_iterations: Int[Array, "..."]
    residual_before: Float[Array, "..."]
    residual_after: Float[Array, "..."]
    correction: Float[Array, "..."]
    roundoff: Float[Array, "..."]
    error: Float[Array, "..."]
    worst: Int[Array, "..."]
    names: tuple[str, ...] = eqx.field(static=True)
    bounded: bool = eqx.field(static=True)

    @classmethod
    def zero(
        cls, manifold: Manifold, dtype: jnp.dtype, bounded: bool = False
    ) -> "ProjectionStatistics":
        count, size, worst = jnp.asarray(0), jnp.zeros((), dtype), jnp.asarray(-1)
        names = tuple(name for name, _ in named_entries(manifold))
        sizes = size, size, size, size, size * jnp.nan
        return cls(count, count, count, *sizes, worst=worst, names=names, bounded=bounded)

    def __str__(self) -> str:
        if is_traced(self):
            return repr(self)
        rows = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        rows["worst"] = names_at(self.worst, rows.pop("names"))
        bounded = rows.pop("bounded")
        if not rows["worst"]:
            del rows["worst"]
        if np.all(np.isnan(self.error)):
            del rows["error"]
        text = printed("projections of the accepted steps", rows)
        suspicious = np.asarray(self.correction) > _SUSPICIOUS * np.asarray(self.error)
        if not bounded and np.any(suspicious):
            text += (
                "\nCorrections are far longer than the error estimates of the steps explain:"
                "\ncheck by `check_invariance` that the quantities are conserved."
            )
        return text

    def add(self, info: ProjectionInfo, error: Array | None) -> "ProjectionStatistics":
        """The statistics after one more step, with the report on its projection, and the length of
        the error estimate."""
        return ProjectionStatistics(
            self.num_projections + 1,
            self.num_iterations + info.num_iterations,
            jnp.maximum(self.max_iterations, info.num_iterations),
            jnp.maximum(self.residual_before, info.residual_before),
            jnp.maximum(self.residual_after, info.residual_after),
            jnp.maximum(self.correction, info.correction),
            jnp.maximum(self.roundoff, info.roundoff),
            self.error if error is None else jnp.fmax(self.error, error),
            jnp.where(info.ok, self.worst, info.worst),
            self.names,
            self.bounded,
        )


def statistics(sol: dfx.Solution) -> ProjectionStatistics:
    """The statistics of the projections of a solve.

    They are part of the state of a `ManifoldProjection`, which `diffeqsolve` returns by
    `SaveAt(solver_state=True)`; otherwise they are not computed. Rejected steps appear only in
    `sol.stats["num_rejected_steps"]`. A failed step that ends a solve is kept: `print` then names
    the entry of the manifold that failed.

    **Arguments:**

    - `sol`: the solution from `diffrax.diffeqsolve`, or a batch of them from `jax.vmap`.

    **Returns:**

    A `ProjectionStatistics`.

    **Raises:**

    `ValueError` if `sol` holds no state of a `ManifoldProjection`, `TypeError` if no solution.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        square = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))
        term = diffrax.ODETerm(lambda t, y, args: jnp.array([-y[1], y[0]]))
        solver = dfc.ManifoldProjection(diffrax.Tsit5(), square)
        saveat = diffrax.SaveAt(t1=True, solver_state=True)
        sol = diffrax.diffeqsolve(term, solver, 0, 9, 1.0, jnp.array([1.0, 0.0]), saveat=saveat)
        longest = dfc.statistics(sol).max_iterations
        ```
    """
    return found_in(sol, ProjectionStatistics, "statistics", "a `ManifoldProjection`")
