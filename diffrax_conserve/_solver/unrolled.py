"""Explicit Runge-Kutta methods with their stages written out."""

import abc
import functools as ft
import operator as op
from typing import Any, ClassVar, final

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from .._custom_types import VF, Args, BoolScalarLike, DenseInfo, RealScalarLike, Y
from .._fast.scalars import scalarised_result

_HERMITE = dfx.ThirdOrderHermitePolynomialInterpolation


class _Explicit(dfx.AbstractSolver[None]):
    """A method with an explicit Butcher tableau. A tableau whose `b_error` is zero has no error
    estimate. Dense output is that of a diffrax solver, or the cubic Hermite polynomial."""

    term_structure: ClassVar = dfx.AbstractTerm

    @property
    @abc.abstractmethod
    def tableau(self) -> dfx.ButcherTableau: ...

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
    ) -> tuple[Y, Y | None, DenseInfo, None, dfx.RESULTS]:
        # In a method with the property "first same as last" the last slope of a step is the first
        # of the next. Keeping it would save nothing: a projected state has another slope, and in a
        # batch both the kept and a new slope are computed before one is chosen.
        del solver_state, made_jump
        tableau, control = self.tableau, terms.contr(t0, t1)

        # As in diffrax, a stage is the increment `h f` over the whole step.
        def stage(fraction: float, y: Y) -> Y:
            t = t1 if fraction == 1 else t0 + fraction * (t1 - t0)
            return terms.vf_prod(t, y, args, control)

        def advanced(y0: Y) -> tuple[Y, Y | None, list[Y]]:
            """The next state, the error estimate and the stages."""
            stages, y = [stage(0.0, y0)], y0
            for fraction, row in zip(tableau.c, tableau.a_lower, strict=True):
                y = _displaced(y0, row, stages)
                stages.append(stage(float(fraction), y))
            # In a method with the property "solution same as last" the last stage is there.
            y1 = y if tableau.ssal else _displaced(y0, tableau.b_sol, stages)
            error = _combined(tableau.b_error, stages) if np.any(tableau.b_error) else None
            return y1, error, stages

        if self.interpolation_cls is not _HERMITE:
            y1, error, stages = advanced(y0)
            k = jtu.tree_map(lambda *leaves: jnp.stack(leaves), *stages)
            return y1, error, dict(y0=y0, y1=y1, k=k), None, dfx.RESULTS.successful
        # In scalars XLA computes a stage again for each element of a stage that uses it. So that is
        # faster only where each stage follows from the one before alone (`benchmarks/README.md`).
        chain = all(np.count_nonzero(row[:-1]) == 0 for row in tableau.a_lower)
        ends = lambda y0: advanced(y0)[:2]  # noqa: E731
        y1, error = scalarised_result(ends, y0) if chain else ends(y0)
        dense_info = dict(y0=y0, y1=y1, k0=stage(0.0, y0), k1=stage(1.0, y1))
        return y1, error, dense_info, None, dfx.RESULTS.successful


@final
class RK4(_Explicit):
    r"""The classical fourth-order Runge-Kutta method, for fixed steps.

    With $k_1 = f(t, y)$, $k_2 = f(t + h/2, y + h k_1/2)$, $k_3 = f(t + h/2, y + h k_2/2)$ and
    $k_4 = f(t + h, y + h k_3)$,

    $$y_{n+1} = y_n + \tfrac{h}{6} (k_1 + 2 k_2 + 2 k_3 + k_4).$$

    It has no error estimate: for adaptive steps use it inside `diffrax.HalfSolver`. Dense output is
    the cubic Hermite polynomial through both ends, of fourth order too. Its stages are written out,
    as in [`diffrax_conserve.Unrolled`][].

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc

        term = diffrax.ODETerm(lambda t, y, args: -y)
        solution = diffrax.diffeqsolve(term, dfc.RK4(), t0=0.0, t1=1.0, dt0=0.1, y0=1.0)
        ```

    ??? cite "Reference"

        W. Kutta, "Beitrag zur näherungsweisen Integration totaler Differentialgleichungen",
        *Zeitschrift für Mathematik und Physik* 46 (1901), 435-453.
    """

    interpolation_cls: ClassVar = _HERMITE
    tableau: ClassVar = dfx.ButcherTableau(  # pyright: ignore
        a_lower=(np.array([1 / 2]), np.array([0, 1 / 2]), np.array([0, 0, 1])),
        b_sol=np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6]),
        b_error=np.zeros(4),
        c=np.array([1 / 2, 1 / 2, 1]),
    )

    def order(self, terms: dfx.AbstractTerm) -> int:
        del terms
        return 4


