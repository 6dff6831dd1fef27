"""Without options `fit` does what the guide advises."""

import dataclasses

import equinox as eqx
import jax.random as jr
import numpy as np
import pytest

import diffrax_conserve as dfc

from ..learned import LORENZ, flow_map, states

KEY = jr.key(5)


def stiff(t, y, args):
    return -1e4 * y


def recipe(network, **options):
    found = dfc.learned.second_order(network, epochs=8)
    return dataclasses.replace(found, **(dict(points=10, check_every=4) | options))


def trained(field=LORENZ.vector_field, **options):
    network = flow_map()
    return dfc.fit(network, field, key=KEY, recipe=recipe(network, **options))[0]


def test_a_flow_map_gets_the_slope_of_the_field():
    network = trained()
    assert isinstance(network.core, dfc.learned.Concatenated)
    y = states(1)[0]
    slope = LORENZ.vector_field(0.0, y, None)
    np.testing.assert_allclose(network.slope(y), slope, rtol=1e-12)


@pytest.mark.parametrize(
    ("field", "options"), [(stiff, dict()), (LORENZ.vector_field, dict(taylor=0))]
)
def test_it_gets_none_where_that_would_harm_or_is_not_wanted(field, options):
    assert trained(field, **options).taylor is None


def test_it_goes_on_bit_for_bit_from_between_two_comparisons():
    network = flow_map()
    chosen = recipe(network, epochs=400, check_every=100)
    options = dict(key=KEY, sample=LORENZ.sample, recipe=chosen)
    whole, log = dfc.fit(network, LORENZ.vector_field, **options)
    state, seconds = None, 0.02
    for _ in range(100):
        model, stopped = dfc.fit(
            network, LORENZ.vector_field, **options, state=state, seconds=seconds
        )
        if stopped.ended != "seconds":
            break
        state, seconds = stopped.state, 2 * seconds
    assert eqx.tree_equal(model, whole)
    np.testing.assert_array_equal(stopped.losses, log.losses)
    np.testing.assert_array_equal(stopped.criteria, log.criteria)
