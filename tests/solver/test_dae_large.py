"""Large differential-algebraic equations: their structure and their consistent states are those
that dense matrices find where these do, and have the numbers that are known by hand."""

import time

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp
from jax.experimental.sparse import BCOO
from scipy.integrate import solve_ivp

import diffrax_conserve as dfc
from diffrax_conserve._dae import dae as dae_module
from diffrax_conserve._dae import search, stage_systems
from diffrax_conserve._large.klu import why_not

from ..thinned import some_of

if why_not():
    pytest.skip(why_not(), allow_module_level=True)


# ---- Equations, each made anew, so that nothing that was found or compiled is shared ----


def heat(n):
    """With a boundary value and a slope of zero at the ends: index 1."""

    def f(t, y, args):
        inner = (y[2:] - 2 * y[1:-1] + y[:-2]) * n**2 + y[1:-1] * (1 - y[1:-1])
        ends = (y[0] - 1 - jnp.sin(t))[None], (y[-1] - y[-2] ** 3)[None]
        return jnp.concatenate([ends[0], inner, ends[1]])

    mass = sp.diags_array(np.r_[0, np.ones(n - 2), 0])
    return dfc.DAE(f, mass=mass), (jnp.linspace(1.0, 0.3, n),)


def ladder(n):
    """Of resistors, with condensers between two neighbours each: half as many equations as nodes
    remain without slopes, although each node has one."""

    def residual(t, y, dy, args):
        left = jnp.concatenate([jnp.sin(t)[None], y[:-1]])
        currents = left - y
        charge = dy.reshape(-1, 2)[:, 0] - dy.reshape(-1, 2)[:, 1]
        balance = jnp.concatenate([currents[1:], y[-1:] ** 3]) - currents
        return jnp.stack([charge, -charge], 1).ravel() + balance

    return dfc.DAE(residual=residual), (jnp.linspace(0.5, 0.1, n),)


def ring(n):
    """Of condensers: the currents of all add up to zero."""

    def residual(t, y, dy, args):
        current = dy - jnp.roll(dy, 1)
        return current - jnp.roll(current, -1) + y * (1 + y**2) - jnp.cos(t) * jnp.linspace(1, 2, n)

    return dfc.DAE(residual=residual), (jnp.linspace(0.5, 0.1, n),)


def varying(n):
    """Condensers whose capacity depends on their voltage, and nodes without one."""

    def residual(t, y, dy, args):
        capacity = jnp.where(np.arange(n) % 2, 0.0, 1 + y**2)
        return capacity * dy + y**3 - (jnp.roll(y, 1) + jnp.roll(y, -1)) / 4 - 1

    return dfc.DAE(residual=residual), (jnp.linspace(0.5, 0.1, n),)


def pairs(n):
    """Index 2: `x' = z + ...`, `0 = x - ...`."""

    def residual(t, y, dy, args):
        (x, z), (dx, _) = y, dy
        return dx - z + x**3, x - jnp.cos(t) - 0.1 * jnp.roll(x, 1) ** 2

    return dfc.DAE(residual=residual), ((jnp.linspace(1.2, 1.1, n), jnp.ones(n)),)


def chain(n):
    """Of links with length and mass 1, in Cartesian coordinates: index 3; with the sum of the
    squares of two places, an algebraic unknown that pulls the last link."""

    def residual(t, y, dy, args):
        (q, v, force, w), (dq, dv, _, _) = y, dy
        links = q - jnp.concatenate([jnp.zeros((1, 2)), q[:-1]])
        pull = force[:, None] * links
        total = jnp.concatenate([pull[1:], jnp.zeros((1, 2))]) - pull
        total = total.at[-1, 0].add(0.1 * w)
        lengths = jnp.sum(links**2, axis=1) - 1
        return dq - v, dv - total + jnp.array([0.0, 9.81]), lengths, w - q[-1, 0] ** 2 / n**2

    q = jnp.stack([jnp.arange(1.0, n + 1), jnp.zeros(n)], 1)
    return dfc.DAE(residual=residual), ((q, jnp.zeros((n, 2)), jnp.zeros(n), jnp.array(0.5)),)