RK4.__init__.__doc__ = """**Arguments:** None"""


@final
class Unrolled(_Explicit, dfx.AbstractAdaptiveSolver[None]):
    r"""An explicit Runge-Kutta method with its stages written out.

    diffrax keeps the stages $k_i = f(t + c_i h, y + h \sum_j a_{ij} k_j)$ of a step in one array,
    so that in a batch every stage goes through memory. Written out, the whole step is one
    expression, which XLA keeps in registers: with the same steps, error estimate and dense output,
    up to the order of summation, a batch of small systems is about ten times as fast. Compile time
    grows with the number of stages times the size of the vector field. A large system or a single
    long solve gains nothing.

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

    solver: Any  # an `AbstractERK`, or a tableau as a solver

    def __init__(self, solver: dfx.AbstractERK | dfx.ButcherTableau | RK4):
        tableau = getattr(solver, "tableau", solver)
        if not isinstance(tableau, dfx.ButcherTableau) or tableau.implicit:
            raise TypeError(
                f"`solver` of `Unrolled` is {solver!r}, which is neither an explicit Runge-Kutta "
                "method with one Butcher tableau nor such a tableau. Pass an instance, and wrap "
                "the result: `ManifoldProjection(Unrolled(diffrax.Tsit5()), manifold)`."
            )
        self.solver = solver
        if tableau is solver:
            rows = tableau.c, tableau.b_sol, tableau.b_error, *tableau.a_lower
            self.solver = _OfTableau(tuple(tuple(map(float, row)) for row in rows))

    @property
    def tableau(self) -> dfx.ButcherTableau:
        return self.solver.tableau

    @property
    def interpolation_cls(self) -> Any:  # pyright: ignore
        return self.solver.interpolation_cls

    def order(self, terms: PyTree[dfx.AbstractTerm]) -> int | None:
        return self.solver.order(terms)

    def strong_order(self, terms: PyTree[dfx.AbstractTerm]) -> RealScalarLike | None:
        return self.solver.strong_order(terms)


Unrolled.__init__.__doc__ = """**Arguments:**

- `solver`: an explicit Runge-Kutta method with one Butcher tableau, such as `diffrax.Tsit5()` or
    your own, of which no other options are used; or the tableau alone, an explicit
    `diffrax.ButcherTableau`. Of this the order is not known: adaptive steps need
    `diffrax.PIDController(..., error_order=...)`. If its `b_error` is zero, it has no error
    estimate. Dense output is the cubic Hermite polynomial through both ends.

**Raises:**

`TypeError` if `solver` is neither.
"""


@final
class _OfTableau(_Explicit):
    """A tableau as a solver. JAX compares solvers, and it can compare tuples, but no arrays."""

    numbers: tuple[Any, ...] = eqx.field(static=True)
    interpolation_cls: ClassVar = _HERMITE

    @property
    def tableau(self) -> dfx.ButcherTableau:
        c, b_sol, b_error, *a_lower = map(np.asarray, self.numbers)
        return dfx.ButcherTableau(c, b_sol, b_error, tuple(a_lower))


def _combined(weights: np.ndarray, stages: list[Y]) -> Y:
    """The weighted sum of the stages. Those of equal weight are added first: with fewer products a
    step of RK4 takes 34 ns instead of 43."""
    unlike = [float(w) for w in dict.fromkeys(weights[: len(stages)]) if w != 0]

    def total(*ks: Any) -> Any:  # `sum` would begin with zero, which XLA adds too
        alike = lambda w: (k for v, k in zip(weights, ks, strict=False) if v == w)  # noqa: E731
        return ft.reduce(op.add, (w * ft.reduce(op.add, alike(w)) for w in unlike))

    return jtu.tree_map(total, *stages)


def _displaced(y: Y, weights: np.ndarray, stages: list[Y]) -> Y:
    return jtu.tree_map(jnp.add, y, _combined(weights, stages))
