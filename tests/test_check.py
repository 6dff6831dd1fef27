"""`check_invariance` accepts what is conserved, and finds what is not."""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_conserve as dfc
from diffrax_conserve import check_invariance, systems

from .problems import refused


@pytest.mark.parametrize(
    ("name", "printed"),
    [
        ("rigid-body", lambda t, w, args: (w[0] ** 2 + w[1] ** 2 + w[2] ** 3) / 2),
        # The sum from 0 to N has one term too many.
        pytest.param(
            "point-vortices", lambda t, y, args: jnp.sum(y[:, 0]) + y[-1, 0], marks=pytest.mark.slow
        ),
    ],
)
def test_it_finds_misprints_of_the_paper(name, printed):
    system = systems.get(name)
    manifold = system.manifold | {"printed": dfc.FirstIntegral(printed)}
    for entry in check_invariance(system.vector_field, manifold, system.sample).entries:
        assert entry.ok == (entry.name != "printed")
        assert entry.ok or entry.defect > 1e-2


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16, jnp.float32])
def test_no_precision_takes_a_wrong_integral_for_conserved(dtype):
    laws = [lambda t, y, args: y @ y, lambda t, y, args: 2 * y[0] + y[1]]
    turn, ys = lambda t, y, args: jnp.stack([y[1], -y[0]]), jr.normal(jr.key(0), (5, 2), dtype)
    report = check_invariance(turn, [*map(dfc.FirstIntegral, laws)], ys)
    assert [entry.ok for entry in report.entries] == [True, False]


def test_the_defect_is_relative_to_the_size_of_the_terms():
    """dI/dt = y₁ y₂ (1 + c), of which the terms have the sizes |y₁ y₂| and |c y₁ y₂|."""
    integral = dfc.FirstIntegral(lambda t, y, args: (y[0] ** 2 + y[1] ** 2) / 2)
    ys = jr.normal(jr.key(0), (5, 2))
    for c, defect in [(-0.5, 0.5 / 1.5), (-1.0, 0.0)]:
        report = check_invariance(lambda t, y, c: jnp.stack([y[1], c * y[0]]), integral, ys, args=c)
        np.testing.assert_allclose(report.entries[0].defect, defect, rtol=0, atol=1e-15)


def test_the_worst_state_of_a_batch_is_named():
    system = systems.RigidBody()
    ys = jnp.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 2.0, 3.0]])  # two steady rotations
    wrong = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**4))
    for bad in (ys, ys.at[2].set(jnp.nan)):
        report = check_invariance(system.vector_field, wrong, bad)
        assert (report.ok, report.num_states, report.entries[0].state) == (False, 3, 2)
        assert "NOT conserved, see state 2" in str(report)


@pytest.mark.parametrize("metres", [1.0, 1e11])
def test_states_at_rest_test_nothing_in_any_units(metres):
    """A position, a mass and a speed, of which the last is zero at every state."""
    wrong = dfc.FirstIntegral(lambda t, y, args: jnp.sqrt(y[1]) * y[2] ** 2)
    ys = jnp.array([[1.0, 2.0, 0.0], [1.5, 1.0, 0.0]]) * jnp.array([metres, 1.0, 1.0])
    report = check_invariance(lambda t, y, args: jnp.stack([y[2], 0.0, 9.8]), wrong, ys)
    assert not report.ok
    assert "NOT TESTED" in str(report)


def test_explicit_time_is_part_of_the_derivative():
    def f(t, y, args):
        return y

    def integral(t, y, args):
        return y * jnp.exp(-t)

    ys = jnp.linspace(1.0, 2.0, 7)
    assert check_invariance(f, dfc.FirstIntegral(integral), ys, t=jnp.linspace(0.0, 3.0, 7)).ok
    report = check_invariance(f, dfc.FirstIntegral(lambda t, y, a: y), ys, t=1.0)
    assert not report.ok
    timed = dfc.FirstIntegral(lambda t, y, args: y * (2 + jnp.cos(t)) * jnp.exp(-t))
    with pytest.raises(ValueError, match=r"`manifold` is conserved at t = 0, .* Give one time"):
        check_invariance(f, timed, ys)
    moving = dfc.Constraint(lambda t, y, args: y**2 - t**2)  # not conserved off the manifold
    assert check_invariance(lambda t, y, args: jnp.ones_like(y), moving, jnp.ones(3), t=1.0).ok


def test_constraints_are_checked_where_they_hold():
    system = systems.CartesianPendulum()
    right = check_invariance(system.vector_field, system.manifold, system.sample)
    assert right.ok
    assert {entry.kind for entry in right.entries} == {"constraint", "first integral"}

    def without_tension(t, y, args):
        return y[1], jnp.array([0.0, -1.0])

    wrong = check_invariance(without_tension, system.manifold, system.sample)
    assert {e.name: e.ok for e in wrong.entries} == {
        "rod length": True,
        "velocity constraint": False,
        "energy": True,
    }


def test_forces_that_cancel_up_to_roundoff_conserve():
    """Their sum is all roundoff, which is of its own size."""

    def vector_field(t, y, args):
        force = jnp.sin(3 * (y[0] - y[1])) * jnp.array([1.0, 0.1 + 0.2])
        return jnp.array([y[2], 0.0, force[1] - 0.3 * force[0]])

    ys = jr.normal(jr.key(0), (100, 3))
    assert np.any(jax.vmap(lambda y: vector_field(0.0, y, None)[2])(ys) != 0)
    assert check_invariance(vector_field, dfc.FirstIntegral(lambda t, y, args: y[2]), ys).ok
    moving = dfc.FirstIntegral(lambda t, y, args: y[1] + y[0])
    assert not check_invariance(vector_field, moving, ys).ok


KEPT = dfc.FirstIntegral(lambda t, y, args: y[0])
PENDULUM, OFF = systems.CartesianPendulum(), (jnp.ones((4, 2)), jnp.ones((4, 2)))
NO_BATCH = [jnp.array(1.0), jnp.zeros((0, 3)), (jnp.ones(3), jnp.ones(4)), jnp.ones(3, int), ()]


def of(field, ys=jnp.ones((4, 3)), manifold=KEPT):
    return lambda: check_invariance(field, manifold, ys)


test_mistakes_are_named = refused(
    *((of(lambda t, y, a: y, ys), ValueError, "`states` must be a sampler") for ys in NO_BATCH),
    (of(lambda t, y, a: y[0]), ValueError, r"structure \(\), but.*has \(3,\)"),
    (of(lambda t, y, a: y[:2]), ValueError, "must return a PyTree like `y`"),
    (of(lambda t, y, a: (y, y)), ValueError, "must return a PyTree like `y`"),
    # That of the function itself, with a note.
    (of(lambda t, y, a: jnp.stack([y[1], y[0]]), jnp.ones(2)), IndexError, "For one state `y` wr"),
    (
        of(PENDULUM.vector_field, OFF, PENDULUM.manifold),
        ValueError,
        "`rod length` is not zero at s",
    ),
)
