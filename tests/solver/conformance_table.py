"""Every public solver of diffrax, and what it is tested on inside `ManifoldProjection`.

`test_conformance.py` runs each line; `docs/hooks.py` shows them.
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

TESTED = {
    EXPLICIT: "Bosh3 Dopri5 Dopri8 Heun Midpoint Ralston Tsit5",
    IMPLICIT: "ImplicitEuler Kvaerno3 Kvaerno4 Kvaerno5",
    IMEX: "KenCarp3 KenCarp4 KenCarp5 Sil3",
    MULTISTEP: "LeapfrogMidpoint ReversibleHeun",
    SPLIT: "SemiImplicitEuler",
    ITO: "Euler ItoMilstein",
    STRATONOVICH: "EulerHeun GeneralShARK SPaRK SlowRK StratonovichMilstein",
    ADDITIVE: "SEA SRA1 ShARK",
    LANGEVIN: "ALIGN QUICSORT ShOULD",
    WRAPPER: "HalfSolver",
}
# Solver: what it is tested on. All are supported.
TABLE = dict(sorted((name, kind) for kind, names in TESTED.items() for name in names.split()))
