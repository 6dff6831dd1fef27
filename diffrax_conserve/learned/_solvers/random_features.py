"""Random features, fitted in each step: a network that needs no training before the solve.

With the basis `q_k` of slopes, `s` the fraction of the step and `u(s) = u0 + Σ_k d_k ∫_0^s q_k`,
the `d_k` solve `d = P h f(t, u0 + Q d)`, where `Q` integrates, and `P` fits values at the Gauss
points. Newton's method is written here because its matrix is put together from the Jacobians of `f`
at the points, where a library would differentiate the residual once for each coefficient.
"""

import functools as ft
from collections.abc import Callable
from typing import ClassVar, NamedTuple, final

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from ..._custom_types import VF, Args, BoolScalarLike, DenseInfo, RealScalarLike, Y
from ..._hashable import Hashable
from ..._numerics.implicit import root
from ..._numerics.iterate import Solved, iterate, remaining_after_step
from ..._numerics.lanes import where_active
from ..._numerics.linear import computed_after
from ..._projection.options import check_state, refuse_half_precision
from ..._solver.diffrax_private import register, result_at
from ..._solver.terms import is_ode
from .collocation import ChebyshevInterpolation, increment, multiply
from .feature_basis import FeatureBasis, feature_basis

# With fewer features none is random; with more they cannot be distinguished in double precision.
_FEWEST, _MOST = 3, 32
_UNSOLVED = register(
    "the equations of a step of `RandomFeatureSolver` were not solved. Newton's method diverged, "
    "or the vector field is not finite near the step. Take smaller steps: a smaller `dt0`, or a "
    "smaller `dtmin` of `diffrax.PIDController`."
)


@final
class RandomFeatureSolver(Hashable, dfx.AbstractSolver[None]):
    r"""Fits a network with random hidden neurons to the equations of each step.

    This is a physics-informed network that is trained to roundoff inside the solve. In the step
    from $t_0$ to $t_0 + h$, with $s$ the fraction of the step,

    $$u(s) = u_0 + h s \Bigl(b + w s + \sum_j c_j \tanh(a_j (s - s_j))\Bigr),$$

    with random fixed $a_j$ and $s_j$. The `features` leading directions of the span of this linear
    network are kept; the others depend on them in double precision. Newton's method solves
    $u' = P f(t, u)$, where $P$ is the least-squares fit by slopes of the network, at twice as many
    Gauss points.

    The solver is fast for high accuracy or stiff systems of few unknowns. The error over a period
    of an oscillator with 16 features is 1e-12. The error estimate, which fixed steps do not
    compute, is the remaining defect, propagated to the end of the step by the linearised equation,
    and what the Gauss rule does not resolve where the vector field jumps, has a kink or is steep:
    the last two Legendre coefficients of the slopes, and how far their polynomial is from the
    slopes at both ends of the step.

    As a continuous Galerkin method the solver conserves the energy of every canonical Hamiltonian
    system, $y' = J \nabla H(y)$, to the accuracy of the Gauss rule, which soon reaches roundoff.
    Very stiff components are not damped; there steps become short.

    If Newton's method fails, an adaptive solve tries a shorter step, and a solve with fixed steps
    fails. Dense output is the network. Derivatives of any order are those of the solved equations.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc

        system = dfc.systems.get("harmonic-oscillator")
        term = diffrax.ODETerm(system.vector_field)
        solver = dfc.RandomFeatureSolver()
        solution = diffrax.diffeqsolve(term, solver, 0.0, 30.0, 3.0, system.y0)
        ```

    ??? cite "Reference"

        S. Dong and Z. Li, "Local extreme learning machines and domain decomposition for solving
        linear and nonlinear partial differential equations", Comput. Methods Appl. Mech. Eng. 387
        (2021). Energy: L. Brugnano, F. Iavernaro and D. Trigiante, "Hamiltonian boundary value
        methods", J. Numer. Anal. Ind. Appl. Math. 5 (2010), for polynomials.
    """

    features: int = eqx.field(default=16, static=True)

    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., ChebyshevInterpolation]] = ChebyshevInterpolation

    def __check_init__(self):
        if not (isinstance(self.features, int) and _FEWEST <= self.features <= _MOST):
            raise ValueError(
                f"`features` must be an integer from {_FEWEST} to {_MOST}, not {self.features!r}."
            )

    def order(self, terms: dfx.AbstractTerm) -> int:
        del terms
        # That of the method with polynomials, which gives good step sizes well above roundoff.
        return 2 * self.features

    def init(
        self, terms: dfx.AbstractTerm, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args
    ) -> None:
        del t0, t1, args
        if not is_ode(terms):
            raise TypeError(
                "`RandomFeatureSolver` solves ordinary differential equations: pass a "
                "`diffrax.ODETerm`, or for a stochastic equation another solver: `diffrax.Heun()`."
            )
        check_state(y0, "`RandomFeatureSolver`")
        refuse_half_precision("`RandomFeatureSolver`", y0)

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
        del solver_state, made_jump
        start, unravel = ravel_pytree(y0)
        basis = feature_basis(self.features)
        equations = StepEquations(basis, increment(terms, t0, t1, y0, args), start)
        coefficients, found = solve(equations)
        errors, unresolved = _error(equations, coefficients)
        series = _dense_series(equations, coefficients, errors)
        # Only the first row changes the end of the step: the other members have a mean of zero.
        y1, known = unravel(start + coefficients[0]), found & jnp.all(jnp.isfinite(errors[0]))
        error = unravel(jnp.where(known, jnp.abs(errors[0]) + unresolved, jnp.inf))
        result = dfx.RESULTS.where(found, dfx.RESULTS.successful, result_at(_UNSOLVED))
        return y1, error, dict(coefficients=jax.vmap(unravel)(series)), None, result

    def func(self, terms: dfx.AbstractTerm, t0: RealScalarLike, y0: Y, args: Args) -> VF:
        return terms.vf(t0, y0, args)


