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

TAYLOR = dfc.DeepONet(
    states(), 0.25, width=6, depth=1, key=jr.key(0),
    core=dfc.learned.Concatenated, taylor=dfc.learned.Taylor(LORENZ.vector_field),
)  # fmt: skip
MESSAGE = (
    "not trained for this vector field: .* slope for h -> 0 has the norm {} the vector field {}"
)


@eqx.filter_jit
def end(solver, system, y0):
    term = dfx.ODETerm(system.vector_field)
    return dfx.diffeqsolve(term, solver, 0.0, 0.5, 0.25, y0).ys[-1]


def numbers(system, y0):
    slope = jnp.linalg.norm(LORENZ.vector_field(0.0, y0, None))
    field = jnp.linalg.norm(system.vector_field(0.0, y0, None))
    return MESSAGE.format(f"{float(slope):.6g},", f"{float(field):.6g},")


OTHER = dfc.systems.ConservativeLorenz(sigma=1.01)
SOLVER = dfc.DeepONetSolver(TAYLOR)


def test_another_parameter_is_refused_with_both_numbers(errors_raise):
    end(SOLVER, LORENZ, LORENZ.y0)
    with pytest.raises(RuntimeError, match=numbers(OTHER, LORENZ.y0)):
        end(SOLVER, OTHER, LORENZ.y0)
    off = dfc.DeepONetSolver(TAYLOR, check_field=False)
    np.testing.assert_array_equal(end(off, OTHER, LORENZ.y0), end(SOLVER, LORENZ, LORENZ.y0))


def test_one_lane_of_a_batch_is_enough(errors_raise):
    y0s = states(4)
    batch = jax.vmap(lambda y0, sigma: end(SOLVER, dataclasses.replace(LORENZ, sigma=sigma), y0))
    batch(y0s, jnp.ones(4))
    with pytest.raises(RuntimeError, match=numbers(dfc.systems.ConservativeLorenz(1.5), y0s[2])):
        jax.block_until_ready(batch(y0s, jnp.array([1.0, 1.0, 1.5, 1.0])))


@pytest.mark.parametrize("batched", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_it_is_not_differentiated(batched):
    off = dfc.DeepONetSolver(TAYLOR, check_field=False)

    def total(solver, y0):
        return jnp.sum(end(solver, LORENZ, y0))

    slope, y0 = jax.grad(total, 1), LORENZ.y0
    if batched:
        slope, y0 = jax.vmap(slope, (None, 0)), states(3)
    on, without = (eqx.filter_jit(slope)(solver, y0) for solver in (SOLVER, off))
    np.testing.assert_allclose(on, without, rtol=1e-12)


def test_a_state_at_rest_is_not_refused():
    rest = jnp.zeros(3)
    np.testing.assert_array_equal(LORENZ.vector_field(0.0, rest, None), rest)
    end(SOLVER, OTHER, rest)


@pytest.mark.parametrize(
    "name",
    [
        "conservative-lorenz",
        *(pytest.param(n, marks=pytest.mark.slow) for n in ("double-pendulum", "point-vortices")),
    ],
)
def test_the_zoo_is_for_its_own_systems(name):
    """Also the networks of the paper, whose slope is learned; one in hundreds is too far off."""
    system = dfc.systems.get(name)
    y0s = jax.vmap(system.sample)(jr.split(jr.key(0), 50))
    for suffix in ("", "-standard"):
        solver = dfc.DeepONetSolver(dfc.load_pretrained(name + suffix))
        jax.block_until_ready(jax.vmap(lambda y0, s=solver: end(s, system, y0))(y0s))


def test_a_learned_slope_is_refused_where_it_is_nothing_like_the_field(errors_raise):
    solver = dfc.DeepONetSolver(dfc.load_pretrained("double-pendulum-standard"))
    end(solver, dfc.systems.DoublePendulum(), dfc.systems.DoublePendulum().y0)
    with pytest.raises(RuntimeError, match="not trained for this vector field"):
        end(solver, dfc.systems.DoublePendulum(gravity=1.0), dfc.systems.DoublePendulum().y0)
