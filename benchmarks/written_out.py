"""An explicit Runge-Kutta method of diffrax with its stages written out: a trial.

diffrax keeps the stages of a step in one array, which its loop over the stages updates in place.
In a batch every stage then goes through memory. Written out, the whole step is one expression,
which XLA keeps in registers: the same numbers, an order of magnitude faster for small systems.
"""

from collections.abc import Sequence
from typing import Any, ClassVar, final

import diffrax as dfx
import jax
import jax.numpy as jnp


@final
class WrittenOut(dfx.AbstractAdaptiveSolver[Any]):
    """`solver`, an explicit Runge-Kutta method with a public `tableau`, such as `diffrax.Tsit5()`.

    Same steps, error estimate, dense output and, where it is the solver's own property, reuse of
    the last stage in the next step. Compilation grows with the number of stages.
    """

    solver: dfx.AbstractERK

    term_structure: ClassVar = dfx.AbstractTerm

    @property
    def interpolation_cls(self) -> Any:
        return self.solver.interpolation_cls

    def order(self, terms: Any) -> int | None:
        return self.solver.order(terms)

    def error_order(self, terms: Any) -> Any:
        return self.solver.error_order(terms)

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        return terms.vf(t0, y0, args)

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> Any:
        return terms.vf(t0, y0, args) if self.solver.tableau.fsal else None

    def step(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> Any:
        tableau = self.solver.tableau
        control = terms.contr(t0, t1)
        slope = self._first(terms, t0, y0, args, solver_state, made_jump)
        increments, y = [terms.prod(slope, control)], y0
        for fraction, row in zip(tableau.c, tableau.a_lower, strict=True):
            y = _displaced(y0, row, increments)
            slope = terms.vf(t0 + float(fraction) * (t1 - t0), y, args)
            increments.append(terms.prod(slope, control))
        # "Solution same as last": the last stage is at the solution.
        y1 = y if tableau.ssal else _displaced(y0, tableau.b_sol, increments)
        error = _combined(tableau.b_error, increments)
        k = jax.tree.map(lambda *leaves: jnp.stack(leaves), *increments)
        dense_info = dict(y0=y0, y1=y1, k=k)
        state = slope if tableau.fsal else None
        return y1, error, dense_info, state, dfx.RESULTS.successful

    def _first(
        self, terms: Any, t0: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> Any:
        """The slope at the start, which the last step may have left behind."""
        if solver_state is None:
            return terms.vf(t0, y0, args)
        if made_jump is False:
            return solver_state
        return jax.lax.cond(made_jump, lambda: terms.vf(t0, y0, args), lambda: solver_state)


def _combined(weights: Sequence[float], increments: list[Any]) -> Any:
    """Their weighted sum, without what a zero would multiply."""
    used = [(float(w), k) for w, k in zip(weights, increments, strict=False) if w != 0]
    factors, terms = zip(*used, strict=True)
    return jax.tree.map(
        lambda *leaves: sum(w * x for w, x in zip(factors, leaves, strict=True)), *terms
    )


def _displaced(y: Any, weights: Sequence[float], increments: list[Any]) -> Any:
    return jax.tree.map(jnp.add, y, _combined(weights, increments))
