"""Reactions as differential equations, what they conserve, and the two stiff problems."""

import itertools
import re

import equinox as eqx
import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optimistix as optx
import pytest
import scipy.linalg
from hypothesis import assume, given, settings

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


# ---- Positive weights ----


def of_columns(change):
    """A mechanism with these changes, a column for each reaction."""
    side = lambda numbers: " + ".join(f"{n} X{i}" for i, n in enumerate(numbers) if n > 0)  # noqa: E731
    reactions = [f"{side(-column)} -> {side(column)}" for column in change.T]
    names = [f"X{i}" for i in range(len(change))]
    return Mechanism(reactions, np.ones(len(reactions)), species=names)


def weights_of(mechanism):
    """The weights, which are checked to be a basis of all balances, by integers."""
    change = mechanism.stoichiometry
    weights = [b.weights for b in mechanism.balances.values()]
    weights = np.array(weights, int).reshape(-1, len(change))
    assert not np.any(weights @ change)
    assert len(weights) == np.linalg.matrix_rank(weights)
    assert len(weights) + np.linalg.matrix_rank(change) == len(change)
    return weights


def edges(change):
    """All edges of the cone of the balances without negative weights, by the algorithm of Farkas
    (J. Martinez and M. Silva, "A simple and fast algorithm to obtain all invariants of a
    generalised Petri net", 1982)."""
    rows = [(tuple(c), tuple(e)) for c, e in zip(change, np.eye(len(change), dtype=int))]  # noqa: B905
    for j in range(change.shape[1]):
        kept = {row for row in rows if row[0][j] == 0}
        for a in (row for row in rows if row[0][j] > 0):
            for b in (row for row in rows if row[0][j] < 0):
                both = -b[0][j] * np.concatenate(a) + a[0][j] * np.concatenate(b)
                both = both // np.gcd.reduce(both)
                kept.add((tuple(both[: change.shape[1]]), tuple(both[change.shape[1] :])))
        support = lambda row: {i for i, w in enumerate(row[1]) if w}  # noqa: E731
        rows = [x for x in kept if not any(support(y) < support(x) for y in kept)]
    return np.array([w for _, w in rows]).reshape(-1, len(change))


def kernel(weights):
    """An integer basis of the vectors with `weights @ vector = 0`: for each column
    outside of a regular block, by Cramer's rule."""
    n = len(weights)
    pivots = next(
        list(p)
        for p in itertools.combinations(range(weights.shape[1]), n)
        if round(np.linalg.det(weights[:, p]))
    )
    inner = weights[:, pivots]
    scale = round(np.linalg.det(inner))
    change = np.zeros((weights.shape[1], weights.shape[1] - n), int)
    for k, j in enumerate(set(range(weights.shape[1])) - set(pivots)):
        change[j, k] = scale
        change[pivots, k] = -np.rint(scale * np.linalg.solve(inner, weights[:, j])).astype(int)
    return change


few = st.integers(0, 2)
small = st.integers(1, 3).flatmap(
    lambda n: hnp.arrays(int, st.tuples(st.just(n), st.integers(n + 1, 7)), elements=few)
)
changes = hnp.arrays(
    int, st.tuples(st.integers(2, 6), st.integers(1, 4)), elements=st.integers(-2, 2)
)


@settings(max_examples=60)
@given(small, st.randoms(use_true_random=False))
def test_balances_with_positive_weights_are_found_where_there_are_any(weights, random):
    """Reactions that keep a chosen positive basis, and only that."""
    assume(np.linalg.matrix_rank(weights) == len(weights))
    change = kernel(weights)
    mixing = np.tril([[random.randint(-1, 1) for _ in change.T] for _ in change.T], -1)
    mechanism = of_columns(change @ (mixing + np.eye(len(mixing), dtype=int)))
    found = weights_of(mechanism)
    assert found.min() >= 0
    assert np.linalg.matrix_rank(np.concatenate([weights, found])) == len(weights) == len(found)
    mechanism.positive_projection()


@settings(max_examples=60)
@given(changes)
def test_a_mechanism_is_refused_only_if_it_has_no_positive_basis(change):
    """Against an enumeration. What is named occurs in no balance without negative weights."""
    mechanism = of_columns(change)
    found, all_edges = weights_of(mechanism), edges(change)
    assume(len(found))
    most = np.linalg.matrix_rank(all_edges) if len(all_edges) else 0
    assert sum(w.min() >= 0 for w in found) == most
    if most == len(found):
        mechanism.positive_projection()
    else:
        with pytest.raises(ValueError, match="negative weights") as error:
            mechanism.positive_projection()
        named = set(re.search(": (.*) occur in", str(error.value))[1].split(", "))
        absent = found.any(axis=0) & ~all_edges.any(axis=0)
        assert named == {f"X{i}" for i in np.flatnonzero(absent)} != set()


@pytest.mark.parametrize(
    ("reactions", "positive"),
    [
        (
            ["X + Y -> Z", "Z -> X + Y", "Q + Y -> Z2", "Z2 -> W"],
            [{"X": 1, "Z": 1}, {"Q": 1, "Z2": 1, "W": 1}, {"Y": 1, "Z": 1, "Z2": 1, "W": 1}],
        ),
        (
            ["A + B -> AB", "AB + B -> ABB", "AB -> H", "H -> I + W", "I + W -> IW"],
            [
                {"A": 1, "AB": 1, "ABB": 1, "H": 1, "I": 1, "IW": 1},
                {"B": 1, "AB": 1, "ABB": 2, "H": 1, "I": 1, "IW": 1},
                {"A": 1, "AB": 1, "ABB": 1, "H": 1, "W": 1, "IW": 1},
            ],
        ),
    ],
    ids=["Q needs another order", "none is positive at first"],
)
def test_closed_mechanisms(reactions, positive):
    mechanism = Mechanism(reactions, np.ones(len(reactions)))
    known = np.array([[w.get(name, 0) for name in mechanism.species] for w in positive])
    found = weights_of(mechanism)
    assert found.min() >= 0
    assert found.max() <= 2
    assert np.linalg.matrix_rank(np.concatenate([known, found])) == len(known)
    mechanism.positive_projection()


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
    (lambda: Mechanism(["A + B -> "], [1.0]).positive_projection(), ValueError, "SimplifiedNewton"),
    (  # Its balances are X + Y and A - B.
        lambda: Mechanism(["A + B -> ", "X -> Y"], [1.0, 1.0]).positive_projection(),
        ValueError,
        "negative weights.*: A, B occur in no balance.*SimplifiedNewton",
    ),
    (lambda: Mechanism(["-> A"], [1.0]).positive_projection(), ValueError, "No balance"),
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
