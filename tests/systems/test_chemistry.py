"""Reactions as differential equations, what they conserve, and the two stiff problems."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optimistix as optx
import pytest
import scipy.linalg

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct
from diffrax_conserve.systems import Mechanism

from ..problems import refused

STIFF = {name: dfc.systems.get(name) for name in dfc.systems.names(stiff=True)}

# F. Mazzia and C. Magherini, Test Set for Initial Value Problem Solvers.
POLLU_60 = [
    0.5646255480022769e-01, 0.1342484130422339e00, 0.4139734331099427e-08, 0.5523140207484359e-02,
    0.2018977262302196e-06, 0.1464541863493966e-06, 0.7784249118997964e-01, 0.3245075353396018e00,
    0.7494013383880406e-02, 0.1622293157301561e-07, 0.1135863833257075e-07, 0.2230505975721359e-02,
    0.2087162882798630e-03, 0.1396921016840158e-04, 0.8964884856898295e-02, 0.4352846369330103e-17,
    0.6899219696263405e-02, 0.1007803037365946e-03, 0.1772146513969984e-05, 0.5682943292316392e-04,
]  # fmt: skip
ROBERTSON_40 = [0.7158270688, 9.185534765e-6, 0.2841637457]
WEIGHTS = np.array([b.weights for b in STIFF["pollu"].mechanism.balances.values()])


@pytest.mark.slow
def test_references_are_those_of_the_test_set():
    found = STIFF["pollu"].reference([0.0, 60.0])[-1]
    np.testing.assert_allclose(found, POLLU_60, rtol=1e-9)
    found = STIFF["robertson"].reference([0.0, 40.0])[-1]
    np.testing.assert_allclose(found, ROBERTSON_40, rtol=1e-7)


def test_the_balances_of_pollu_are_its_elements():
    assert list(STIFF["pollu"].manifold) == [
        "HCHO + CO + 2 ALD + MEO2 + 2 C2O3 + CO2 + 2 PAN + CH3O",
        "SO2 + SO4",
        "NO2 + NO + PAN + HNO3 + NO3 + 2 N2O5",
    ]


@pytest.mark.parametrize("seed", range(12))
def test_the_balances_are_the_left_null_space(seed):
    """Of random reactions, against a singular value decomposition."""
    rng = np.random.default_rng(seed)
    names = [f"X{i}" for i in range(rng.integers(2, 9))]

    def side():
        chosen = rng.choice(names, rng.integers(1, 4))
        return " + ".join(f"{rng.integers(1, 4)} {name}" for name in chosen)

    reactions = [f"{side()} -> {side()}" for _ in range(rng.integers(1, 7))]
    mechanism = Mechanism(reactions, np.ones(len(reactions)), species=names)
    found = np.array([b.weights for b in mechanism.balances.values()]).reshape(-1, len(names))
    expected = scipy.linalg.null_space(mechanism.stoichiometry.T)
    assert not np.any(found @ mechanism.stoichiometry)
    assert np.linalg.matrix_rank(found) == len(found) == expected.shape[1]


def test_the_law_of_mass_action():
    mechanism = Mechanism(["2 A + B -> 3 C", "C -> ", "-> A"], [2.0, 3.0, 5.0])
    a, b, c = y = np.array([0.3, 0.7, 1.1])
    first, second = 2 * a**2 * b, 3 * c
    expected = [-2 * first + 5, -first, 3 * first - second]
    np.testing.assert_allclose(mechanism.vector_field(0.0, jnp.array(y), None), expected)
    assert mechanism.manifold == {}
    np.testing.assert_array_equal(mechanism.state({"C": 2.0}), [0, 0, 2])


def test_rates_are_a_function_of_time_state_and_arguments():
    """Against the same reactions with these numbers as rates."""
    reactions, y = ["2 A + B -> 3 C", "C -> "], jnp.array([0.3, 0.7, 1.1])
    varying = Mechanism(reactions, lambda t, y, args: jnp.stack([args * t, 1 + y[1]]))
    found = varying.vector_field(2.0, y, 5.0)
    np.testing.assert_allclose(found, Mechanism(reactions, [10.0, 1.7]).vector_field(0.0, y, None))
    assert list(Mechanism(["A -> 2 B"], lambda t, y, args: [t]).manifold) == ["2 A + B"]


test_mistakes_are_named = refused(
    (lambda: Mechanism(["A = B"], [1.0]), ValueError, "cannot be read"),
    (lambda: Mechanism(["A -> B -> C"], [1.0]), ValueError, "cannot be read"),
    (lambda: Mechanism(["1.5 A -> B"], [1.0]), ValueError, "cannot be read"),
    (lambda: Mechanism(["A -> B"], [1.0, 2.0]), ValueError, "1 `reactions`"),
    (
        lambda: Mechanism(["A -> B"], lambda t, y, args: y).vector_field(0, np.ones(2), 0),
        ValueError,
        "1 `reactions`",
    ),
    (
        lambda: Mechanism(["A -> B"], [1.0], species=["A"]),
        ValueError,
        "must name each species once",
    ),
    (lambda: Mechanism(["A -> B"], [1.0]).state({"X": 1.0}), ValueError, "no species X"),
    # Its balance is A - B, which has signs.
    (lambda: Mechanism(["A + B -> "], [1.0]).positive_projection(), ValueError, "SimplifiedNewton"),
)


# ---- A projection without negative concentrations ----

PROJECTION = STIFF["pollu"].mechanism.positive_projection()


@eqx.filter_jit
@eqx.filter_vmap
def moved_back(y, noise):
    system = STIFF["pollu"]
    value = jax.tree.map(lambda entry: entry.fn(0.0, y, None), system.manifold,
                         is_leaf=lambda x: isinstance(x, dfc.FirstIntegral))  # fmt: skip
    return dfc.project(system.manifold, y * noise, value=value, projection=PROJECTION)


def test_no_concentration_is_negative_and_the_balances_hold():
    """Many states, up to a factor of two off, with species that are negative.

    Where the negative one holds nearly all of an element, the projection may fail, and says so.
    """
    keys, count = jr.split(jr.key(0), 4), 10**4
    y = jnp.array(POLLU_60) * jnp.exp(jr.normal(keys[0], (count, 20)))
    noise = jnp.exp(jr.uniform(keys[1], (count, 20), minval=-0.7, maxval=0.7))
    noise = jnp.where(jr.uniform(keys[2], (count, 20)) < 0.02, -0.1, noise)
    found, info = moved_back(y, noise)
    assert float(jnp.min(found)) >= 0
    good = info.result == optx.RESULTS.successful
    assert float(jnp.mean(good)) > 0.95
    assert bool(jnp.all(good | jnp.any(noise < 0, axis=1)))
    off = jnp.max(jnp.abs(found @ WEIGHTS.T / (y @ WEIGHTS.T) - 1), axis=1)
    positive = jnp.all(noise > 0, axis=1)
    assert float(jnp.max(jnp.where(positive, off, 0))) < 4e-15
    assert float(jnp.max(jnp.where(good, off, 0))) < 2e-14


def test_it_is_the_nearest_state_in_relative_entropy():
    """Its gradient is in the space of the balances, so no other state on them is nearer."""
    y = jnp.array(POLLU_60)
    noise = jnp.exp(0.2 * jr.normal(jr.key(5), (1, 20)))
    found, _ = moved_back(y[None], noise)
    gradient = jnp.log(found[0] / (y * noise[0]))
    coefficients, *_ = np.linalg.lstsq(WEIGHTS.T, gradient)
    np.testing.assert_allclose(WEIGHTS.T @ coefficients, gradient, rtol=0, atol=1e-12)


def test_its_derivatives_are_those_of_what_it_computes():
    y = jnp.array(POLLU_60)
    noise = jnp.exp(0.1 * jr.normal(jr.key(6), (20,)))

    def found(log_noise):
        return moved_back(y[None], jnp.exp(log_noise)[None])[0][0] / y

    dct.assert_gradients(found, jnp.log(noise), rtol=1e-6)