def cells(n):
    """In parallel: index 2, in which all have one voltage, and the currents one sum."""

    def f(t, x, z, args):
        within = jnp.diff(x, axis=1, prepend=x[:, :1], append=x[:, -1:])
        return jnp.diff(within, axis=1).at[:, -1].add(-z[:-1] / jnp.linspace(1, 2, n))

    def algebraic(t, x, z, args):
        potential = 4 - x[:, -1] - 0.1 * x[:, -1] ** 3
        return jnp.append(potential - z[-1], jnp.sum(z[:-1]) - n)

    guess = jnp.full((n, 3), 0.5), jnp.append(jnp.ones(n), 3.5)
    return dfc.DAE(f, algebraic=algebraic), guess


def filtered(n):
    """A ladder of resistors and diodes behind a voltage source, of index 2: the source charges the
    condensers at the first two nodes, which are coupled, and every third node after them has none,
    so that its voltage follows from the others."""

    capacity = sp.lil_array(np.diag(np.where(np.arange(n + 1) % 3 == 2, 0, 1.0)))
    capacity[n, n] = 0
    capacity[:2, :2] += np.array([[1, -1], [-1, 1]])

    def f(t, y, args):
        v, current = y[:-1], y[-1]
        through = jnp.diff(v) * jnp.linspace(1, 2, n - 1)
        into = jnp.diff(through, prepend=0, append=0) - 0.1 * jnp.expm1(v)
        return jnp.append(into.at[0].add(current), v[0] - jnp.sin(t))

    return dfc.DAE(f, mass=sp.csr_array(capacity)), (jnp.linspace(0.5, 0.1, n + 1),)


def carts(n):
    """In a row, at fixed distances, each with a pendulum, so that two slopes at a time are coupled
    by a mass that depends on an angle: index 3."""

    def residual(t, y, dy, args):
        (x, angle, v, w, force), (dx, dangle, dv, dw, _) = y, dy
        pull = jnp.diff(force, prepend=0.0, append=0.0)
        cart = 2 * dv + jnp.cos(angle) * dw - jnp.sin(angle) * w**2 - pull + 0.1 * x
        pendulum = jnp.cos(angle) * dv + dw + 9.81 * jnp.sin(angle)
        return dx - v, dangle - w, cart, pendulum, x[1:] - x[:-1] - 1

    angles, rest = jnp.linspace(0.1, 1.0, n), jnp.zeros(n)
    return dfc.DAE(residual=residual), ((jnp.arange(n) * 1.0, angles, rest, rest, rest[1:]),)


def explicit(n):
    """Index 0, with slopes that are coupled."""

    def residual(t, y, dy, args):
        return 3 * dy - jnp.roll(dy, 1) - jnp.sin(y)

    return dfc.DAE(residual=residual), (jnp.linspace(0.5, 0.1, n),)


SMALL = [
    (explicit, 5), (heat, 9), (ladder, 8), (ring, 7), (varying, 8), (pairs, 4), (cells, 3),
    (filtered, 8), (chain, 3), (carts, 3),
]  # fmt: skip


def made(make, n, least, monkeypatch):
    monkeypatch.setattr(search, "MIN_KLU", least)
    monkeypatch.setattr(dae_module, "MIN_KLU", least)
    dae, guess = make(n)
    y = dae._state(guess)
    structure = dae_module._structure(dae, 0.0, y, None)
    assert (structure.large is not None) == (least == 0)
    return dae, guess, y, structure


def of_all_but(*slow):
    """Of all small equations by default those that are not in `slow`."""
    marks = {True: pytest.mark.slow, False: ()}
    cases = [pytest.param(make, n, marks=marks[make in slow]) for make, n in SMALL]
    return pytest.mark.parametrize(("make", "n"), cases)


