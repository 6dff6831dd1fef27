"""Stiff chemistry: the problems of Robertson and of Verwer."""

import abc
from typing import final

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

from .._custom_types import Args, RealScalarLike
from .._manifold import Constraint, FirstIntegral
from ._base import AbstractIntegratedSystem, Curves, real
from ._mechanism import Mechanism

State = Float[Array, " species"]


class AbstractChemistry(AbstractIntegratedSystem):
    """Reactions with mass-action kinetics, and a reference solution for stiff equations."""

    solver = dfx.Kvaerno5()
    tolerances = (1e-8, 1e-20)

    @property
    @abc.abstractmethod
    def mechanism(self) -> Mechanism:
        """The reactions and their rates."""

    def vector_field(self, t: RealScalarLike, y: State, args: Args) -> State:
        return self.mechanism.vector_field(t, y, args)

    @property
    def manifold(self) -> dict[str, FirstIntegral | Constraint]:
        return dict(self.mechanism.manifold)

    def sample(self, key: PRNGKeyArray) -> State:
        factors = jnp.exp(jr.uniform(key, self.y0.shape, self.y0.dtype, -1, 1) * jnp.log(2.0))
        return self.y0 * factors

    def trajectories(self, ys: Float[Array, "times species"]) -> Curves:
        """The concentrations of the two species that `axes` names."""
        places = [self.mechanism.species.index(name) for name in self.axes]
        return {"concentrations": ys[:, jnp.array(places)]}


@final
class Robertson(AbstractChemistry):
    r"""Robertson's autocatalytic reaction, `y = [A, B, C]` of shape `(3,)`.

    $$A \to B, \qquad 2B \to B + C, \qquad B + C \to A + C$$

    with rates of 0.04, $3 \cdot 10^7$ and $10^4$: stiff by nine orders of magnitude.

    **Manifold**: the balance $A + B + C$. **Reference**: numerical, by Kvaerno5 at a tolerance of
    1e-8; at $t = 40$ within 1e-7 of the published values, relative to each species. **Samples**:
    the initial state, with a factor between 1/2 and 2.

    Source: H. H. Robertson, "The solution of a set of reaction rate equations", in "Numerical
    Analysis: an Introduction" (1966); F. Mazzia and C. Magherini, "Test Set for Initial Value
    Problem Solvers", release 2.4 (2008).
    """

    rates: Float[Array, "3"] = eqx.field(converter=real, default=(0.04, 3e7, 1e4))

    name = "robertson"
    title = "Robertson's reaction"
    citation = "H. H. Robertson, Numerical Analysis: an Introduction (1966)."
    t1 = 40.0
    dt = 0.1
    axes = ("A", "C")

    @property
    def mechanism(self) -> Mechanism:
        return Mechanism(("A -> B", "2 B -> B + C", "B + C -> A + C"), self.rates)

    @property
    def y0(self) -> State:
        return self.mechanism.state({"A": 1.0})


Robertson.__init__.__doc__ = "**Arguments:**\n\n- `rates`: the three rate constants."


_SPECIES = (
    *("NO2", "NO", "O3P", "O3", "HO2", "OH", "HCHO", "CO", "ALD", "MEO2"),
    *("C2O3", "CO2", "PAN", "CH3O", "HNO3", "O1D", "SO2", "SO4", "NO3", "N2O5"),
)
_INITIAL = {"NO": 0.2, "O3": 0.04, "HCHO": 0.1, "CO": 0.3, "ALD": 0.01, "SO2": 0.007}
_POLLU = {
    "NO2 -> NO + O3P": 0.35,
    "NO + O3 -> NO2": 26.6,
    "HO2 + NO -> NO2 + OH": 1.23e4,
    "HCHO -> 2 HO2 + CO": 8.6e-4,
    "HCHO -> CO": 8.2e-4,
    "HCHO + OH -> HO2 + CO": 1.5e4,
    "ALD -> MEO2 + HO2 + CO": 1.3e-4,
    "ALD + OH -> C2O3": 2.4e4,
    "C2O3 + NO -> NO2 + MEO2 + CO2": 1.65e4,
    "C2O3 + NO2 -> PAN": 9e3,
    "PAN -> C2O3 + NO2": 0.022,
    "MEO2 + NO -> CH3O + NO2": 1.2e4,
    "CH3O -> HCHO + HO2": 1.88,
    "NO2 + OH -> HNO3": 1.63e4,
    "O3P -> O3": 4.8e6,
    "O3 -> O1D": 3.5e-4,
    "O3 -> O3P": 0.0175,
    "O1D -> 2 OH": 1e8,
    "O1D -> O3P": 4.44e11,
    "SO2 + OH -> SO4 + HO2": 1240.0,
    "NO3 -> NO": 2.1,
    "NO3 -> NO2 + O3P": 5.78,
    "NO2 + O3 -> NO3": 0.0474,
    "NO3 + NO2 -> N2O5": 1780.0,
    "N2O5 -> NO3 + NO2": 3.12,
}


@final
class Pollu(AbstractChemistry):
    r"""Verwer's model of air pollution: 20 species in ppm, 25 reactions, time in minutes.

    The order of the species in `y`, of shape `(20,)`, is `system.mechanism.species`; the reactions
    are `system.mechanism.reactions`. Rate constants lie between 1.3e-4 and 4.4e11.

    **Manifold**: the balances of nitrogen, sulphur and carbon, as far as the reactions conserve
    them. **Reference**: numerical, by Kvaerno5 at a tolerance of 1e-8, within 1e-10 of the
    published state at $t = 60$, relative to each species. **Samples**: the initial concentrations,
    each with a factor between 1/2 and 2.

    Source: J. G. Verwer, "Gauss-Seidel iteration for stiff ODEs from chemical kinetics", SIAM J.
    Sci. Comput. 15 (1994); E. Hairer and G. Wanner, "Solving Ordinary Differential Equations II";
    F. Mazzia and C. Magherini, "Test Set for Initial Value Problem Solvers", release 2.4 (2008).
    """

    rates: Float[Array, "25"] = eqx.field(converter=real, default=tuple(_POLLU.values()))

    name = "pollu"
    title = "Air pollution"
    citation = "J. G. Verwer, SIAM J. Sci. Comput. 15 (1994)."
    t1 = 60.0
    dt = 2.0
    axes = ("NO2", "O3")

    @property
    def mechanism(self) -> Mechanism:
        return Mechanism(tuple(_POLLU), self.rates, species=_SPECIES)

    @property
    def y0(self) -> State:
        return self.mechanism.state(_INITIAL)


Pollu.__init__.__doc__ = "**Arguments:**\n\n- `rates`: the 25 rate constants."
