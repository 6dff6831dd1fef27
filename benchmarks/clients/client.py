"""What a published package is asked for: a problem of its own, solved through its own door."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

sys.path.append(str(Path(__file__).resolve().parents[1] / "cost"))
import diffrax as dfx
import jax
import jax.numpy as jnp
import measuring as measuring  # sets float64, and the clock

import diffrax_conserve as dfc


def itself(ys: Any) -> Any:
    return ys


class Client(NamedTuple):
    """A problem of a package, and how the package takes a solver.

    `run(solver, tolerance)` is a function without arguments that calls the package, and returns the
    states at the times `ts`. Everything else is for the judgement: the field and the initial state
    as the package passes them to diffrax, and `quantities(ys)`, a PyTree of arrays, each of which
    is compared by its norm.
    """

    package: str
    problem: str
    solver: dfx.AbstractSolver
    manifold: Any
    tolerance: float
    ts: jax.Array
    run: Callable[[dfx.AbstractSolver, float], Callable[[], Any]]
    field: Callable[[Any, Any, Any], Any]
    y0: Any
    args: Any = None
    projection: Any = None
    quantities: Callable[[Any], Any] = itself
    exact: Callable[[], Any] | None = None  # instead of a tight solve through the package

    def kept(self) -> dfc.ManifoldProjection:
        options = {} if self.projection is None else dict(projection=self.projection)
        return dfc.ManifoldProjection(self.solver, self.manifold, **options)

    def reference(self) -> Any:
        return self.exact() if self.exact else self.run(dfx.Dopri8(), 1e-13)()

    def error(self, ys: Any, reference: Any) -> float:
        """The largest error of a quantity over all times, relative to its largest norm."""
        pairs = zip(*(jax.tree.leaves(self.quantities(x)) for x in (ys, reference)), strict=True)
        return max(float(jnp.max(norms(a - b)) / jnp.max(norms(b))) for a, b in pairs)

    def drift(self, ys: Any) -> float:
        """The largest residual over all times, relative to its scale, as of `dfc.drift`."""
        solution = dfx.Solution(
            t0=self.ts[0], t1=self.ts[-1], ts=self.ts, ys=ys, interpolation=None, stats={},
            result=dfx.RESULTS.successful, solver_state=None, controller_state=None,
            made_jump=None, event_mask=None,
        )  # fmt: skip
        drifts = jax.tree.leaves(dfc.drift(solution, self.manifold, self.args))
        return max(float(jnp.max(jnp.abs(x))) for x in drifts)


def norms(x: jax.Array) -> jax.Array:
    return jnp.linalg.norm(x.reshape(len(x), -1), axis=1)
