"""Every public solver of diffrax, wrapped."""

import inspect

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import pytest

import diffrax_conserve as dfc

from ..problems import OMEGA0, RIGID_BODY, TO_THE_END, largest, rigid_body
from . import conformance_table as kinds
from .conformance_table import TABLE


def public_solvers():
    return {
        name: kind
        for name, kind in vars(dfx).items()
        if inspect.isclass(kind)
        and issubclass(kind, dfx.AbstractSolver)
        and not name.startswith("Abstract")
    }


def test_the_table_is_complete():
    assert set(TABLE) == set(public_solvers())


@eqx.filter_jit
def solve(terms, manifold, inner, controller, y0):
    """Whether it succeeded, the drift, and how far the state moved."""
    solver, saveat = dfc.ManifoldProjection(inner, manifold), dfx.SaveAt(ts=jnp.linspace(0, 1, 23))
    options = TO_THE_END | dict(saveat=saveat, stepsize_controller=controller)
    sol = dfx.diffeqsolve(terms, solver, 0.0, 1.0, 0.01, y0, **options)
    moved = jax.tree.map(lambda y, start: jnp.abs(y[-1] - start), sol.ys, y0)
    return sol.result, dfc.drift(sol, manifold), moved


SPHERE = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))
AXIS = jnp.array([0.0, 0.6, 0.8])


def brownian(shape=(), levy_area=dfx.SpaceTimeLevyArea):
    return dfx.VirtualBrownianTree(0.0, 1.0, 1e-3, shape, jr.key(0), levy_area=levy_area)


def sde(drift, diffusion):
    return dfx.MultiTerm(dfx.ODETerm(drift), dfx.ControlTerm(diffusion, brownian()))


def spin(t, y, args):
    return jnp.cross(jnp.array([0.0, 0.0, 1.0]), y)


def shake(t, y, args):
    return 0.3 * jnp.cross(AXIS, y)


# With the drift that keeps the sphere in the sense of Itô.
ITO = sde(lambda *x: spin(*x) + 0.045 * jnp.cross(AXIS, jnp.cross(AXIS, x[1])), shake)
HALF = dfx.ODETerm(lambda t, y, args: rigid_body(t, y, args) / 2)
SPLIT = dfx.ODETerm(lambda t, p, args: p), dfx.ODETerm(lambda t, q, args: -jnp.sin(q))
ENERGY = dfc.FirstIntegral(lambda t, y, args: y[1] ** 2 / 2 - jnp.cos(y[0]))
# Equal noise in both components.
ADDITIVE = sde(
    lambda t, y, args: -jnp.sin(y[0]) * jnp.ones(2), lambda t, y, args: 0.3 * jnp.ones(2)
)
DIFFERENCE = dfc.FirstIntegral(lambda t, y, args: jnp.exp(y[0] - y[1]))
NOISE_IN_EPS = brownian((2,), dfx.SpaceTimeTimeLevyArea)
# A thermal bead on a circle: the position is constrained.
LANGEVIN = dfx.MultiTerm(
    dfx.UnderdampedLangevinDriftTerm(jnp.ones(2), jnp.ones(2), lambda x, args: x),
    dfx.UnderdampedLangevinDiffusionTerm(jnp.ones(2), jnp.ones(2), NOISE_IN_EPS),
)
CIRCLE = dfc.Constraint(lambda t, y, args: jnp.sum(y[0] ** 2) - 1)
BODY = kinds.EXPLICIT, kinds.IMPLICIT, kinds.MULTISTEP, kinds.WRAPPER
# Terms, initial state and manifold.
PROBLEMS = {
    **dict.fromkeys(BODY, (dfx.ODETerm(rigid_body), OMEGA0, RIGID_BODY)),
    kinds.IMEX: (dfx.MultiTerm(HALF, HALF), OMEGA0, RIGID_BODY),
    kinds.SPLIT: (SPLIT, (jnp.array(1.0), jnp.array(0.5)), ENERGY),
    kinds.ITO: (ITO, AXIS[::-1], SPHERE),
    kinds.STRATONOVICH: (sde(spin, shake), AXIS[::-1], SPHERE),
    kinds.ADDITIVE: (ADDITIVE, jnp.array([0.5, 1.0]), DIFFERENCE),
    kinds.LANGEVIN: (LANGEVIN, (jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0])), CIRCLE),
}


# By default one solver of each kind that no other test has.
FIRST_OF_ITS_KIND = {
    name
    for kind, name in {kind: name for name, kind in reversed(TABLE.items())}.items()
    if kind in (kinds.IMPLICIT, kinds.MULTISTEP, kinds.SPLIT, kinds.STRATONOVICH)
}
every_solver = pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in FIRST_OF_ITS_KIND else pytest.mark.slow)
        for name in TABLE
    ],
)


@every_solver
def test_every_solver_stays_on_the_manifold(name):
    kind = TABLE[name]
    terms, y0, manifold = PROBLEMS[kind]
    inner = dfx.HalfSolver(dfx.Heun()) if kind == kinds.WRAPPER else public_solvers()[name]()
    adaptive = kind in (kinds.IMPLICIT, kinds.IMEX)
    controller = dfx.PIDController(1e-5, 1e-5) if adaptive else dfx.ConstantStepSize()
    result, drift, moved = solve(terms, manifold, inner, controller, y0)
    assert result == dfx.RESULTS.successful
    assert largest(drift) <= 4e-15
    assert largest(moved) > 1e-2
