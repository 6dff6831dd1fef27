"""Flow maps of a family of equations, which take `args` as inputs."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

from .. import problems
from ..learned import CORES, Still
from ..problems import refused

BOX = dfc.learned.Box(
    {"w": 0.5, "b": jnp.array([0.0, 0.1])}, {"w": 1.5, "b": jnp.array([0.2, 0.3])}
)
ARGS = {"w": jnp.array(0.8), "b": jnp.array([0.1, 0.2])}
OUTSIDE = {**ARGS, "w": jnp.array(1.6)}
STATES = jr.uniform(jr.key(0), (50, 2), minval=-1, maxval=1)
Y0 = jnp.array([0.5, -0.3])


def spring(t, y, args):
    force = -args["w"] * y[0] - args["b"][0] * y[1] - args["b"][1] * y[0] ** 3
    return jnp.stack([y[1], force])


TERM, END = dfx.ODETerm(spring), dfx.SaveAt(t1=True)


def family(order=0, args_domain=BOX, **options):
    taylor = dfc.learned.Taylor(spring, order) if order else None
    options = dict(width=16, depth=2, core="concatenated", taylor=taylor) | options
    return dfc.DeepONet(STATES, 0.5, args_domain=args_domain, key=jr.key(1), **options)


def sample(key):
    return jr.uniform(key, (2,), minval=-1, maxval=1)


def fit(**options):
    return dfc.fit(family(), spring, key=jr.key(0), **(dict(sample=sample) | options))


@eqx.filter_jit
def solve(flow_map, args, check_field=False, term=TERM, saveat=END, **options):
    solver = dfc.DeepONetSolver(flow_map, check_field=check_field, **options)
    options = dict(saveat=saveat, max_steps=8, throw=False)
    return dfx.diffeqsolve(term, solver, 0.0, 2.0, 0.5, Y0, args, **options)


@pytest.mark.parametrize("order", [0, 1])
@pytest.mark.parametrize("core", CORES)
def test_it_starts_at_its_state_and_sees_all_args(core, order):
    flow_map = family(order, core=core)

    @jax.jit
    def found(h):
        slopes = jax.jacfwd(lambda args: flow_map(Y0, args, h))(ARGS)
        return flow_map(Y0, ARGS, h), flow_map(Y0, h, args=ARGS), slopes

    np.testing.assert_array_equal(found(0.0)[0], Y0)
    one, other, slopes = found(0.3)
    np.testing.assert_array_equal(one, other)
    assert all(np.all(np.abs(leaf) > 0) for leaf in jax.tree.leaves(slopes))


def test_its_polynomial_has_the_args_of_the_call():
    slope = jax.jit(jax.jacfwd(lambda h: family(1)(Y0, ARGS, h)))(0.0)
    np.testing.assert_allclose(slope, spring(0.0, Y0, ARGS), rtol=1e-14)


def test_a_repeated_flow_map_hands_args_on():
    outer = dfc.learned.Repeated(family(), 2)
    inner, twice = eqx.filter_jit(outer.flow_map), eqx.filter_jit(outer)
    expected = inner(inner(Y0, ARGS, 0.2), ARGS, 0.2)
    np.testing.assert_allclose(twice(Y0, ARGS, 0.4), expected, rtol=1e-13)
    y = Y0
    for _ in range(4):
        y = twice(y, ARGS, 0.5)
    np.testing.assert_allclose(solve(outer, ARGS).ys[0], y, rtol=1e-12)


@pytest.mark.slow
def test_derivatives_by_args_are_those_of_differences():
    dct.assert_gradients(lambda a: solve(family(), a).ys[0], ARGS, rtol=1e-7, forward=False)


def test_draws_are_in_the_box_and_everywhere():
    drawn = jax.vmap(BOX.sample)(jr.split(jr.key(3), 1000))
    assert jnp.all(jax.vmap(BOX.contains)(drawn))
    unit = jax.vmap(BOX.centred)(drawn)
    for leaf in jax.tree.leaves(unit):
        np.testing.assert_allclose(jnp.std(leaf, axis=0), 1 / np.sqrt(3), rtol=0.1)
        np.testing.assert_allclose(jnp.mean(leaf, axis=0), 0, rtol=0, atol=0.1)


def test_args_outside_their_domain_are_steps_outside():
    state = dfx.SaveAt(t1=True, solver_state=True)
    inside, outside = (solve(family(), args, saveat=state) for args in (ARGS, OUTSIDE))
    assert dfc.learned.steps_outside(inside).number < 4
    assert dfc.learned.steps_outside(outside).number == 4


@pytest.mark.slow
def test_steps_with_args_outside_fail_or_are_taken_by_another_solver():
    refused = solve(family(), OUTSIDE, outside="fail")
    assert "starts outside the domain" in dfx.RESULTS[refused.result]
    replaced = solve(family(), OUTSIDE, outside=dfx.Tsit5())
    exact = problems.solve(spring, dfx.Tsit5(), Y0, t1=2.0, dt0=0.5, args=OUTSIDE).ys
    np.testing.assert_allclose(replaced.ys, exact, rtol=1e-12)


def test_the_slope_is_compared_for_the_args_of_the_solve():
    assert dfx.is_okay(solve(family(1), ARGS, check_field=True).result)
    other = dfx.ODETerm(lambda t, y, args: 1.2 * spring(t, y, args))
    found = solve(family(1), ARGS, check_field=True, term=other)
    assert "not trained for this vector field" in dfx.RESULTS[found.result]


class Unbounded(Still):
    args_domain: float = 1.0


LAYER = dfc.learned.ConservativeLayer(dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2)))
OWN_ARGS = dfc.learned.Taylor(spring, args=ARGS)


test_mistakes_are_named = refused(
    (lambda: family(args_domain=(0, 1)), "args_domain"),
    (lambda: dfc.DeepONetSolver(Unbounded()), "args_domain"),
    (lambda: family()(Y0, 0.1), r"called as `\(y0, args, h\)`"),
    (lambda: family(args_domain=None)(Y0, ARGS, 0.1), r"called as `\(y0, h\)`"),
    (lambda: family()(Y0, jnp.ones(3), 0.1), "takes `args` of the structure"),
    (lambda: solve(family(), ARGS | {"b": jnp.ones(3)}), "takes `args` of the structure"),
    (lambda: family(layer=LAYER), "cannot have a `layer`"),
    (lambda: family(taylor=OWN_ARGS), "`taylor` has `args` of its own"),
    (lambda: fit(args=ARGS), "draws them from its `args_domain`"),
)