# The chain takes as long as all others; `test_numbers_known_by_hand` has a long one.
@of_all_but(chain, carts, heat, ring, pairs)
def test_structure_and_constraints_are_those_of_dense_matrices(make, n, monkeypatch):
    """At a state that is not consistent, with slopes that do not belong to it."""

    def values(least):
        dae, _, y, structure = made(make, n, least, monkeypatch)
        y = jax.tree.map(lambda x: x + 0.1 * jnp.cos(jnp.arange(x.size) * 1.0).reshape(x.shape), y)
        constraints = dae_module._Constraints(dae)(0.3, y, None)
        stages = dae_module._IndexOneEquations(dae)(0.3, y, jax.tree.map(jnp.sin, y), None)
        return structure, constraints, stages

    (dense, *expected), (large, *same) = values(10**9), values(0)
    assert (large.ranks, large.num_differentiations, large.new_unknowns) == (
        dense.ranks,
        dense.num_differentiations,
        dense.new_unknowns,
    )
    assert large.without_slopes == dense.without_slopes
    for k, (a, b) in enumerate(
        zip(jax.tree.leaves(expected), jax.tree.leaves(same), strict=True)
    ):  # up to a sign and the order, if combinations are eliminated in another order
        one, other = (np.sort(np.abs(x)) for x in (a, b))
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12, err_msg=str(k))


# The law before has found the structure of each.
@of_all_but(explicit, heat, ring, varying, cells, filtered, chain, carts)
def test_consistent_states_and_slopes_are_those_of_dense_matrices(make, n, monkeypatch):
    def values(least):
        dae, guess, *_ = made(make, n, least, monkeypatch)
        y0 = dae.consistent(*guess)
        return y0, jax.jit(lambda y: dae.term.vf(0.0, y, None))(y0)

    pairs = zip(jax.tree.leaves(values(10**9)), jax.tree.leaves(values(0)), strict=True)
    for a, b in pairs:
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


