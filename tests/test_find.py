"""`find_invariants` finds what is known to be conserved, and nothing else."""

import functools as ft

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_conserve as dfc
from diffrax_conserve import find_invariants, systems

from .problems import refused
from .thinned import some_of


def normal(size):
    return lambda key: jr.normal(key, (size,))


def component(i):
    return lambda y: y[i]


def monomials(*names):
    """Products of `q1`, `q2`, `p1`, `p2` and powers of the radius for Kepler's problem."""
    part = {"q1": (0, 0), "q2": (0, 1), "p1": (1, 0), "p2": (1, 1)}

    def value(name, y):
        r = jnp.sqrt(jnp.sum(y[0] ** 2))
        factors = [1 / r if x == "/r" else y[part[x][0]][part[x][1]] for x in name.split()]
        return ft.reduce(jnp.multiply, factors)

    return {name: ft.partial(value, name) for name in names}


KEPLER = systems.Kepler()
KEPLER_BASIS = monomials(
    *("p1 p1", "p2 p2", "p1 p2", "/r", "q1 p1", "q1 p2", "q2 p1", "q2 p2", "q1", "q2", "q1 /r"),
    *("q2 /r", "q1 p1 p1", "q1 p2 p2", "q1 p1 p2", "q2 p1 p1", "q2 p2 p2", "q2 p1 p2", "p1", "p2"),
)
LOTKA_VOLTERRA = {"u": component(0), "v": component(1), "uv": lambda y: y[0] * y[1]} | {
    f"log {name}": ft.partial(lambda y, i: jnp.log(y[i]), i=i) for i, name in enumerate("uv")
}
POLLU, ROBERTSON = systems.Pollu(), systems.Robertson()
NITROGEN = systems.Mechanism(["NO + O3 -> NO2", "NO2 -> NO + O3", "2 NO2 -> N2O4"], [26.6, 0.3, 9])


def sparse(size):
    """Many concentrations are zero, so that slow reactions show without fast ones."""
    return lambda key: jr.uniform(key, (size,)) * jr.bernoulli(jr.split(key)[0], 0.3, (size,))


def species(mechanism):
    return {name: component(i) for i, name in enumerate(mechanism.species)}


def with_angle(key):
    return jr.normal(key, (2,)) * jnp.array([2.0, 1.0])


def two_level(t, y, args):
    return -1j * jnp.array([[1.0, 0.3], [0.3, -1.0]]) @ y


def amplitudes(key):
    return jax.lax.complex(*jr.normal(key, (2, 2)))


def pendulum(t, y, args):
    return jnp.stack([y[1], -jnp.sin(y[0])])


PENDULUM = {"v^2": lambda y: y[1] ** 2, "v": component(1), "sin(q)": lambda y: jnp.sin(y[0])}
PENDULUM["cos(q)"] = lambda y: jnp.cos(y[0])

# The field, states, the basis, how many integrals there are, and some that are known.
FOUND = {
    name: (system.vector_field, system.sample, basis, count, system.manifold)
    for name, system, basis, count in [
        ("harmonic oscillator", systems.HarmonicOscillator(), 4, 1),
        ("rigid body", systems.RigidBody(), 4, 2),
        ("conservative Lorenz", systems.ConservativeLorenz(), 3, 2),
        ("Kepler", KEPLER, KEPLER_BASIS, 4),
        ("Lotka-Volterra", systems.LotkaVolterra(), LOTKA_VOLTERRA, 1),
    ]
}
RUNGE_LENZ = {"A": dfc.FirstIntegral(KEPLER.laplace_runge_lenz)}
FOUND["Kepler"] = (*FOUND["Kepler"][:4], KEPLER.manifold | RUNGE_LENZ)
FOUND |= {
    "Robertson": (ROBERTSON.vector_field, sparse(3), 2, 1, ROBERTSON.manifold),
    "Pollu": (POLLU.vector_field, sparse(20), species(POLLU.mechanism), 3, POLLU.manifold),
    "nitrogen": (NITROGEN.vector_field, sparse(4), species(NITROGEN), 2, NITROGEN.manifold),
    "two levels": (two_level, amplitudes, 2, 4, {}),
    "pendulum": (pendulum, with_angle, PENDULUM, 1, {}),
}
NUM_STATES = {"Pollu": 1000}


@some_of("name", FOUND, ids=FOUND, period=7)
def test_all_that_is_known_is_found(name):
    field, sample, basis, count, known = FOUND[name]
    found = find_invariants(field, sample, basis=basis, num_states=NUM_STATES.get(name))
    assert len(found) == count, list(found)
    other = jr.key(1)
    assert dfc.check_invariance(field, found, sample, key=other, rtol=1e-11).ok
    # What is known depends on what was found.
    for key in jr.split(jr.key(2), 3):
        y = jax.tree.map(lambda x: x + 0.1, sample(key))

        def rank(manifold, y=y):
            rows = [jax.jacfwd(lambda y, e=e: e.fn(0.0, y, None))(y) for e in manifold.values()]
            rows = [np.concatenate([np.ravel(x) for x in jax.tree.leaves(row)]) for row in rows]
            return np.linalg.matrix_rank(np.stack(rows), tol=1e-9)

        scalars = {k: e for k, e in known.items() if jnp.ndim(e.fn(0.0, y, None)) == 0}
        if not jnp.iscomplexobj(jax.tree.leaves(y)[0]):
            assert rank(found | scalars) == rank(found)


def damped_oscillators(t, y, args):
    q, p = jnp.split(y, 2)
    return jnp.concatenate([p, -q - jnp.array([1e-6, 2e-3]) * p])


