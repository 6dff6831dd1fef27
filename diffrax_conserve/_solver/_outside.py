"""What becomes of a step that starts outside the domain of a flow map, or may be too wrong."""

from typing import Any, final

import diffrax as dfx
import equinox as eqx
import jax.core
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._custom_types import Args, BoolScalarLike, RealScalarLike, Y
from ._chebyshev import series
from ._results import numbered

POLICIES = ("ignore", "report", "fail")


@final
class DomainStatistics(eqx.Module):
    """How often a flow map was asked for more than it has learned, over the accepted steps.

    A step is outside if it starts outside the flow map's `domain`, or its estimated error is above
    `max_error`; see the option `outside` of [`diffrax_conserve.DeepONetSolver`][].

    **Attributes:**

    - `num_steps`: how many steps were taken.
    - `num_outside`: how many of them were outside.
    - `first_outside`: the time at which the first of these started; infinity if there is none.
    """

    num_steps: Int[Array, "..."]
    num_outside: Int[Array, "..."]
    first_outside: Float[Array, "..."]

    @property
    def fraction_outside(self) -> Float[Array, "..."]:
        """`num_outside / num_steps`."""
        return self.num_outside / jnp.maximum(self.num_steps, 1)

    @classmethod
    def zero(cls, t0: RealScalarLike) -> "DomainStatistics":
        never = jnp.full((), jnp.inf, jnp.result_type(t0, np.float16))
        return cls(jnp.asarray(0), jnp.asarray(0), never)

    def add(self, t0: RealScalarLike, trusted: BoolScalarLike) -> "DomainStatistics":
        time = jnp.where(trusted, jnp.inf, t0).astype(self.first_outside.dtype)
        return DomainStatistics(
            self.num_steps + 1,
            self.num_outside + jnp.where(trusted, 0, 1),
            jnp.minimum(self.first_outside, time),
        )


class Taken(eqx.Module):
    """What a step returns, but for the solver state."""

    y1: Y
    error: Y
    coefficients: PyTree[Array]
    result: dfx.RESULTS


def check_policy(outside: Any, max_error: RealScalarLike | None, domain: Any) -> None:
    """Raises unless the options say what to do, and when."""
    if not isinstance(outside, dfx.AbstractSolver) and outside not in POLICIES:
        raise ValueError(
            f'`outside` is {outside!r}, but it must be "ignore", "report", "fail", or a diffrax '
            "solver that takes the steps that the flow map cannot, such as `diffrax.Tsit5()`."
        )
    if isinstance(outside, dfx.AbstractSolver):
        _check_classical(outside)
    if domain is not None and not callable(getattr(domain, "contains", None)):
        raise TypeError(
            f"The `domain` of the flow map is {domain!r}, which has no method `contains(y)`. Make "
            "it a `diffrax_conserve.Box`, or a Module with that method."
        )
    known = max_error is not None and not isinstance(max_error, jax.core.Tracer)
    if known and eqx.is_array_like(max_error) and not np.all(np.asarray(max_error) > 0):
        raise ValueError(f"`max_error` is {max_error}, but it must be positive, or `None`.")
    ignored = isinstance(outside, str) and outside == "ignore"
    if ignored and max_error is not None:
        raise ValueError(
            "`max_error` says which steps count as outside, but these are ignored. Pass `outside="
            '"report"`, `outside="fail"` or `outside=diffrax.Tsit5()` too.'
        )
    if not ignored and max_error is None and domain is None:
        raise ValueError(
            f"`outside` is {outside!r}, but the flow map does not say what is outside: it has no "
            "`domain`. Give it one, for example `diffrax_conserve.Box.around(states)` with the "
            "states that it was trained on, or pass `max_error`."
        )


def _check_classical(solver: dfx.AbstractSolver) -> None:
    if solver.term_structure is not dfx.AbstractTerm:
        raise ValueError(
            f"`outside` is a {type(solver).__name__}, which needs several terms, but a learned "
            "solver has one. Pass a solver of one, for example `diffrax.Tsit5()`."
        )
    root_finder = getattr(solver, "root_finder", None)
    if root_finder is not None and not eqx.is_array_like(getattr(root_finder, "rtol", 0.0)):
        raise ValueError(
            f"`outside` is a {type(solver).__name__}, whose root finder takes its tolerances from "
            "the step-size controller; diffrax does not hand them to a solver within a solver. "
            f"Give them, for example `{type(solver).__name__}(root_finder=diffrax.VeryChord("
            "rtol=1e-8, atol=1e-8, norm=optimistix.max_norm))`."
        )


def small_enough(error: Y, max_error: RealScalarLike) -> Bool[Array, ""]:
    """Whether every component of `error` is at most `max_error`; NaN is not."""
    fine = [jnp.all(jnp.abs(e) <= max_error) for e in jtu.tree_leaves(error)]
    return jnp.all(jnp.stack(fine))


def failure(t0: RealScalarLike, inside: BoolScalarLike) -> dfx.RESULTS:
    """Of a step at `t0` that starts outside the domain, or else has too large an error."""
    left = (
        "diffrax_conserve: the step at about t = {} starts outside the domain of the flow map. "
        "Train it on states from there, or let a classical solver take such steps, by "
        "`outside=diffrax.Tsit5()`."
    )
    wrong = (
        "diffrax_conserve: the estimated error of the step at about t = {} is above `max_error`. "
        "Take shorter steps, correct them by `corrections=...`, or let a classical solver take "
        "such steps, by `outside=diffrax.Tsit5()`."
    )
    results = [numbered(x, t0, digits=2, decades=(-4, 7)) for x in (left, wrong)]
    return dfx.RESULTS.where(inside, results[1], results[0])


def taken_by(
    solver: dfx.AbstractSolver,
    terms: dfx.AbstractTerm,
    t0: RealScalarLike,
    t1: RealScalarLike,
    y0: Y,
    args: Args,
    nodes: int,
) -> Taken:
    """The step of a classical solver, which starts anew."""
    state = solver.init(terms, t0, t1, y0, args)
    y1, error, dense_info, _, result = solver.step(terms, t0, t1, y0, args, state, False)
    inner = solver.interpolation_cls(t0=t0, t1=t1, **dense_info)
    dtype = jnp.result_type(t1 - t0)
    coefficients = series(lambda c: inner.evaluate(t0 + c * (t1 - t0)), nodes, dtype)
    if error is None:  # then no controller may rely on it
        error = jtu.tree_map(lambda x: jnp.full_like(x, jnp.inf), y1)
    return Taken(y1, error, coefficients, result)


def choose(trusted: BoolScalarLike, learned: Taken, classical: Any) -> Taken:
    """`learned` if it is trusted, else `classical()`, with the dtypes of `learned`."""

    def other() -> Taken:
        return jtu.tree_map(lambda a, b: jnp.asarray(a, jnp.result_type(b)), classical(), learned)

    return lax.cond(trusted, lambda: jtu.tree_map(jnp.asarray, learned), other)
