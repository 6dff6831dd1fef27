"""Every public solver of diffrax, and what it is tested on inside `ManifoldProjection`.

`test_conformance.py` runs each line; `docs/solvers.md` shows them.
"""

EXPLICIT = "explicit Runge-Kutta"
IMPLICIT = "implicit; tolerances from the step-size controller"
IMEX = "implicit-explicit, on `MultiTerm`"
MULTISTEP = "carries a second state of its own, which stays off the manifold"
SPLIT = "two terms, on a tuple of states"
ITO = "Itô SDE"
STRATONOVICH = "Stratonovich SDE"
ADDITIVE = "Stratonovich SDE, additive noise"
LANGEVIN = "underdamped Langevin"
WRAPPER = "inside and outside, if the wrapped solver is explicit"

# Solver: what it is tested on. All are supported.
TABLE = {
    "ALIGN": LANGEVIN,
    "Bosh3": EXPLICIT,
    "Dopri5": EXPLICIT,
    "Dopri8": EXPLICIT,
    "Euler": ITO,
    "EulerHeun": STRATONOVICH,
    "GeneralShARK": STRATONOVICH,
    "HalfSolver": WRAPPER,
    "Heun": EXPLICIT,
    "ImplicitEuler": IMPLICIT,
    "ItoMilstein": ITO,
    "KenCarp3": IMEX,
    "KenCarp4": IMEX,
    "KenCarp5": IMEX,
    "Kvaerno3": IMPLICIT,
    "Kvaerno4": IMPLICIT,
    "Kvaerno5": IMPLICIT,
    "LeapfrogMidpoint": MULTISTEP,
    "Midpoint": EXPLICIT,
    "QUICSORT": LANGEVIN,
    "Ralston": EXPLICIT,
    "ReversibleHeun": MULTISTEP,
    "SEA": ADDITIVE,
    "SPaRK": STRATONOVICH,
    "SRA1": ADDITIVE,
    "SemiImplicitEuler": SPLIT,
    "ShARK": ADDITIVE,
    "ShOULD": LANGEVIN,
    "Sil3": IMEX,
    "SlowRK": STRATONOVICH,
    "StratonovichMilstein": STRATONOVICH,
    "Tsit5": EXPLICIT,
}
