"""Random features, fitted anew in each step: a network that needs no training before the solve."""

from collections.abc import Callable
from typing import ClassVar, final

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._custom_types import VF, Args, BoolScalarLike, DenseInfo, RealScalarLike, Y
from .._projection import check_state
from ._chebyshev import ChebyshevInterpolation
from ._failure import unsolved
from ._feature_basis import feature_basis
from ._galerkin import StepEquations, dense_series, end_error, flatten, solve
from ._terms import check_ode


@final
class RandomFeatureSolver(dfx.AbstractSolver[None]):
    features: int = eqx.field(static=True)
    seed: int = eqx.field(static=True)

    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., ChebyshevInterpolation]] = ChebyshevInterpolation

    def __init__(self, features: int = 12, *, seed: int = 0):
        self.features = features
        self.seed = seed

    def order(self, terms: dfx.AbstractTerm) -> int:
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
        check_state(y0)

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
        vector, unflatten = flatten(y0)
        control = terms.contr(t0, t1)

        def increment(fraction: Array, state: Array) -> Array:
            t = t0 + (t1 - t0) * fraction
            return flatten(terms.vf_prod(t, unflatten(state), args, control))[0]

        equations = StepEquations(feature_basis(self.features, self.seed), increment, vector)
        coefficients, found = solve(equations)
        error = jnp.abs(end_error(equations, coefficients))
        error = jnp.where(found & jnp.isfinite(error), error, jnp.inf)
        dense_info = dict(coefficients=jax.vmap(unflatten)(dense_series(equations, coefficients)))
        y1 = unflatten(vector + coefficients[0])
        return y1, unflatten(error), dense_info, None, unsolved(found)

    def func(self, terms: dfx.AbstractTerm, t0: RealScalarLike, y0: Y, args: Args) -> VF:
        return terms.vf(t0, y0, args)
