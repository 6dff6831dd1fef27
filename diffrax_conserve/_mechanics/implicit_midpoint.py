"""The implicit midpoint rule, the symmetric one-step method that diffrax lacks."""

from typing import Any, ClassVar, final

import diffrax as dfx
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jaxtyping import Array, Float

from .._constants import MAX_STEPS, TOLERANCE_IN_EPS
from .._custom_types import VF, Args, BoolScalarLike, DenseInfo, RealScalarLike, Y
from .._hashable import Hashable
from .._numerics.implicit import root
from .._numerics.iterate import Solved
from .._options import check_counts
from .._projection.options import option, refuse_half_precision
from .._tree import eps_of, ravel, tree_stop_gradient, unravel


@final
class ImplicitMidpoint(Hashable, dfx.AbstractSolver[None]):
    r"""The implicit midpoint rule, for fixed steps.

    $$y_{n+1} = y_n + h f(t_n + \tfrac{h}{2}, \tfrac{1}{2} (y_n + y_{n+1}))$$

    is of second order, symmetric (a step backwards undoes a step) and symplectic, and it keeps
    every quadratic first integral. The equation is solved to 16 units of roundoff of
    $|y_n| + |h f|$, by a chord iteration whose Jacobian is that at the start of the step.

    It has no error estimate, because a step size that follows the error is not symmetric. Dense
    output is the cubic Hermite polynomial through both ends.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        term = diffrax.ODETerm(lambda t, y, args: jnp.array([y[1], -jnp.sin(y[0])]))
        y0 = jnp.array([1.0, 0.0])
        there = diffrax.diffeqsolve(term, dfc.ImplicitMidpoint(), 0.0, 10.0, 0.1, y0).ys[-1]
        back = diffrax.diffeqsolve(term, dfc.ImplicitMidpoint(), 10.0, 0.0, -0.1, there).ys[-1]
        assert jnp.max(jnp.abs(back - y0)) < 1e-4  # float32
        ```

    ??? cite "Reference"

        Hairer, Lubich and Wanner, *Geometric Numerical Integration*, Springer 2006, II.1 and V.2.
    """

    root_find_max_steps: int = option(MAX_STEPS, static=True)

    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar = dfx.ThirdOrderHermitePolynomialInterpolation

    def __check_init__(self):
        check_counts(root_find_max_steps=self.root_find_max_steps)

    def order(self, terms: dfx.AbstractTerm) -> int:
        del terms
        return 2

    def init(
        self, terms: dfx.AbstractTerm, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args
    ) -> None:
        del terms, t0, t1, args
        refuse_half_precision("`ImplicitMidpoint`", y0)

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
        middle, control = t0 + (t1 - t0) / 2, terms.contr(t0, t1)
        k0 = terms.vf_prod(t0, y0, args, control)
        # The unknown is the increment `h f`, in units of what is rounded when it is added to the
        # state. So tolerances mean the same whatever the units of the state are.
        slope = lambda y: terms.vf_prod(middle, y, args, control)  # noqa: E731
        units = tree_stop_gradient(jtu.tree_map(_size, y0, k0))

        def increment(x: Float[Array, " n"]) -> Y:
            return jtu.tree_map(lambda x, unit: x * unit, unravel(x, y0), units)

        def relation(x: Float[Array, " n"], _: Any = None) -> Float[Array, " n"]:
            k = increment(x)
            y = jtu.tree_map(lambda y, k: y + k / 2, y0, k)
            new = slope(y)
            return ravel(jtu.tree_map(lambda k, new, unit: (k - new) / unit, k, new, units))

        guess = ravel(jtu.tree_map(lambda k, unit: k / unit, k0, units))
        eps = eps_of(guess)
        finder = optx.Chord(rtol=0.0, atol=TOLERANCE_IN_EPS * eps, norm=optx.max_norm)

        def newton(guess: Float[Array, " n"]) -> Solved:
            solution = optx.root_find(
                relation, finder, guess, max_steps=self.root_find_max_steps, throw=False
            )
            ok = solution.result == optx.RESULTS.successful
            return Solved(solution.value, ok, solution.stats["num_steps"], solution.result)

        # The derivative is not that of `root_find`: its linear solver refuses NaN, so that one lane
        # of a batch that has failed would be an error of all.
        solved = root(relation, newton, guess, jnp.linalg.solve)
        y1 = jtu.tree_map(lambda y, k: y + k, y0, increment(solved.y))
        k1 = terms.vf_prod(t1, y1, args, control)
        result = dfx.RESULTS.promote(solved.aux)
        return y1, None, dict(y0=y0, y1=y1, k0=k0, k1=k1), None, result

    def func(self, terms: dfx.AbstractTerm, t0: RealScalarLike, y0: Y, args: Args) -> VF:
        return terms.vf(t0, y0, args)


ImplicitMidpoint.__init__.__doc__ = """**Arguments:**

- `root_find_max_steps`: the largest number of iterations. If they are not enough, the solve ends,
    and its `result` says so.
"""


def _size(*terms: Any) -> Any:
    """The size of each component, the sum of those of the terms. One that is zero counts as large
    as the largest, and if all are zero, as one."""
    size = sum(map(jnp.abs, terms))
    size = jnp.where(size > 0, size, jnp.max(size, initial=0))
    return jnp.where(size > 0, size, jnp.ones_like(size))
