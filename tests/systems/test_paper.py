"""The paper's five systems, typed from what it prints, against the catalogue.

E. Cardoso-Bihlo and A. Bihlo, arXiv:2311.14131. Its misprints, corrected here:

1. Rigid body, L: `w_3^3` for `w_3^2`.
2. Double pendulum, H: the bracket that `(m_1 + m_2 sin^2` opens is never closed.
3. Lorenz, in the text: none in the formulas; what it calls H is our Casimir over `-sigma`.
4. Vortices, r_ij: `(x_i - x_i)^2` for `(x_i - x_j)^2`.
5. Vortices, equations and positions: sums and indices start at 0, which makes n + 1 vortices.
6. Vortices, H: `1/(4 pi)` with a sum over `i < j` is half of the Hamiltonian of these equations.
   It is conserved all the same; ours is the Hamiltonian.
7. Loss: the defect in it is not squared. (Also: `R^{n-m}` for `R^n` in the definition of M, and
   figures in "the (q, q) plane".)
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_conserve as dfc
from diffrax_conserve import systems

COUNT = 100
RELATIVE = 1e-13


def rigid_body_field(w, i1, i2, i3):
    w1, w2, w3 = w
    first, second = (i2 - i3) / (i2 * i3) * w2 * w3, (i3 - i1) / (i1 * i3) * w1 * w3
    return jnp.stack([first, second, (i1 - i2) / (i1 * i2) * w1 * w2])


def pendulum_energy(y, m1, m2, l1, l2, g):
    q1, q2, p1, p2 = y
    above = m2 * l2**2 * p1**2 + (m1 + m2) * l1**2 * p2**2
    above = above - 2 * m2 * l1 * l2 * p1 * p2 * jnp.cos(q1 - q2)
    below = 2 * m2 * l1**2 * l2**2 * (m1 + m2 * jnp.sin(q1 - q2) ** 2)
    return above / below - (m1 + m2) * g * l1 * jnp.cos(q1) - m2 * g * l2 * jnp.cos(q2)


def pendulum_field(y, *parameters):
    dq1, dq2, dp1, dp2 = jax.grad(pendulum_energy)(y, *parameters)
    return jnp.stack([dp1, dp2, -dq1, -dq2])


def lorenz_field(y, sigma, rho, m=0, beta=8 / 3):
    x, y, z = y
    return jnp.stack([sigma * (y - m * x), x * (rho - z) - m * y, x * y - beta * m * z])


def distance(y, i, j):
    return jnp.sqrt((y[i, 0] - y[j, 0]) ** 2 + (y[i, 1] - y[j, 1]) ** 2)


PAIRS = [(i, j) for i in range(3) for j in range(3) if i != j]


def vortex_field(y, gamma):
    dx, dy = [0.0] * len(gamma), [0.0] * len(gamma)
    for i, j in PAIRS:
        r = distance(y, i, j)
        dx[i] = dx[i] - gamma[j] * (y[i, 1] - y[j, 1]) / (2 * jnp.pi * r**2)
        dy[i] = dy[i] + gamma[j] * (y[i, 0] - y[j, 0]) / (2 * jnp.pi * r**2)
    return jnp.stack([jnp.stack(dx), jnp.stack(dy)], axis=1)


def vortex_energy(y, gamma):
    terms = [gamma[i] * gamma[j] * jnp.log(distance(y, i, j)) for i, j in PAIRS if i < j]
    return -sum(terms) / (4 * jnp.pi)


# By system: from parameters to a system of the catalogue, the paper's field, and by our names its
# integrals as ours must be.
CASES = {
    # Ours is for unit mass: its momentum is the velocity, its energy that of a unit of mass.
    "harmonic-oscillator": (
        lambda m, k: systems.HarmonicOscillator(jnp.sqrt(k / m)),
        lambda y, m, k: jnp.stack([y[1] / m, -k * y[0]]),
        {"energy": lambda y, m, k: (y[1] ** 2 / (2 * m) + k * y[0] ** 2 / 2) / m},
    ),
    "rigid-body": (
        lambda *inertia: systems.RigidBody(jnp.stack(inertia)),
        rigid_body_field,
        {
            "energy": lambda w, *i: (w[0] ** 2 / i[0] + w[1] ** 2 / i[1] + w[2] ** 2 / i[2]) / 2,
            "squared angular momentum": lambda w, *i: (w[0] ** 2 + w[1] ** 2 + w[2] ** 2) / 2,
        },
    ),
    "double-pendulum": (
        lambda m1, m2, l1, l2, g: systems.DoublePendulum(
            jnp.stack([m1, m2]), jnp.stack([l1, l2]), gravity=g
        ),
        pendulum_field,
        {"energy": pendulum_energy},
    ),
    "conservative-lorenz": (
        lambda sigma, rho: systems.ConservativeLorenz(sigma, rho),
        lorenz_field,
        {
            "Casimir": lambda y, sigma, rho: -sigma * (y[2] - y[0] ** 2 / (2 * sigma)),
            "energy": lambda y, sigma, rho: (y[1] ** 2 + y[2] ** 2) / 2 - rho * y[2],
        },
    ),
    "point-vortices": (
        lambda *gamma: systems.PointVortices(jnp.stack(gamma)),
        lambda y, *gamma: vortex_field(y, gamma),
        {
            "energy": lambda y, *gamma: 2 * vortex_energy(y, gamma),
            "linear impulse": lambda y, *gamma: jnp.stack(gamma) @ y,
            "angular impulse": lambda y, *gamma: jnp.stack(gamma) @ jnp.sum(y**2, axis=1),
        },
    ),
}


def largest_relative(ours, theirs):
    """Relative to the largest component: of the state if there are many, else of all states."""
    ours, theirs = (np.asarray(x).reshape(COUNT, -1) for x in (ours, theirs))
    size = np.max(np.abs(theirs), axis=1) if theirs.shape[1] > 1 else np.max(np.abs(theirs))
    return np.max(np.max(np.abs(ours - theirs), axis=1) / size)


@pytest.mark.parametrize("name", list(CASES))
def test_equations_and_integrals_are_those_printed(name):
    make, field, integrals = CASES[name]
    # Of our state to the paper's.
    masses = (lambda m, k: jnp.stack([1.0, m])) if "oscillator" in name else lambda *p: 1.0
    system = systems.get(name)
    state_key, parameter_key = jr.split(jr.key(13))
    ys = jax.jit(jax.vmap(system.sample))(jr.split(state_key, COUNT))
    shape = (COUNT, len(DEFAULTS[name]))
    parameters = jr.uniform(parameter_key, shape, minval=0.5, maxval=2.0)
    # The first ones are the default.
    parameters = parameters.at[0].set(jnp.array(DEFAULTS[name]))
    assert eqx.tree_equal(make(*map(jnp.asarray, DEFAULTS[name])), system)

    @jax.jit
    @jax.vmap
    def both(y, p):
        own, state = make(*p), y / masses(*p)
        rates = own.vector_field(0.0, state, None) * masses(*p), field(y, *p)
        values = {
            key: (own.manifold[key].fn(0.0, state, None), printed(y, *p))
            for key, printed in integrals.items()
        }
        return rates, values

    rates, values = both(ys, parameters)
    assert values.keys() == system.manifold.keys()
    assert largest_relative(*rates) <= RELATIVE
    for pair in values.values():
        assert largest_relative(*pair) <= RELATIVE


DEFAULTS = {
    "harmonic-oscillator": (1.0, 1.0),  # m, k
    "rigid-body": (0.1, 0.2, 0.3),
    "double-pendulum": (1.0, 1.0, 1.0, 1.0, 9.81),  # m_1, m_2, l_1, l_2, g
    "conservative-lorenz": (1.0, 0.5),  # sigma, rho
    "point-vortices": (1.0, 1.0, 1.0),
}


def test_solutions_start_and_steps_end_where_the_paper_says():
    """It names initial states and horizons of its PINNs, and steps of its flow maps."""
    starts = {"harmonic-oscillator": (30.0, [1.0, 1.0]), "rigid-body": (1.75, [1.0, 1.0, 1.0])}
    for system, (t1, y0) in ((systems.get(name), start) for name, start in starts.items()):
        assert system.t1 == t1
        np.testing.assert_array_equal(system.y0, y0)
    steps = {"double-pendulum": 20, "conservative-lorenz": 500, "point-vortices": 500}
    found = {name: systems.get(name) for name in steps}
    assert {name: system.t1 / system.dt for name, system in found.items()} == steps
    assert [system.dt for system in found.values()] == [0.5, 0.25, 0.5]


def drawn(name):
    return np.asarray(jax.jit(jax.vmap(systems.get(name).sample))(jr.split(jr.key(0), 4000)))


def assert_fills(values, low, high):
    """Uniform draws from an interval stay in it, and come close to both ends."""
    assert low <= values.min() <= low + 0.02 * (high - low)
    assert high - 0.02 * (high - low) <= values.max() <= high


def test_initial_states_fill_the_papers_domains():
    for component in drawn("double-pendulum").T:
        assert_fills(component, -np.pi / 6, np.pi / 6)
    x, y, z = drawn("conservative-lorenz").T
    assert_fills(np.hypot(x, y), 0.5, 1.5)
    assert_fills(z, 0.5, 1.5)
    assert_fills(np.linalg.norm(drawn("point-vortices"), axis=-1), 0.5, 1.5)


@pytest.mark.parametrize("kind", ["pinn", "deeponet"])
def test_networks_and_recipe_have_the_papers_numbers(kind):
    paper, system, made = dfc.learned.paper, systems.ConservativeLorenz(), eqx.filter_eval_shape
    layer = dfc.learned.ConservativeLayer(system.manifold, steps=3)
    if kind == "pinn":
        network = made(paper.pinn, system.y0, 0.0, 1.0, key=jr.key(0), layer=layer)
        nets, points = [network.nets], 2000
    else:
        network = made(paper.deeponet, np.ones((9, 3)), 0.25, key=jr.key(0), layer=layer)
        nets, points = [network.core.branch, network.core.trunk], 5000
    for net in nets:
        assert [w.shape[-1] for w in net.weights[:-1]] == [40] * 4
        assert net.activation is jnp.tanh
    recipe = paper.recipe(network)
    assert (recipe.epochs, recipe.points) == (5000, points)
    assert recipe.refresh is None  # the full batch
    # The first update of Adam is the learning rate, whatever the gradient.
    update, _ = recipe.optimiser.update(jnp.array(3.0), recipe.optimiser.init(jnp.array(1.0)))
    np.testing.assert_allclose(update, -1e-3, rtol=1e-6)
    if kind == "deeponet":
        # p(e) = floor(e (P + 1) / E), which would be P + 1 at e = E, a step never made.
        p, _ = jax.vmap(lambda e: recipe.schedule(e, 5000, 3))(jnp.arange(5000))
        np.testing.assert_array_equal(p, np.floor(np.arange(5000) * 4 / 5000))
