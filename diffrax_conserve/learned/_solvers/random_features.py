"""Random features, fitted anew in each step: a network that needs no training before the solve."""

from collections.abc import Callable
from typing import ClassVar, final

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..._custom_types import VF, Args, BoolScalarLike, DenseInfo, RealScalarLike, Y
from ..._projection import check_state
from ..._solver.diffrax_private import member, register
from ..._solver.terms import check_ode
from .chebyshev import ChebyshevInterpolation
from .feature_basis import feature_basis
from .galerkin import StepEquations, dense_series, error, flatten, solve

# With fewer there is no random one, with more they are not told apart in double precision.
_FEWEST, _MOST = 3, 32


_UNSOLVED = register(
    "the equations of a step of `RandomFeatureSolver` were not solved. Newton's method diverged, "
    "or the vector field is not finite near the step. Take smaller steps: a smaller `dt0`, or with "
    "`diffrax.PIDController`, which tries them by itself, a smaller `dtmin`."
)


@final
class RandomFeatureSolver(dfx.AbstractSolver[None]):
    r"""Fits a network with random hidden neurons to the equations of each step.

    A physics-informed network that is trained inside the solve, and to roundoff. In the step from
    $t_0$ to $t_0 + h$, with $s$ the fraction of the step,

    $$u(s) = u_0 + h s \Bigl(b + w s + \sum_j c_j \tanh(a_j (s - s_j))\Bigr),$$

    where the $a_j$ and $s_j$ are random, and drawn once: the network is linear in what is fitted.
    Of its span the `features` leading directions are kept; the rest cannot be told from them in
    double precision. Their coefficients minimise the squared defect $u' - f(t, u)$ at twice as many
    Gauss points, over the slopes that the network can follow: Newton's method solves

    $$u' = P f(t, u), \qquad P \text{ the least-squares fit by slopes of the network.}$$

    **Accuracy.** A step can be long: 16 features follow half a turn of an oscillator to 2e-14, a
    whole one to 1e-12 and two to 1e-9. Where accuracy counts, or the system is stiff, this solver
    is fast; where neither does and $f$ is cheap, an explicit method is faster. See "Learned
    solvers" for figures. Each step solves a few dense linear systems of `features` times the size
    of the state, so the state should be small.

    **Error estimate.** The defect that the fit leaves, carried to the end of the step by the
    linearised equation. It is the true error of the step to within some per cent, down to roundoff,
    so adaptive steps ([`diffrax.PIDController`][]) meet their tolerances. With fixed steps it is
    not computed.

    **Conservation.** As a least-squares fit of slopes (a continuous Galerkin method) the solver
    keeps, for any features, the energy of every canonical Hamiltonian system, $y' = J \nabla H(y)$,
    to the accuracy of the Gauss rule, which is soon that of roundoff, also where the error in the
    state is large. Linear equations stay bounded where their exact solution does (to 1e-6 a step).
    Very stiff components are not damped; near such transients steps get short. Other integrals are
    kept inside [`diffrax_conserve.ManifoldProjection`][].

    If Newton's method fails, an adaptive solve tries a shorter step, and one with fixed steps says
    that it failed. Dense output is the network. Derivatives, forward and reverse and of any order,
    are those of the solved equations.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc

        system = dfc.systems.get("harmonic-oscillator")
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(system.vector_field),
            dfc.RandomFeatureSolver(),
            t0=0.0,
            t1=30.0,
            dt0=3.0,
            y0=system.y0,
            args=system.args,
        )
        ```

    ??? cite "Reference"

        S. Dong and Z. Li, "Local extreme learning machines and domain decomposition for solving
        linear and nonlinear partial differential equations", Comput. Methods Appl. Mech. Eng. 387
        (2021). Energy: L. Brugnano, F. Iavernaro and D. Trigiante, "Hamiltonian boundary value
        methods", J. Numer. Anal. Ind. Appl. Math. 5 (2010), for polynomials.
    """

    features: int = eqx.field(static=True)
    seed: int = eqx.field(static=True)

    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., ChebyshevInterpolation]] = ChebyshevInterpolation

    def __init__(self, features: int = 16, *, seed: int = 0):
        self.features = features
        self.seed = seed

    def __check_init__(self):
        if not (isinstance(self.features, int) and _FEWEST <= self.features <= _MOST):
            raise ValueError(
                f"`features` must be an integer from {_FEWEST} to {_MOST}, but is "
                f"{self.features!r}."
            )
        if not (isinstance(self.seed, int) and self.seed >= 0):
            raise ValueError(
                f"`seed` must be an integer of at least 0, which numpy draws the features from, "
                f"but is {self.seed!r}."
            )

    def order(self, terms: dfx.AbstractTerm) -> int:
        """That of polynomials in the place of the features. Between a large error and roundoff it
        is a good guide for step sizes; there is no power of `h` that the error follows."""
        del terms
        return 2 * self.features

    def init(
        self,
        terms: dfx.AbstractTerm,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
    ) -> None:
        del t0, t1, args
        check_ode(terms, "RandomFeatureSolver")
        check_state(y0, "`RandomFeatureSolver`")

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
        start, unflatten = flatten(y0)
        t0, control = jnp.asarray(t0), terms.contr(t0, t1)

        def increment(fraction: Array, state: Array) -> Array:
            t = t0 + (t1 - t0) * fraction.astype(t0.dtype)
            slope, _ = flatten(terms.vf_prod(t, unflatten(state), args, control))
            return slope.astype(state.dtype)

        equations = StepEquations(feature_basis(self.features, self.seed), increment, start)
        coefficients, found = solve(equations)
        errors = error(equations, coefficients)
        series = dense_series(equations, coefficients, errors)
        # The mean slope counts: the other members have a mean of zero.
        known = found & jnp.all(jnp.isfinite(errors[0]))
        return (
            unflatten(start + coefficients[0]),
            unflatten(jnp.where(known, jnp.abs(errors[0]), jnp.inf)),
            dict(coefficients=jax.vmap(unflatten)(series)),
            None,
            dfx.RESULTS.where(found, dfx.RESULTS.successful, member(_UNSOLVED)),
        )

    def func(self, terms: dfx.AbstractTerm, t0: RealScalarLike, y0: Y, args: Args) -> VF:
        return terms.vf(t0, y0, args)


RandomFeatureSolver.__init__.__doc__ = r"""**Arguments:**

- `features`: how many directions are fitted for each component of the state, from 3 to 32. More
    allow longer steps and smaller errors, and linear systems of more unknowns: of a state of size
    $n$, `features` $\cdot n$. In steps of 2 over 30 time units of an oscillator, 8, 12 and 16
    leave errors of 6e-10, 6e-12 and 1e-13.
- `seed`: of the random neurons. Results for two seeds differ by less than the tolerance of a
    solve; compare two to see it.

**Raises:**

`ValueError` if an argument is none of these; `TypeError`, when the solve is traced, if the terms
are not `diffrax.ODETerm`s or the state is not real.
"""
