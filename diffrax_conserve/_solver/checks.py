"""Checks of the arguments of a `ManifoldProjection`, and the innermost of nested solvers."""

from typing import Any

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


def check_direction(solver: dfx.AbstractSolver, projection: AbstractProjection) -> None:
    halved = any(type(x) is dfx.HalfSolver for x in _layers(solver))
    if halved and isinstance(projection, Directional):
        raise ValueError(
            "`Directional` moves along the error estimate of the wrapped solver, but "
            "`diffrax.HalfSolver` gives it without its sign. Wrap a solver with an embedded "
            "method, such as `diffrax.Tsit5()`, or pass `projection=SimplifiedNewton()`."
        )


def innermost(solver: dfx.AbstractSolver) -> dfx.AbstractSolver:
    return _layers(solver)[-1]


def _layers(solver: Any) -> list[dfx.AbstractSolver]:
    """The solver, the one that it wraps, and so on."""
    # Not by `isinstance`, which diffrax forwards to the wrapped solver.
    wraps = issubclass(type(solver), dfx.AbstractWrappedSolver)
    return [solver, *(_layers(solver.solver) if wraps else [])]