RandomFeatureSolver.__init__.__doc__ = r"""**Arguments:**

- `features`: the number of directions for each component of the state, from 3 to 32. More allow
    longer steps, but a step solves dense linear systems of `features` times as many unknowns.

**Raises:**

`ValueError` if `features` is invalid; in a solve `TypeError` if a term is no `diffrax.ODETerm` or
the state is not real.
"""


# ---- The equations of a step ----

Coefficients = Float[Array, "members n"]
# If Newton's method has not converged by then, a shorter step is cheaper.
_MAX_STEPS = 10


class StepEquations(NamedTuple):
    """`d = P h f(t, u0 + Q d)` for one step, with the state as a vector."""

    basis: FeatureBasis
    increment: Callable[[Array, Array], Array]  # (s, u) -> h f(t0 + s h, u)
    y0: Float[Array, " n"]

    def states(self, coefficients: Coefficients) -> Float[Array, "points n"]:
        """`u` at the Gauss points; there are also `h f`, `slopes`, and `h ∂f/∂u`, `jacobians`."""
        return self.y0 + multiply(self.basis.integrals[:, : len(coefficients)], coefficients)

    def slopes(self, states: Float[Array, "points n"]) -> Float[Array, "points n"]:
        """Of two more states too, which are those at both ends of the step."""
        return jax.vmap(self.increment)(self._fractions(len(states)), states)

    def jacobians(self, states: Float[Array, "points n"]) -> Float[Array, "points n n"]:
        return jax.vmap(jax.jacfwd(self.increment, argnums=1))(self._fractions(len(states)), states)

    def residual(self, coefficients: Coefficients) -> Coefficients:
        fit = self.basis.fit[: len(coefficients)]
        return coefficients - multiply(fit, self.slopes(self.states(coefficients)))

    def solve_linear(
        self, jacobians: Float[Array, "points n n"], right: Coefficients
    ) -> Coefficients:
        """`(1 - P h ∂f/∂u Q)⁻¹` applied to `right`, which has one row for each member in use."""
        count, n = right.shape
        fit, integrals = self.basis.fit[:count], self.basis.integrals[:, :count]
        products = multiply(
            (fit[:, None, :] * integrals.T[None]).reshape(count * count, -1),
            jacobians.reshape(-1, n * n),
        )
        coupling = products.reshape(count, count, n, n).swapaxes(1, 2).reshape(count * n, count * n)
        matrix = jnp.eye(count * n, dtype=right.dtype) - coupling
        return jnp.linalg.solve(matrix, right.ravel()).reshape(count, n)

    def _fractions(self, count: int) -> Float[Array, " points"]:
        return jnp.asarray(self.basis.fractions[:count], self.y0.dtype)


