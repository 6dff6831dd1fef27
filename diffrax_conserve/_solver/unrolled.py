"""Explicit Runge-Kutta methods with their stages written out."""

from typing import Any, ClassVar, final

import diffrax as dfx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from .._custom_types import VF, Args, BoolScalarLike, DenseInfo, RealScalarLike, Y


@final
class Unrolled(dfx.AbstractAdaptiveSolver[Any]):
    r"""An explicit Runge-Kutta method of diffrax with its stages written out.

    diffrax keeps the stages $k_i = f(t + c_i h, y + h \sum_j a_{ij} k_j)$ of a step in one array,
    so that in a batch every stage goes through memory. Written out, the whole step is one
    expression, which XLA keeps in registers: with the same steps, error estimate and dense output,
    up to the order of summation, a batch of small systems is about ten times as fast
    (`benchmarks/cost/overhead.py`). Compile time grows with the number of stages times the size of
    the vector field. A large system or a single long solve gains nothing.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax
        import jax.numpy as jnp

        radius = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))
        solver = dfc.ManifoldProjection(dfc.Unrolled(diffrax.Dopri8()), radius)
        term = diffrax.ODETerm(lambda t, y, args: jnp.array([-y[1], y[0]]))
        solve = jax.vmap(lambda y0: diffrax.diffeqsolve(term, solver, 0, 9, 0.3, y0).ys)
        ys = solve(jnp.ones((1000, 2)))
        ```

    ??? cite "Reference"

        Hairer, Nørsett, Wanner, *Solving Ordinary Differential Equations I*, Springer 1993, II.1.
    """

    solver: Any  # an `AbstractERK`; checked below, with a remedy

    term_structure: ClassVar = dfx.AbstractTerm

    def __check_init__(self):
        explicit = isinstance(self.solver, dfx.AbstractERK)
        if not explicit or not isinstance(self.solver.tableau, dfx.ButcherTableau):
            raise TypeError(
                f"`solver` of `Unrolled` is {self.solver!r}, which is not an explicit Runge-Kutta "
                "method with one Butcher tableau. Pass an instance of one, and wrap the result: "
                "`ManifoldProjection(Unrolled(diffrax.Tsit5()), manifold)`."
            )

    @property
    def interpolation_cls(self) -> Any:  # pyright: ignore
        return self.solver.interpolation_cls

    def order(self, terms: PyTree[dfx.AbstractTerm]) -> int | None:
        return self.solver.order(terms)

    def strong_order(self, terms: PyTree[dfx.AbstractTerm]) -> RealScalarLike | None:
        return self.solver.strong_order(terms)

    def func(self, terms: dfx.AbstractTerm, t0: RealScalarLike, y0: Y, args: Args) -> VF:
        return terms.vf(t0, y0, args)

    def init(
        self, terms: dfx.AbstractTerm, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args
    ) -> None:
        del terms, t0, t1, y0, args

    def step(
        self,
        terms: dfx.AbstractTerm,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: None,
        made_jump: BoolScalarLike,
    ) -> tuple[Y, Y, DenseInfo, None, dfx.RESULTS]:
        # In a method with the property "first same as last" the last slope of a step is the first
        # of the next. Keeping it would save nothing: a projected state has another slope, and in a
        # batch both the kept and a new slope are computed before one is chosen.
        del solver_state, made_jump
        tableau = self.solver.tableau
        control = terms.contr(t0, t1)

        increments, y = [terms.vf_prod(t0, y0, args, control)], y0
        for fraction, row in zip(tableau.c, tableau.a_lower, strict=True):
            y = _displaced(y0, row, increments)
            time = t0 + float(fraction) * (t1 - t0)
            increments.append(terms.vf_prod(time, y, args, control))
        # In a method with the property "solution same as last" the last stage is at the solution.
        y1 = y if tableau.ssal else _displaced(y0, tableau.b_sol, increments)
        error = _combined(tableau.b_error, increments)
        k = jtu.tree_map(lambda *leaves: jnp.stack(leaves), *increments)
        return y1, error, dict(y0=y0, y1=y1, k=k), None, dfx.RESULTS.successful


Unrolled.__init__.__doc__ = """**Arguments:**

- `solver`: an explicit Runge-Kutta method with one Butcher tableau, such as `diffrax.Tsit5()` or
    your own. Only its tableau is used, no other options.

**Raises:**

`TypeError` if `solver` is not such a method.
"""


def _combined(weights: np.ndarray, increments: list[Y]) -> Y:
    """The weighted sum of the increments, without those whose weight is zero."""
    used = [(float(w), k) for w, k in zip(weights, increments, strict=False) if w != 0]
    total = lambda *ks: sum(w * k for (w, _), k in zip(used, ks, strict=True))  # noqa: E731
    return jtu.tree_map(total, *(k for _, k in used))


def _displaced(y: Y, weights: np.ndarray, increments: list[Y]) -> Y:
    return jtu.tree_map(jnp.add, y, _combined(weights, increments))
