"""The statistics of the projections of a solve."""

from typing import final

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._constants import TOLERANCE_IN_EPS
from .._custom_types import Manifold
from .._manifold import entry_names
from .._numerics.report import ProjectionInfo
from .._options import found_in
from .._printing import is_traced, names_at, printed
from .._tree import eps_of

# Corrections are usually shorter than error estimates, because these are for a method of lower
# order. If the largest correction is this many times the largest estimate, the quantity is probably
# not conserved. The number is a choice.
_MAX_PLAUSIBLE = 10


@final
class ProjectionStatistics(eqx.Module):
    """Totals over the accepted steps of a solve, a failed step that ended it, and earlier solves
    that it continues.

    **Attributes:**

    - `num_projections`: the number of projected steps.
    - `num_iterations`, `max_iterations`: the number of iterations of all, and the largest of one.
    - `residual_before`, `residual_after`, `correction`, `roundoff`: the largest of each, as in a
        `ProjectionInfo`.
    - `error`: the largest error estimate of the wrapped solver, in the metric of the projection;
        NaN if it has none. Corrections that are much longer tell that a quantity is not conserved.
    - `worst`: the position in `names` of the entry of the manifold that failed last; -1 if none
        failed. `print` shows the name.
    - `names`: the names of the entries of the manifold, such as `manifold['energy']`.
    - `bounded`: whether the projection has bounds, where corrections may be long.
    """

    # Two arrays, and not one for each number: in a batch each array of the solver state costs a
    # kernel in every step, and in a gradient each is saved and restored.
    counts: Int[Array, "*batch 4"]
    sizes: Float[Array, "*batch 5"]
    names: tuple[str, ...] = eqx.field(static=True)
    bounded: bool = eqx.field(static=True)

    num_projections = property(lambda self: self.counts[..., 0])
    num_iterations = property(lambda self: self.counts[..., 1])
    max_iterations = property(lambda self: self.counts[..., 2])
    worst = property(lambda self: self.counts[..., 3])
    residual_before = property(lambda self: self.sizes[..., 0])
    residual_after = property(lambda self: self.sizes[..., 1])
    correction = property(lambda self: self.sizes[..., 2])
    roundoff = property(lambda self: self.sizes[..., 3])
    error = property(lambda self: jnp.where(self._error >= 0, self._error, jnp.nan))
    # A negative number says that there is none: with `jax_debug_nans` JAX refuses any NaN.
    _error = property(lambda self: self.sizes[..., 4])

    @classmethod
    def zero(
        cls, manifold: Manifold, dtype: jnp.dtype, bounded: bool = False
    ) -> "ProjectionStatistics":
        names = entry_names(manifold)
        counts, sizes = jnp.array([0, 0, 0, -1]), jnp.array([0, 0, 0, 0, -1], dtype)
        return cls(counts, sizes, names, bounded)

    def __str__(self) -> str:
        if is_traced(self):
            return repr(self)
        rows = {name: getattr(self, name) for name in _SHOWN}
        if worst := names_at(self.worst, self.names):
            rows["worst"] = worst
        if np.all(np.isnan(self.error)):
            del rows["error"]
        text = printed("projections of the accepted steps", rows)
        correction, error = np.asarray(self.correction), np.asarray(self.error)
        before = np.asarray(self.residual_before)
        # A residual that a projection may leave as it is, is roundoff, and so is its correction.
        is_seen = before > TOLERANCE_IN_EPS * eps_of(before)
        if not self.bounded and np.any(is_seen & (correction > _MAX_PLAUSIBLE * error)):
            text += (
                "\nCorrections are far longer than the error estimates of the steps explain:"
                "\ncheck by `check_invariance` that the quantities are conserved."
            )
        return text

    def add(self, info: ProjectionInfo, error: Array | float) -> "ProjectionStatistics":
        """The statistics after one more step, with the report on its projection, and the length of
        the error estimate, -1 if there is none."""
        counts = (
            self.num_projections + 1,
            self.num_iterations + info.num_iterations,
            jnp.maximum(self.max_iterations, info.num_iterations),
            jnp.where(info.ok, self.worst, info.worst),
        )
        sizes = (
            jnp.maximum(self.residual_before, info.residual_before),
            jnp.maximum(self.residual_after, info.residual_after),
            jnp.maximum(self.correction, info.correction),
            jnp.maximum(self.roundoff, info.roundoff),
            jnp.fmax(self._error, error),
        )
        return ProjectionStatistics(jnp.stack(counts), jnp.stack(sizes), self.names, self.bounded)


# What `print` shows, in this order.
_SHOWN = (
    *("num_projections", "num_iterations", "max_iterations", "residual_before", "residual_after"),
    *("correction", "roundoff", "error"),
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
