"""A flow map is refused for an equation that it was not trained for."""

import dataclasses

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_conserve as dfc

from ..learned import LORENZ, states
from ..thinned import some_of

TAYLOR = dfc.DeepONet(
    states(), 0.25, width=6, depth=1, key=jr.key(0),
    core=dfc.learned.Concatenated, taylor=dfc.learned.Taylor(LORENZ.vector_field),
)  # fmt: skip
MESSAGE = "not trained for this vector field"


@eqx.filter_jit
def end(solver, system, y0):
    term = dfx.ODETerm(system.vector_field)
    return dfx.diffeqsolve(term, solver, 0.0, 0.5, 0.25, y0).ys[-1]


OTHER = dfc.systems.ConservativeLorenz(sigma=1.01)
SOLVER = dfc.DeepONetSolver(TAYLOR)


def test_another_parameter_is_refused(errors_raise):
    end(SOLVER, LORENZ, LORENZ.y0)
    with pytest.raises(RuntimeError, match=MESSAGE):
        end(SOLVER, OTHER, LORENZ.y0)
    off = dfc.DeepONetSolver(TAYLOR, check_field=False)
    np.testing.assert_array_equal(end(off, OTHER, LORENZ.y0), end(SOLVER, LORENZ, LORENZ.y0))


def test_one_lane_of_a_batch_is_refused_alone():
    @eqx.filter_jit
    def result(y0, sigma):
        system = dataclasses.replace(LORENZ, sigma=sigma)
        term = dfx.ODETerm(system.vector_field)
        return dfx.diffeqsolve(term, SOLVER, 0.0, 0.5, 0.25, y0, throw=False).result

    found = jax.vmap(result)(states(4), jnp.array([1.0, 1.0, 1.5, 1.0]))
    okay = found == dfx.RESULTS.successful
    np.testing.assert_array_equal(okay, [True, True, False, True])
    assert MESSAGE in dfx.RESULTS[jax.tree.map(lambda x: x[2], found)]


def test_it_is_not_differentiated():
    off = dfc.DeepONetSolver(TAYLOR, check_field=False)
    slope = jax.vmap(jax.grad(lambda solver, y0: jnp.sum(end(solver, LORENZ, y0)), 1), (None, 0))
    on, without = (eqx.filter_jit(slope)(solver, states(3)) for solver in (SOLVER, off))
    np.testing.assert_allclose(on, without, rtol=1e-12)


def test_a_state_at_rest_is_not_refused():
    rest = jnp.zeros(3)
    np.testing.assert_array_equal(LORENZ.vector_field(0.0, rest, None), rest)
    end(SOLVER, OTHER, rest)


def refused(name, system, y0s):
    """How many of the states are refused."""
    solver, term = dfc.DeepONetSolver(dfc.load_pretrained(name)), dfx.ODETerm(system.vector_field)
    init = lambda y0: solver.init(term, 0.0, 0.1, y0, None).refused  # noqa: E731
    return int(jnp.sum(eqx.filter_jit(jax.vmap(init))(y0s) > 0))


NAMES = [
    *(name + kind for name in dfc.systems.names()[2:5] for kind in ("", "-standard")),
    *("kepler", "pollu", "robertson"),
]


@some_of("name", NAMES, ids=NAMES, period=4)
def test_a_shipped_flow_map_is_for_its_own_system(name):
    """At every state of its domain, also those whose slope is learned."""
    system = dfc.systems.get(name.removesuffix("-standard"))
    assert refused(name, system, states(1000, system, seed=5)) == 0


def test_a_stiff_field_is_not_compared_where_it_changes_within_a_step():
    """States within a factor of three of those of POLLU six minutes after the emission."""
    pollu = dfc.systems.get("pollu")
    y0 = pollu.reference(jnp.array([6.0]))[0]
    near = y0 * 3.0 ** jr.uniform(jr.key(0), (1000, 20), minval=-1.0, maxval=1.0)
    assert refused("pollu", pollu, near) == 0
    assert refused("pollu", pollu, y0[None]) == 0


def test_a_learned_slope_is_refused_where_it_is_nothing_like_the_field(errors_raise):
    solver = dfc.DeepONetSolver(dfc.load_pretrained("double-pendulum-standard"))
    end(solver, dfc.systems.DoublePendulum(), dfc.systems.DoublePendulum().y0)
    with pytest.raises(RuntimeError, match="not trained for this vector field"):
        end(solver, dfc.systems.DoublePendulum(gravity=1.0), dfc.systems.DoublePendulum().y0)
