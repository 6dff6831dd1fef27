"""Laws of projections part by part, and of complex states."""

import equinox as eqx
import hypothesis.strategies as st
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings

import diffrax_conserve as dfc

numbers = st.lists(st.floats(-1, 1), min_size=3, max_size=3).map(np.array)
WEIGHTS = jnp.array([1.0, 2.0, 3.0])
WEIGHTED = dfc.FirstIntegral(lambda t, y, args: jnp.sum(WEIGHTS * jnp.abs(y) ** 2))


@eqx.filter_jit
def projected(y, metric):
    projection = dfc.SimplifiedNewton(metric=metric)
    return dfc.project(WEIGHTED, y, value=6.0, projection=projection)


@settings(max_examples=15)
@given(numbers, numbers, numbers)
def test_phases_of_complex_components_commute_with_the_projection(re, im, phases):
    """Rotations of planes in which both weights are the same."""
    y = 1 + 0.2 * re + 0.2j * im
    turn = np.exp(1j * phases)
    (plain, info), (turned, _) = (projected(z, jnp.array([1.0, 5.0, 2.0])) for z in (y, turn * y))
    if info.ok:
        np.testing.assert_allclose(turned, turn * plain, rtol=1e-13)


PARTS = {
    "a": dfc.Constraint(lambda t, y, args: jnp.sum(y[0] ** 2) - 3),
    "b": dfc.Constraint(lambda t, y, args: jnp.sum(y[1] ** 4) - 3),
}
SIMPLIFIED = dfc.SimplifiedNewton()
STAGED = dfc.Staged(("b", SIMPLIFIED), ("a", SIMPLIFIED))


@eqx.filter_jit
def both(y):
    return [dfc.project(PARTS, y, projection=p) for p in (SIMPLIFIED, STAGED)]


@settings(max_examples=15)
@given(numbers, numbers)
def test_stages_that_share_no_component_are_the_joint_projection(a, b):
    together, staged = both((1 + 0.2 * a, 1 + 0.2 * b))
    if together[1].ok and staged[1].ok:
        for x, z in zip(together[0], staged[0], strict=True):
            np.testing.assert_allclose(x, z, rtol=1e-12)
