"""Laws that every projection obeys, at drawn candidates.

On one system, with both projections; `tests/laws` has laws over all systems of the catalogue.
"""

import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from hypothesis import assume, example, given, settings

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

from ..problems import EPS, KEPLER, OMEGA0, RIGID_BODY, rotational_energy, squared_momentum
from ..thinned import some_of

VALUES = {
    "energy": rotational_energy(0, OMEGA0, None),
    "momentum": squared_momentum(0, OMEGA0, None),
}
PROJECTIONS = {"simplified": dfc.SimplifiedNewton(), "newton": dfc.Newton()}


def vectors(shape, size):
    return dct.states(np.zeros(shape), magnitude=size)


# Near the curve of the rigid body, where both projections must succeed.
near = vectors(3, 0.05).map(lambda d: np.ones(3) + d)
each_projection = pytest.mark.parametrize("projection", list(PROJECTIONS.values()), ids=PROJECTIONS)
one_projection = some_of("projection", PROJECTIONS.values(), ids=PROJECTIONS, period=2)


ENERGY, MOMENTUM = RIGID_BODY.values()
SQUARED_ENERGY = dfc.FirstIntegral(lambda t, y, args: rotational_energy(t, y, args) ** 2)
PLANE = dfc.Constraint(lambda t, y, args: args[0] @ y - args[1])


# Compiled once for each manifold: what is drawn is passed in, never closed over.
@eqx.filter_jit
def project(manifold, y, projection, value=VALUES, t=0.0, args=None):
    return dfc.project(manifold, y, t=t, args=args, value=value, projection=projection)


@eqx.filter_jit
def batch(ys, projection):
    return jax.vmap(lambda y: project(RIGID_BODY, y, projection))(ys)


def successful(info):
    return bool(info.result == optx.RESULTS.successful)


@one_projection
@given(y=near)
def test_a_permuted_duplicated_or_dependent_constraint_changes_nothing(projection, y):
    """The Gram matrix is singular then."""
    plain, _ = project(RIGID_BODY, y, projection)
    for entry, value in [(ENERGY, VALUES["energy"]), (SQUARED_ENERGY, VALUES["energy"] ** 2)]:
        redundant = (MOMENTUM, ENERGY, entry)
        values = (VALUES["momentum"], VALUES["energy"], value)
        y1, info = project(redundant, y, projection, values)
        assert successful(info)
        np.testing.assert_allclose(y1, plain, rtol=0, atol=1e-12)


@given(y=vectors(4, 10.0), matrix=vectors((2, 4), 1.0), b=vectors(2, 10.0), weights=vectors(4, 1.0))
@example(
    y=np.array([0.0, 0.0, 1.0, 0.0]),
    matrix=np.array([[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 1.0, 1.0]]),
    b=np.zeros(2),
    weights=np.zeros(4),
)
@example(
    y=np.array([0.0, 1.0, 0.0, 0.0]),
    matrix=np.array([[1.0, 0.0, 0.0, 0.0], [1.0, 0.5, 0.0, 0.0]]),
    b=np.zeros(2),
    weights=np.array([0.0, 1.0, 0.0, 0.0]),
)
def test_linear_constraints_agree_with_weighted_least_squares(y, matrix, b, weights):
    assume(np.linalg.cond(matrix) < 1e3 and np.linalg.norm(matrix) > 0.1)
    metric = np.exp(weights)
    root = np.sqrt(metric)
    expected = y + np.linalg.lstsq(matrix / root, b - matrix @ y, rcond=None)[0] / root
    for kind in (dfc.SimplifiedNewton, dfc.Newton):
        # Where all components of the solution are zero, each step gains sixteen digits, and it
        # takes some twenty until they are zero.
        projection = kind(metric=metric, rtol=1e-14, max_steps=50)
        projected, info = project(PLANE, y, projection, None, args=(matrix, b))
        assert successful(info)
        np.testing.assert_allclose(projected, expected, rtol=0, atol=1e-9)


@given(y=near, weights=vectors(3, 2.0))
def test_newton_finds_the_nearest_point(y, weights):
    """On a curve: the weighted correction is orthogonal to the tangent, and no point found by
    walking along the curve is nearer."""
    metric = np.exp(weights)
    projected, _ = project(RIGID_BODY, y, dfc.Newton(metric=metric))
    inertia = np.array([0.1, 0.2, 0.3])
    tangent = np.cross(inertia * projected, inertia**2 * projected)
    tangent /= np.linalg.norm(tangent)
    assert abs(np.sum(metric * (projected - y) * tangent)) <= 1e-10
    distance = np.sum(metric * (projected - y) ** 2)
    for step in (-0.01, 0.01):
        other, _ = project(RIGID_BODY, projected + step * tangent, dfc.Newton())
        assert np.sum(metric * (other - y) ** 2) >= distance - 1e-12