def solve(equations: StepEquations) -> tuple[Coefficients, Bool[Array, ""]]:
    """The coefficients, differentiated by the implicit function theorem, and whether Newton's
    method converged. If not, they are zero: the state is then constant, where the vector field is
    finite, so that derivatives of a rejected step are finite."""
    slope = equations.increment(jnp.zeros((), equations.y0.dtype), equations.y0)
    rest = jnp.zeros((equations.basis.size - 1, slope.size), slope.dtype)
    start = jnp.concatenate([slope[None], rest])

    found = root(
        equations.residual,
        ft.partial(_newton, equations),
        start,
        lambda a, b: jnp.linalg.solve(a, b),
    )
    return found.y, found.ok


def _newton(equations: StepEquations, start: Coefficients) -> Solved:
    tolerance = jnp.finfo(start.dtype).eps ** (2 / 3)

    def advance(coefficients: Array, tests_left: Array) -> tuple[Array, Array]:
        states, residual = equations.states(coefficients), equations.residual(coefficients)
        change = equations.solve_linear(equations.jacobians(states), residual)
        size = jnp.max(jnp.abs(equations.states(change) - equations.y0))
        converged = size <= tolerance * jnp.max(jnp.abs(states))
        then = remaining_after_step(converged, jnp.isfinite(size), tests_left)
        return where_active(tests_left, coefficients - change, coefficients), then

    found = iterate(advance, start, max_steps=_MAX_STEPS)
    return found._replace(y=jnp.where(found.ok, found.y, 0))


def _error(
    equations: StepEquations, coefficients: Coefficients
) -> tuple[Float[Array, "wide n"], Float[Array, " n"]]:
    """The error of the solution over the step, in the wider basis: it solves
    `e' = h ∂f/∂u e + h f - u'` at the same points. The error of the Gauss rule is not seen at its
    points: `unresolved` is about as large."""
    states = equations.states(coefficients)
    slopes = multiply(equations.basis.slopes[:, : len(coefficients)], coefficients)
    ends = jnp.stack([equations.y0, equations.y0 + coefficients[0]])
    everywhere = equations.slopes(jnp.concatenate([states, ends]))
    right = multiply(equations.basis.fit, everywhere[:-2] - slopes)
    unresolved = jnp.sum(jnp.abs(multiply(equations.basis.unresolved, everywhere)), axis=0)
    # Those of linear equations do not depend on the states.
    jacobians = computed_after(equations.jacobians(states), coefficients)
    return equations.solve_linear(jacobians, right), unresolved


def _dense_series(
    equations: StepEquations, coefficients: Coefficients, error: Float[Array, "wide n"]
) -> Float[Array, "degrees n"]:
    """`u` over the step, as a Chebyshev series in `2 s - 1`."""
    # Inside a step a Galerkin method is far less accurate: there the estimated error is added.
    inside = error.at[0].set(0).at[: len(coefficients)].add(coefficients)
    return multiply(equations.basis.series, inside).at[0].add(equations.y0)
