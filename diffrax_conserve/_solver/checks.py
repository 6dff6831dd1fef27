"""Checks of the arguments of a `ManifoldProjection`, and the innermost of nested solvers."""

import diffrax as dfx
import equinox as eqx

from .._projection.base import AbstractProjection
from .._projection.directional import Directional


def check_nested(solver: dfx.AbstractSolver) -> None:
    inner = innermost(solver)
    if (
        inner is not solver
        and isinstance(inner, dfx.AbstractImplicitSolver)
        and not eqx.is_array_like(getattr(inner.root_finder, "rtol", 0.0))
    ):
        raise ValueError(
            f"`ManifoldProjection` is given a {type(solver).__name__} of the implicit solver "
            f"{type(inner).__name__}, whose root finder takes its tolerances from the step-size "
            "controller; diffrax passes these through one wrapper only. Give them explicitly, for "
            f"example `{type(inner).__name__}(root_finder=diffrax.VeryChord(rtol=1e-8, atol=1e-8, "
            "norm=optimistix.max_norm))`."
        )


def innermost(solver: dfx.AbstractSolver) -> dfx.AbstractSolver:
    # `HalfSolver` does not forward the root finder and its options.
    while issubclass(type(solver), dfx.AbstractWrappedSolver):
        solver = solver.solver  # pyright: ignore
    return solver


def check_direction(solver: dfx.AbstractSolver, projection: AbstractProjection) -> None:
    if not isinstance(projection, Directional):
        return
    while issubclass(type(solver), dfx.AbstractWrappedSolver):
        if type(solver) is dfx.HalfSolver:
            raise ValueError(
                "`Directional` moves along the error estimate of the wrapped solver, but "
                "`diffrax.HalfSolver` gives it without its sign. Wrap a solver with an embedded "
                "method, such as `diffrax.Tsit5()`, or pass `projection=SimplifiedNewton()`."
            )
        solver = solver.solver  # pyright: ignore
