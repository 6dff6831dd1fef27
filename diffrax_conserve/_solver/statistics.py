"""The statistics of a solve, found in its solution."""

import diffrax as dfx
import jax.tree_util as jtu

from .._options import check_solution
from .state import ProjectionStatistics


def statistics(sol: dfx.Solution) -> ProjectionStatistics:
    """The statistics of the projections of a solve.

    They are part of the state of a `ManifoldProjection`, which `diffeqsolve` returns by
    `SaveAt(solver_state=True)`; otherwise they are not computed. Rejected steps appear only in
    `sol.stats["num_rejected_steps"]`. A failed step that ends a solve is kept:
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
        solver = dfc.ManifoldProjection(diffrax.Tsit5(), square)
        saveat = diffrax.SaveAt(t1=True, solver_state=True)
        y0 = jnp.array([1.0, 0.0])
        sol = diffrax.diffeqsolve(term, solver, 0, 9, 0.5, y0, saveat=saveat)
        print(dfc.statistics(sol))
        ```

        ```text
        projections of the accepted steps
          num_projections  18
          num_iterations   3
          max_iterations   1
          residual_before  4.6e-07
          residual_after   1.9e-07
          correction       1.0e-06
          roundoff         3.2e-01
        ```
    """
    check_solution(sol, "statistics")
    leaves = jtu.tree_leaves(
        sol.solver_state, is_leaf=lambda x: isinstance(x, ProjectionStatistics)
    )
    found = [x for x in leaves if isinstance(x, ProjectionStatistics)]
    if not found:
        raise ValueError(
            "`sol` holds no state of a `ManifoldProjection`. Solve with a `ManifoldProjection`, "
            "and with `saveat=SaveAt(..., solver_state=True)`."
        )
    return found[0]
