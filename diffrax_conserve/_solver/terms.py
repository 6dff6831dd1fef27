"""Properties of a solve that its terms reveal, and of the solvers that wrap each other."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree, Real

from .._custom_types import RealScalarLike
from .._projection.base import AbstractProjection
from .._time import FieldTime
from .diffrax_private import AdjointTerm, WrapTerm


def time_direction(terms: PyTree[dfx.AbstractTerm], t: RealScalarLike) -> Real[Array, ""]:
    """`-1` in a solve with `t1 < t0`, for which `diffeqsolve` negates all times before it calls the
    solver; otherwise `1`. In the dtype of `t`."""
    directions = [x.direction for x in _nested(terms) if isinstance(x, WrapTerm)]
    return jnp.asarray(directions[0] if directions else 1, jnp.result_type(t))


def in_field_time(terms: PyTree[dfx.AbstractTerm], *times: RealScalarLike) -> tuple[Any, ...]:
    """The terms and times in the time of the vector field. `diffeqsolve` negates both if `t1 < t0`,
    which is undone here for evaluating the vector field; a wrapped solver takes what it gives."""
    field_time = FieldTime(time_direction(terms, times[0]))
    is_term = lambda x: isinstance(x, dfx.AbstractTerm)  # noqa: E731
    bare = lambda x: x.term if isinstance(x, WrapTerm) else x  # noqa: E731
    return jtu.tree_map(bare, terms, is_leaf=is_term), *map(field_time, times)


def is_backsolve(terms: PyTree[dfx.AbstractTerm]) -> bool:
    """Whether this is the backward solve of a `diffrax.BacksolveAdjoint`."""
    return any(isinstance(x, AdjointTerm) for x in _nested(terms))


def refuse_backsolve(terms: PyTree[dfx.AbstractTerm], solver: str, remedy: str = "Use") -> None:
    """Raises in the backward solve of a `diffrax.BacksolveAdjoint`."""
    if is_backsolve(terms):
        raise ValueError(
            f"`{solver}` cannot solve the adjoint equations of `BacksolveAdjoint`, whose state is "
            f"not on the manifold. {remedy} `diffrax.RecursiveCheckpointAdjoint()`."
        )


def is_ode(terms: PyTree[dfx.AbstractTerm]) -> bool:
    """Whether time is the only control: every term is a `diffrax.ODETerm`, or one of the user's own
    class that contains no path, as a `diffrax.ControlTerm` does."""
    is_path = lambda x: isinstance(x, dfx.AbstractPath)  # noqa: E731
    own = [x for x in _nested(terms) if not isinstance(x, (dfx.ODETerm, *_COMPOSED))]
    return not any(map(is_path, jtu.tree_leaves(own, is_leaf=is_path)))


def vector_fields(terms: PyTree[dfx.AbstractTerm]) -> list[Any]:
    """The vector fields of every `diffrax.ODETerm`."""
    return [x.vector_field for x in _nested(terms) if isinstance(x, dfx.ODETerm)]


_COMPOSED = dfx.MultiTerm, WrapTerm, AdjointTerm


def _nested(terms: Any) -> list[Any]:
    """All terms, those inside `MultiTerm`, `WrapTerm` and `AdjointTerm` too."""
    found = jtu.tree_leaves(terms, is_leaf=lambda x: isinstance(x, dfx.AbstractTerm))
    composed = [x for x in found if isinstance(x, _COMPOSED)]
    parts = [x.terms if isinstance(x, dfx.MultiTerm) else x.term for x in composed]
    return found + (_nested(parts) if parts else [])


def check_projects_nothing(solver: dfx.AbstractSolver) -> None:
    for layer in _wrapped_solvers(solver):
        if hasattr(layer, "manifold") and hasattr(layer, "projection"):
            raise ValueError(
                f"`solver` contains a `{type(layer).__name__}`, whose manifold an outer projection "
                "would leave. Put all entries into one manifold, around the solver inside; with a "
                "`DAE` write `dae.wrap(solver, manifold)`."
            )


def check_root_finder(solver: dfx.AbstractSolver) -> None:
    inner = innermost(solver)
    if (
        inner is not solver
        and isinstance(inner, dfx.AbstractImplicitSolver)
        and not eqx.is_array_like(getattr(inner.root_finder, "rtol", 0.0))
    ):
        raise ValueError(
            f"The root finder of the implicit solver {type(inner).__name__} takes its tolerances "
            "from the step-size controller, which diffrax passes through one wrapper only. In a "
            f"{type(solver).__name__} give them, for example `{type(inner).__name__}(root_finder="
            "diffrax.VeryChord(rtol=1e-8, atol=1e-8, norm=optimistix.max_norm))`."
        )


def check_direction(solver: dfx.AbstractSolver, projection: AbstractProjection) -> None:
    if projection.needs_signed_error and dfx.HalfSolver in map(type, _wrapped_solvers(solver)):
        raise ValueError(
            '`AlongLine(direction="error")` moves along the error estimate, which '
            "`diffrax.HalfSolver` gives without its sign. Wrap a solver with an embedded method, "
            'such as `diffrax.Tsit5()`, or pass `projection=AlongLine(direction="step")`.'
        )


def innermost(solver: dfx.AbstractSolver) -> dfx.AbstractSolver:
    return _wrapped_solvers(solver)[-1]


def _wrapped_solvers(solver: Any) -> list[dfx.AbstractSolver]:
    """The solver, the one that it wraps, and so on."""
    # Not by `isinstance`, which diffrax forwards to the wrapped solver.
    wraps = issubclass(type(solver), dfx.AbstractWrappedSolver)
    return [solver, *(_wrapped_solvers(solver.solver) if wraps else [])]
