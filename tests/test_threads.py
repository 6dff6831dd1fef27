"""In a batch the calls of LAPACK share the threads of XLA, and two that run at once may wait for
each other for ever: see `computed_after`. So of any two in a program one depends on the other."""

import re

import diffrax as dfx
import jax
import jax.numpy as jnp

import diffrax_conserve as dfc

from .thinned import some_of

# As users compile: what does not change in a loop is moved out of it.
AS_USERS = dict(xla_disable_hlo_passes="", xla_backend_optimization_level="0")
LINEAR = jnp.array([[-1.0, 0.3, 0.0], [0.1, -2.0, 0.2], [0.0, 0.4, -3.0]])


def computations(text):
    """For each computation of a compiled program its instructions, each with the names of what it
    contains: operands, and computations that it calls."""
    found = {}
    for line in re.sub(r"metadata=\{[^}]*\}", "", text).splitlines():
        if start := re.match(r"(?:ENTRY )?%?([\w.-]+) \(", line):
            lines = found[start[1]] = {}
        elif instruction := re.match(r"\s+(?:ROOT )?%([\w.-]+) = (.*)", line):
            lines[instruction[1]] = instruction[2]
    return found


def independent_calls(text):
    found = computations(text)

    def calls_lapack(line):
        inside = [found[x] for x in re.findall(r"%([\w.-]+)", line) if x in found]
        return "lapack_" in line or any(calls_lapack(x) for lines in inside for x in lines.values())

    pairs, count = [], 0
    for lines in found.values():
        before, calls = {}, []
        for name, line in lines.items():
            operands = [x for x in re.findall(r"%([\w.-]+)", line) if x in before]
            before[name] = {name}.union(*(before[x] for x in operands))
            if calls_lapack(line):
                pairs += [(x, name) for x in calls if x not in before[name]]
                calls.append(name)
        count += len(calls)
    return pairs, count


def last_state(solver, field, y0, dae=None):
    def solve(rate):
        term = dfx.ODETerm(lambda t, y, args: rate * field(y)) if dae is None else dae.term
        steps = dfx.PIDController(rtol=1e-6, atol=1e-6)
        options = dict(stepsize_controller=steps, max_steps=16, throw=False)
        found = dfx.diffeqsolve(term, solver, 0.0, 1.0, 1e-2, y0, rate, **options)
        return sum(jnp.sum(x[-1]) for x in jax.tree.leaves(found.ys))

    return solve


def linear(y):
    return LINEAR @ y


def nearest_neighbours(y):
    return jnp.roll(y, 1) - y


def pendulum(t, y, slopes, args):
    q, v, force = y[:2], y[2:4], y[4]
    downwards = jnp.array([0.0, -9.81])
    parts = slopes[:2] - v, slopes[2:4] + args * force * q - downwards, (q @ q - 1)[None]
    return jnp.concatenate(parts)


PAIRS = dfc.FirstIntegral(lambda t, y, args: y[:18] * y[1:])
PENDULUM = dfc.DAE(residual=pendulum)
SOLVES = {
    "Radau": last_state(dfc.Radau(), linear, jnp.ones(3)),
    "random features": last_state(dfc.RandomFeatureSolver(4), linear, jnp.ones(3)),
    "many constraints": last_state(
        dfc.ManifoldProjection(dfx.Tsit5(), PAIRS), nearest_neighbours, jnp.arange(1.0, 20.0)
    ),
    "a pendulum": last_state(
        PENDULUM.wrap(dfc.Radau()), None, jnp.array([1.0, 0, 0, 0, 0]), PENDULUM
    ),
}


# The error estimate of random features is independent of the derivative of the solution.
CASES = [(name, is_gradient) for name in SOLVES for is_gradient in (False, True)]
CASES.remove(("random features", True))


@some_of("name, is_gradient", CASES, period=3)
def test_no_call_of_lapack_is_independent_of_another(name, is_gradient):
    solve = jax.grad(SOLVES[name]) if is_gradient else SOLVES[name]
    batch = jax.jit(jax.vmap(solve), compiler_options=AS_USERS)
    pairs, count = independent_calls(batch.lower(jnp.linspace(1.0, 2.0, 4)).compile().as_text())
    assert count >= 2
    assert not pairs
