"""The classical fourth-order Runge-Kutta method, written out."""

from typing import ClassVar, final

import diffrax as dfx
import jax.tree_util as jtu

from .._custom_types import VF, Args, BoolScalarLike, DenseInfo, RealScalarLike, Y
from .._fast.scalars import written_out

# The method averages the slopes with the weights 1, 2, 2, 1, of which this is the sum.
_WEIGHTS = 1 + 2 + 2 + 1


@final
class RK4(dfx.AbstractSolver[None]):
    r"""The classical fourth-order Runge-Kutta method, for fixed steps.

    With $k_1 = f(t, y)$, $k_2 = f(t + h/2, y + h k_1/2)$, $k_3 = f(t + h/2, y + h k_2/2)$ and
    $k_4 = f(t + h, y + h k_3)$,

    $$y_{n+1} = y_n + \tfrac{h}{6} (k_1 + 2 k_2 + 2 k_3 + k_4).$$

    It has no error estimate: for adaptive steps use it inside `diffrax.HalfSolver`. Dense output is
    the cubic Hermite polynomial through both ends, of fourth order too.

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

    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar = dfx.ThirdOrderHermitePolynomialInterpolation

    def order(self, terms: dfx.AbstractTerm) -> int:
        del terms
        return 4

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
    ) -> tuple[Y, None, DenseInfo, None, dfx.RESULTS]:
        del solver_state, made_jump
        middle = t0 + (t1 - t0) / 2
        control = terms.contr(t0, t1)

        # As in diffrax, a stage is the increment `h f` over the whole step.
        def stage(t: RealScalarLike, y: Y) -> Y:
            return terms.vf_prod(t, y, args, control)

        def moved(y: Y, part: float, k: Y) -> Y:
            return jtu.tree_map(lambda a, b: a + part * b, y, k)

        def end(y0: Y) -> Y:
            k1 = stage(t0, y0)
            k2 = stage(middle, moved(y0, 0.5, k1))
            k3 = stage(middle, moved(y0, 0.5, k2))
            k4 = stage(t1, moved(y0, 1.0, k3))
            return jtu.tree_map(
                lambda y, a, b, c, d: y + (a + 2 * (b + c) + d) / _WEIGHTS, y0, k1, k2, k3, k4
            )

        y1 = written_out(end, y0)
        dense_info = dict(y0=y0, y1=y1, k0=stage(t0, y0), k1=stage(t1, y1))
        return y1, None, dense_info, None, dfx.RESULTS.successful

    def func(self, terms: dfx.AbstractTerm, t0: RealScalarLike, y0: Y, args: Args) -> VF:
        return terms.vf(t0, y0, args)


RK4.__init__.__doc__ = """**Arguments:** None"""