@each_projection
@settings(max_examples=8)
@given(seed=st.integers(0, 2**32 - 1), share=st.sampled_from([0.0, 0.01, 0.1, 0.5, 1.0]))
def test_a_lane_of_a_batch_is_that_lane_alone(projection, seed, share):
    """Where some need more iterations, or all do, or none, and some of them fail."""
    rng = np.random.default_rng(seed)
    lanes = 260
    size = np.where(rng.random(lanes) < share, 10 ** rng.uniform(-3, 0.7, lanes), 1e-5)
    ys = 1 + size[:, None] * rng.uniform(-1, 1, (lanes, 3))
    ys[rng.integers(lanes)] = np.nan if share == 0.5 else 1
    batched, info = batch(ys, projection)
    succeeds = np.asarray(info.result == optx.RESULTS.successful)
    for name, entry in RIGID_BODY.items():
        values = np.asarray(jax.vmap(entry.fn, (None, 0, None))(0, batched, None))
        error = np.abs(values - VALUES[name])[succeeds]
        assert np.all(error <= 64 * EPS * np.maximum(VALUES[name], values[succeeds]))
    for i in rng.permutation(lanes)[:40]:
        alone, alone_info = project(RIGID_BODY, ys[i], projection)
        assert succeeds[i] == successful(alone_info)
        if size[i] < 0.05:
            assert succeeds[i] == np.all(np.isfinite(ys[i]))
        if succeeds[i]:
            # A path along fresh gradients, after six along frozen ones, amplifies roundoff.
            tol = 1e-14 if alone_info.num_steps <= 6 else 1e-9
            np.testing.assert_allclose(batched[i], alone, rtol=tol, atol=tol)


@one_projection
def test_inconsistent_constraints_fail(projection):
    _, info = project((ENERGY, ENERGY), OMEGA0, projection, (jnp.array(0.3), jnp.array(0.4)))
    assert not successful(info)
    assert "exclude each other" in str(info)
    _, info = project(
        dfc.Constraint(lambda t, y, args: jnp.sum(y**2) + 1), OMEGA0, projection, None
    )
    assert not successful(info)


@each_projection
def test_a_critical_point_that_satisfies_the_constraint_stays(projection):
    """All gradients vanish."""
    values = {"energy": jnp.array(0.0), "momentum": jnp.array(0.0)}
    projected, info = project(RIGID_BODY, np.zeros(3), projection, values)
    assert successful(info)
    assert np.all(projected == 0)


def test_leaves_of_different_precision_are_refused():
    manifold = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y[0] ** 2) + jnp.sum(y[1] ** 2))
    y = (np.array([1.0, 0.2]), np.array([0.5], np.float32))
    with pytest.raises(TypeError, match="needs one precision"):
        project(manifold, y, dfc.SimplifiedNewton(), jnp.array(1.3))


@pytest.mark.parametrize("more", [0, 3])
@pytest.mark.parametrize("away", [1e-3, 1e-7])
def test_the_gradients_at_each_state_lead_to_a_circular_orbit(more, away):
    """It is a curve, which the plane of those at the candidate may miss. With `more` constraints
    beside those of the orbit the elimination is another, and a few in a hundred do not arrive."""
    rng = np.random.default_rng(0)
    angle, away = rng.uniform(0, 2 * np.pi, 50), away * rng.normal(size=(2, 50, 2))
    q = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    v = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    ys = q + away[0], v + away[1], 1 + np.tile(away[0, :, :1], more)

    def law(name, value):
        return dfc.FirstIntegral(lambda t, y, args: KEPLER[name].fn(t, y[:2], args), value=value)

    manifold = {"energy": law("energy", -0.5), "momentum": law("momentum", 1.0)}
    if more:
        manifold["squares"] = dfc.FirstIntegral(lambda t, y, args: y[2] ** 2, value=np.ones(more))
    ok = lambda y: dfc.project(manifold, y, projection=dfc.SimplifiedNewton())[1].ok  # noqa: E731
    for found in (jax.jit(jax.vmap(ok))(ys), jax.jit(lambda ys: jax.lax.map(ok, ys))(ys)):
        assert np.mean(found) >= (0.95 if more else 1)