@some_of("make, n", [(pairs, 60), (cells, 30), (filtered, 120), (chain, 24)], period=4)
def test_consistent_states_of_a_higher_index_are_those_of_dense_matrices(make, n, monkeypatch):
    """With 120 or 121 unknowns, index 2 and 3; and inside of another program."""

    def values(least):
        dae, _, y, structure = made(make, n, least, monkeypatch)
        moved = jax.tree.map(lambda x: x + 0.1 * jnp.sin(jnp.arange(x.size)).reshape(x.shape), y)
        state = dae.consistent(moved)
        inside = None if least else jax.jit(lambda: dae.consistent(moved))()
        constraints = dae_module._Constraints(dae)
        return (
            structure.ranks,
            (state, constraints(0.0, moved, None)),
            inside,
            constraints(0.0, state, None),
        )

    (ranks, dense, *_), (same, large, inside, zeros) = values(10**9), values(0)
    assert ranks == same
    for a, b in zip(jax.tree.leaves(dense), jax.tree.leaves(large), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
    for a, b in zip(jax.tree.leaves(large[0]), jax.tree.leaves(inside), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
    for h in zeros:
        np.testing.assert_allclose(h, 0, atol=1e-11)


@pytest.mark.parametrize(
    ("make", "n", "index", "freedom"),
    [
        (heat, 10_000, 1, 9_998),
        (ladder, 10_000, 1, 5_000),
        (ring, 2_000, 1, 1_999),
        (pairs, 1_000, 2, 0),
        (chain, 1_000, 3, 2_000),
        (carts, 300, 3, 602),
    ],
)
def test_numbers_known_by_hand(make, n, index, freedom):
    dae, guess = make(n)
    structure = dae_module._structure(dae, 0.0, dae._state(guess), None)
    assert (structure.index, structure.freedom) == (index, freedom)
    assert structure.large is not None


def test_the_currents_of_a_large_pack():
    """20 groups in series of 20 cells in parallel, with 820 unknowns: all cells of a group have one
    voltage, and so one charge, and share the current by their capacities."""
    groups, number = 20, 20
    capacity = np.random.default_rng(0).uniform(0.9, 1.1, (groups, number))

    def f(t, x, z, load):
        return -z[0] / capacity

    def algebraic(t, x, z, load):
        potential = 3.4 + 0.6 * x + 0.1 * jnp.log(x / (1 - x))
        return potential - z[1][:, None], jnp.sum(z[0], axis=1) - load

    dae = dfc.DAE(f, algebraic=algebraic)
    guess = jnp.full((groups, number), 0.8), (jnp.ones((groups, number)), jnp.full(groups, 3.9))
    report = dae.report(*guess, args=40.0)
    assert (report.index, report.freedom) == (2, groups)
    x, (currents, _) = dae.consistent(*guess, args=40.0)
    share = capacity / np.sum(capacity, axis=1, keepdims=True)
    np.testing.assert_allclose(x, 0.8, rtol=1e-14)
    np.testing.assert_allclose(currents, 40 * share, rtol=1e-12)


@some_of("push", [0.0, 9.81], period=2)
def test_forces_that_vanish_or_are_unknown(push):
    """A net of rods with 946 unknowns and closed loops. In free fall no rod has a force, and the
    accelerations cancel to roundoff; where one corner is pushed they have one."""
    side = 11
    at = np.arange(side**2).reshape(side, side)
    a = np.r_[at[:, :-1].ravel(), at[:-1].ravel()]
    b = np.r_[at[:, 1:].ravel(), at[1:].ravel()]
    place = np.stack([*np.divmod(np.arange(side**2), side), np.zeros(side**2)], -1)
    place[:, 2] = 0.3 * np.sin(place[:, 0] + 0.7 * place[:, 1])
    mass = np.random.default_rng(0).uniform(0.5, 1.5, (side**2, 1))
    outer = -9.81 * mass * np.array([0, 0, 1])
    outer[0] += push

    def residual(t, y, dy, args):
        (q, v, force), (dq, dv, _) = y, dy
        rod = q[a] - q[b]
        pull = force[:, None] * rod
        inner = jnp.zeros_like(q).at[a].add(pull).at[b].add(-pull)
        lengths = np.sum((place[a] - place[b]) ** 2, axis=1)
        return dq - v, dv - (outer + inner) / mass, jnp.sum(rod**2, axis=1) - lengths

    dae = dfc.DAE(residual=residual)
    q, v, force = dae.consistent((jnp.asarray(place), jnp.zeros((side**2, 3)), jnp.zeros(len(a))))
    rod, rows = place[a] - place[b], np.arange(len(a))
    matrix = np.zeros((len(a), side**2, 3))
    matrix[rows, a], matrix[rows, b] = rod, -rod
    weighted = (matrix / mass).reshape(len(a), -1)
    matrix = matrix.reshape(len(a), -1)
    exact = np.linalg.solve(weighted @ matrix.T, -matrix @ (outer / mass).ravel())
    np.testing.assert_allclose(q, place, atol=1e-14)
    np.testing.assert_allclose(v, 0, atol=1e-14)
    np.testing.assert_allclose(force, exact, atol=1e-12)


def test_what_is_not_found_is_refused_at_once():
    """A dense derivative of an unknown operation, and an index of 4."""
    n = 400

    def residual(t, y, dy, args):
        return jnp.concatenate([dy[: 3 * n] - y[n:], y[:n] - jnp.sin(t)])

    begin = time.monotonic()
    with pytest.raises(ValueError, match="their index is larger than 3"):
        dfc.DAE(residual=residual).consistent(jnp.ones(4 * n))
    assert time.monotonic() - begin < 60


@eqx.filter_jit
def end(dae, y0, time, dt0, steps):
    """The last state of a solve."""
    options = dict(stepsize_controller=steps, adjoint=dfx.ForwardMode())
    found = dfx.diffeqsolve(dae.term, dae.wrap(dfc.Radau()), 0.0, time, dt0, y0, **options)
    return jax.tree.map(lambda y: y[-1], found.ys)


def test_bodies_with_coupled_slopes():
    """A row of 25 carts, with 124 unknowns, is one body with as many pendulums."""
    n, time = 25, 1.0
    dae, guess = carts(n)
    steps = dfx.PIDController(rtol=1e-7, atol=1e-7)
    x, angles, *_ = end(dae, dae.consistent(*guess), time, 1e-3, steps)

    def slopes(t, y):
        (place, speed), (angle, w) = y[:2], np.split(y[2:], 2)
        mass = np.eye(n + 1)
        mass[0, 1:], mass[1:, 0], mass[0, 0] = np.cos(angle), np.cos(angle), 2 * n
        on_carts = np.sum(np.sin(angle) * w**2) - 0.1 * np.sum(place + np.arange(n))
        rates = np.linalg.solve(mass, np.append(on_carts, -9.81 * np.sin(angle)))
        return np.concatenate([[speed, rates[0]], w, rates[1:]])

    begin = np.concatenate([[0, 0], guess[0][1], np.zeros(n)])
    exact = solve_ivp(slopes, (0, time), begin, "DOP853", rtol=1e-11, atol=1e-11).y[:, -1]
    np.testing.assert_allclose(angles, exact[2 : 2 + n], atol=1e-8)
    np.testing.assert_allclose(x, exact[0] + np.arange(n), atol=1e-8)


def test_a_large_solve_is_that_of_scipy(monkeypatch):
    """Heat, whose ends are known from their neighbours, by sparse matrices."""
    for module in (search, dae_module, stage_systems):
        monkeypatch.setattr(module, "MIN_KLU", 20)
    n, t1 = 24, 0.1
    dae, guess = heat(n)
    y0 = dae.consistent(*guess)
    y = np.asarray(end(dae, y0, t1, 1e-4, dfx.PIDController(rtol=1e-6, atol=1e-8)))

    def slope(t, u):
        whole = np.concatenate([[1 + np.sin(t)], u, u[-1:] ** 3])
        return np.diff(whole, 2) * n**2 + u * (1 - u)

    exact = solve_ivp(slope, (0, t1), y0[1:-1], "Radau", rtol=1e-10, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(y[1:-1], exact, rtol=1e-6)
    np.testing.assert_allclose(y[0] - 1, np.sin(t1), rtol=1e-13)
    np.testing.assert_allclose(y[-1] - y[-2] ** 3, 0, atol=1e-15)


def test_a_structure_at_special_numbers_is_not_remembered_for_general_ones(monkeypatch):
    """A coupling of slopes is zero in `args` when `at` asks first."""
    monkeypatch.setattr(search, "MIN_KLU", 0)

    def residual(t, y, dy, k):
        (x, v, z), (dx, dv, _) = y, dy
        return dx - v, k * dx + dv - z, x - jnp.cos(t)

    def slopes(dae, k):
        return jax.jit(lambda y: dae.term.vf(0.3, y, k))(y)

    y = (jnp.ones(4), jnp.ones(4), jnp.ones(4))
    first, alone = dfc.DAE(residual=residual), dfc.DAE(residual=lambda *given: residual(*given))
    first.at(y, args=jnp.zeros(4))
    for a, b in zip(slopes(first, jnp.ones(4)), slopes(alone, jnp.ones(4)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)


def test_a_function_may_return_a_sparse_mass_matrix():
    at = np.array([[0, 0], [0, 2], [1, 1]])

    def f(t, y, args):
        return jnp.array([-y[0], y[2] - y[1], y[0] + y[2] ** 3])

    def entries(y):
        return jnp.stack([1 + y[0] ** 2, y[1], 2.0])

    def sparse(t, y, args):
        return BCOO((entries(y), at), shape=(3, 3))

    def dense(t, y, args):
        return sparse(t, y, args).todense()

    y = jnp.array([0.5, 0.3, -(0.5 ** (1 / 3))])
    one, other = (jax.jit(dfc.DAE(f, mass=m).term.vf)(0.0, y, None) for m in (sparse, dense))
    np.testing.assert_allclose(one, other, rtol=1e-14)
    with pytest.raises(TypeError, match="BCOO"):
        dfc.DAE(f, mass=lambda t, y, args: sp.eye_array(3)).consistent(y)
