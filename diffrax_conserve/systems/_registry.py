"""The catalogue by name, as the command line uses it."""

import difflib

from ._attitude import RigidBodyAttitude
from ._base import AbstractSystem
from ._cartesian_pendulum import CartesianPendulum
from ._chemistry import Pollu, Robertson
from ._double_pendulum import DoublePendulum
from ._henon_heiles import HenonHeiles
from ._kepler import Kepler
from ._korteweg_de_vries import KortewegDeVries
from ._lorenz import ConservativeLorenz
from ._lotka_volterra import LotkaVolterra
from ._oscillator import HarmonicOscillator
from ._rigid_body import RigidBody
from ._solar import OuterSolarSystem
from ._toda import TodaLattice
from ._vortices import PointVortices

# In the order of the list: the paper's five first.
_SYSTEMS: dict[str, type[AbstractSystem]] = {
    system.name: system
    for system in (
        HarmonicOscillator,
        RigidBody,
        DoublePendulum,
        ConservativeLorenz,
        PointVortices,
        Kepler,
        OuterSolarSystem,
        HenonHeiles,
        LotkaVolterra,
        TodaLattice,
        KortewegDeVries,
        CartesianPendulum,
        RigidBodyAttitude,
    )
}
# Explicit methods cannot solve these.
_STIFF: dict[str, type[AbstractSystem]] = {system.name: system for system in (Robertson, Pollu)}
_ALL = _SYSTEMS | _STIFF
CLASSES = tuple(_ALL.values())


def names(*, stiff: bool = False) -> tuple[str, ...]:
    """The names of the systems of the catalogue: the non-stiff ones, or with `stiff` the stiff
    ones."""
    return tuple(_STIFF if stiff else _SYSTEMS)


def get(name: str) -> AbstractSystem:
    """The system called `name`, with its default parameters.

    **Arguments:**

    - `name`: one of `names()` or of `names(stiff=True)`, such as `"kepler"`.

    **Returns:**

    An instance of the system's class. For other parameters, call the class itself:
    `Kepler(mu=2.0)`.

    **Raises:**

    `ValueError` for an unknown name; the message suggests similar names.

    !!! example

        ```python
        import diffrax_conserve as dfc

        system = dfc.systems.get("rigid-body")
        ```
    """
    if name not in _ALL:
        close = difflib.get_close_matches(str(name).lower().replace("_", "-"), _ALL, cutoff=0.4)
        hint = f"Did you mean {' or '.join(map(repr, close))}? " if close else ""
        raise ValueError(
            f"There is no system called {name!r}. {hint}The catalogue holds: {', '.join(_ALL)}."
        )
    return _ALL[name]()
