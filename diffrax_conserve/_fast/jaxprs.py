"""Jaxprs, the programs into which JAX traces functions: evaluated with other meanings of their
equations, as one would overload operators in Python, and searched for the programs inside. What
depends on the version of JAX is in this file only."""

from collections.abc import Callable, Iterable
from typing import Any

import jax.extend.core as jex
import jax.tree_util as jtu
import numpy as np


def walk(
    closed: jex.ClosedJaxpr,
    inputs: list[Any],
    constant: Callable[[Any], Any],
    equation: Callable[[Any, list[Any]], Iterable[Any]],
) -> list[Any]:
    """The outputs of a jaxpr whose values are of another kind, which the caller chooses.

    `constant(x)` makes such a value of a constant, and `equation(eqn, inputs)` computes those of an
    equation. Functions under `jax.jit` are entered.
    """
    env = dict(zip(closed.jaxpr.constvars, map(constant, closed.consts), strict=True))
    env.update(zip(closed.jaxpr.invars, inputs, strict=True))

    def read(var: Any) -> Any:
        if isinstance(var, jex.Literal):
            return constant(np.asarray(var.val, var.aval.dtype))  # pyright: ignore
        return env[var]

    for eqn in closed.jaxpr.eqns:
        given = [read(var) for var in eqn.invars]
        if eqn.primitive.name in ("jit", "pjit"):
            outs = walk(eqn.params["jaxpr"], given, constant, equation)
        else:
            outs = equation(eqn, given)
        env.update(zip(eqn.outvars, outs, strict=True))
    return [read(var) for var in closed.jaxpr.outvars]


def outputs(eqn: Any, *inputs: Any) -> list[Any]:
    """The values of an equation for given inputs, computed by JAX."""
    given = eqn.primitive.get_bind_params(eqn.params)
    # Before version 0.10 the functions inside stood apart from the parameters.
    functions, params = given if isinstance(given, tuple) else ((), given)
    outs = eqn.primitive.bind(*functions, *inputs, **params)
    return outs if eqn.primitive.multiple_results else [outs]


def closed_jaxpr(jaxpr: Any) -> jex.ClosedJaxpr:
    """A jaxpr together with its constants. One that JAX stores without them has none."""
    return jaxpr if isinstance(jaxpr, jex.ClosedJaxpr) else jex.ClosedJaxpr(jaxpr, ())


def carried(scan: Any) -> tuple[int, int]:
    """Where the operands of a `scan` that are carried begin and end.

    Before them are constants, after them arrays over which the loop runs. The parameters that count
    them have other names in other versions of JAX. But only arrays of the last kind have another
    shape inside the loop than outside, and so we can count.
    """
    inside, alike = scan.params["jaxpr"], lambda var, x: var.aval.shape == x.shape
    last = sum(map(alike, scan.invars, inside.in_avals))
    return last - sum(map(alike, scan.outvars, inside.out_avals)), last


def jaxprs_inside(eqn: Any) -> list[jex.ClosedJaxpr]:
    """The programs that an equation runs, such as the body of a loop."""
    is_jaxpr = lambda x: isinstance(x, jex.ClosedJaxpr | jex.Jaxpr)  # noqa: E731
    found = filter(is_jaxpr, jtu.tree_leaves(eqn.params, is_leaf=is_jaxpr))
    return [closed_jaxpr(x) for x in found]


def num_equations(closed: jex.ClosedJaxpr) -> int:
    """With those of the programs inside."""
    eqns = closed.jaxpr.eqns
    return len(eqns) + sum(num_equations(x) for eqn in eqns for x in jaxprs_inside(eqn))
