"""The catalogue by name, as the command line uses it."""

import difflib

from ._base import AbstractSystem
from ._chemistry import AbstractChemistry, Pollu, Robertson
from ._fluids import ConservativeLorenz, KortewegDeVries, PointVortices
from ._gravity import Kepler, OuterSolarSystem
from ._oscillators import HarmonicOscillator, HenonHeiles, LotkaVolterra, TodaLattice
from ._pendulums import CartesianPendulum, DoublePendulum
from ._rigid_body import RigidBody, RigidBodyAttitude

# In the order of the list: the paper's five first. Explicit methods cannot solve the last two.
CLASSES: tuple[type[AbstractSystem], ...] = (
    *(HarmonicOscillator, RigidBody, DoublePendulum, ConservativeLorenz, PointVortices),
    *(Kepler, OuterSolarSystem, HenonHeiles, LotkaVolterra, TodaLattice, KortewegDeVries),
    *(CartesianPendulum, RigidBodyAttitude),
    *(Robertson, Pollu),
)
_BY_NAME = {system.name: system for system in CLASSES}


def names(*, stiff: bool = False) -> tuple[str, ...]:
    """The names of the non-stiff systems of the catalogue, or with `stiff` of the stiff ones."""
    return tuple(k for k, v in _BY_NAME.items() if issubclass(v, AbstractChemistry) == stiff)


def get(name: str) -> AbstractSystem:
    """The system called `name`, with its default parameters.

    For other parameters, call the class itself: `Kepler(mu=2.0)`.

    **Arguments:**

    - `name`: one of `names()` or of `names(stiff=True)`, such as `"kepler"`; for others a
        `ValueError` that suggests similar names.

    !!! example

        ```python
        import diffrax_conserve as dfc

        system = dfc.systems.get("rigid-body")
        ```
    """
    if name not in _BY_NAME:
        close = difflib.get_close_matches(str(name).lower().replace("_", "-"), _BY_NAME, cutoff=0.4)
        hint = f"Did you mean {' or '.join(map(repr, close))}? " if close else ""
        raise ValueError(
            f"There is no system called {name!r}. {hint}The catalogue holds: {', '.join(_BY_NAME)}."
        )
    return _BY_NAME[name]()