def henon_heiles(t, y, args):
    x, y, u, v = y
    return jnp.stack([u, v, -x - 2 * x * y - 1e-9 * u, -y - x**2 + y**2])


NOT = {
    "two oscillators": (damped_oscillators, 4),
    "Hénon-Heiles": (henon_heiles, 4),
    "pendulum": (lambda t, y, a: jnp.stack([y[1], -jnp.sin(y[0]) - 1e-9 * y[1]]), 2),
    "logistic": (lambda t, y, a: y * (1 - y), 1),
    "heat": (lambda t, y, a: jnp.convolve(y, jnp.array([1.0, -2.0, 1.0]), "same"), 4),
    "Thomas": (lambda t, y, a: jnp.sin(jnp.roll(y, -1)) - y / 5, 3),
}


@some_of("name", NOT, ids=NOT, period=6)
def test_where_nothing_is_conserved_nothing_is_found(name):
    field, size = NOT[name]
    assert find_invariants(field, normal(size), basis=3) == {}


def test_formulas_do_not_depend_on_units_and_precision():
    """In metres and seconds, and from float32."""
    mu = 3.986e14

    def satellite(t, y, args):
        q, v = y
        return v, -mu * q / jnp.sum(q**2) ** 1.5

    rng = np.random.default_rng(0)
    states = (rng.normal(size=(80, 2)) * 7e6, rng.normal(size=(80, 2)) * 7e3)
    states = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), states)
    found = find_invariants(satellite, states, basis=KEPLER_BASIS)
    assert len(found) == 4
    assert "q1 p2 - q2 p1" in found
    kinetic = f"{1 / (2 * mu):.6g}"
    assert f"{kinetic} p1 p1 + {kinetic} p2 p2 - /r" in found
    like = jax.tree.map(lambda x: x[0], states)
    assert all(e.fn(0.0, like, None).dtype == jnp.float32 for e in found.values())


def test_names_of_components():
    def field(t, y, args):
        return {"a": 0 * y["a"], "b": jnp.stack([y["b"][1], -y["a"] * y["b"][0]])}

    ys = {"a": jr.normal(jr.key(0), (40,)), "b": jr.normal(jr.key(1), (40, 2))}
    assert list(find_invariants(field, ys, basis=3)) == ["a", "b[1]^2 + a b[0]^2"]


COS, SIN = np.cos(np.linspace(0, 5, 60)), np.sin(np.linspace(0, 5, 60))
ORBIT = [COS - 0.6, 0.8 * SIN], [-SIN / (1 - 0.6 * COS), 0.8 * COS / (1 - 0.6 * COS)]
CURVE = tuple(np.stack(part, axis=1) for part in ORBIT)
PLANE = np.random.default_rng(0).normal(size=(60, 2)) * np.array([1.0, 0.0])
BAD = np.where(np.arange(60)[:, None] == 7, np.nan, PLANE + 1)


def of(basis, ys=PLANE, field=pendulum):
    return lambda: find_invariants(field, ys, basis=basis)


test_mistakes_are_named = refused(
    (of(2, PLANE[:9]), ValueError, "9 states, but a basis of 5 functions needs at least 10"),
    (of(2), ValueError, r"The component `y\[0\]` of the state moves"),
    (of(1, ROBERTSON.sample, ROBERTSON.vector_field), ValueError, r"The component `y\[2\]`"),
    (of(2, PLANE + np.array([0.0, 1.0])), ValueError, r"The function `y\[1\]` has the same"),
    (of(2, PLANE + 1, lambda t, y, args: pendulum(t, y, args) + t), ValueError, "depends on time"),
    (of(KEPLER_BASIS, CURVE, KEPLER.vector_field), ValueError, "as on one trajectory"),
    (of(2, BAD), ValueError, "`vector_field`, or its derivative, is not finite at state 7"),
    (of(0), ValueError, "`basis` is 0"),
    (of({}), ValueError, "`basis` is empty"),
    (of("cubic"), TypeError, "Give the degree of polynomials"),
    (of({"y": lambda y: y}), ValueError, "must return one real"),
    (of({"y": lambda t, y: y}), TypeError, r"Pass a function `fn\(y\)`"),
)


def test_an_invariant_is_found_beside_another_that_is_nearly_conserved():
    """Hénon and Heiles with a coefficient near 6, with which there is a second one of degree four.
    The energy alone is exact, to all digits."""

    def field(t, y, args):
        return jnp.stack(
            [y[2], y[3], -y[0] - 2 * y[0] * y[1], -y[1] - y[0] ** 2 - 6.001 * y[1] ** 2]
        )

    def energy(y):
        return jnp.sum(y**2) / 2 + y[0] ** 2 * y[1] + 6.001 / 3 * y[1] ** 3

    states = jr.uniform(jr.key(7), (400, 4), minval=-1.0)
    (found,) = find_invariants(field, states, basis=4).values()
    ratio = jax.vmap(lambda y: found.fn(0.0, y, None) / energy(y))(states)
    np.testing.assert_allclose(ratio, 3 / 6.001, rtol=1e-11)


def test_what_cannot_be_told_apart_is_left_out_with_a_warning():
    def nearly(t, y, args):
        return jnp.stack([-y[0], y[0], -y[2], y[2] + 2e-14 * y[3]])

    with pytest.warns(UserWarning, match="1 combinations seem to be conserved, but cannot be told"):
        assert find_invariants(nearly, normal(4), basis=1) == {}
