"""Radau, on stiff equations and on differential-algebraic ones of index 1 to 3, against published
values and exact solutions."""

import functools as ft
import itertools

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ellipj

import diffrax_conserve as dfc

from ..problems import EPS, TO_THE_END, largest, refused
from ..test_benchmarks import benchmark


@eqx.filter_jit
def solve(term, solver, t1, y0, args, tol, *, scale=1.0, saveat=dfx.SaveAt(t1=True)):
    controller = dfx.PIDController(rtol=tol, atol=tol * scale)
    return dfx.diffeqsolve(
        term, solver, 0.0, t1, 1e-6, y0, args, stepsize_controller=controller, saveat=saveat,
        **TO_THE_END,
    )  # fmt: skip


def test_what_is_discarded_spoils_no_derivative():
    """In reverse mode: attempts whose stages have no real root, and a lane that fails for good."""
    dae = dfc.DAE(lambda t, x, z, a: -a * x, algebraic=lambda t, x, z, a: z - jnp.sqrt(x - 0.5))
    y0 = jnp.array(1.0), jnp.sqrt(0.5)

    @jax.jit
    @jax.vmap
    @ft.partial(jax.value_and_grad, has_aux=True)
    def end(rate):
        sol = dfx.diffeqsolve(
            dae.term, dae.wrap(dfc.Radau()), 0.0, 1.0, 1e-3, y0, rate, throw=False, max_steps=100,
            stepsize_controller=dfx.PIDController(1e-6, 1e-8),
        )  # fmt: skip
        return sol.ys[1][-1], sol.result == dfx.RESULTS.successful

    rates = np.array([0.1, 0.5, 2.0])
    (z, success), slopes = end(rates)
    assert success.tolist() == [True, True, False]
    x = np.exp(-rates[:2])
    np.testing.assert_allclose(z[:2], np.sqrt(x - 0.5), rtol=1e-6)
    np.testing.assert_allclose(slopes[:2], -x / (2 * np.sqrt(x - 0.5)), rtol=1e-5)


# ---- Ordinary differential equations ----


def test_a_stage_is_collocation():
    """`y' = p(t)` with `p` of degree four is integrated exactly, and `y' = λ y` by the stability
    function, the Padé approximation of degree (2, 3)."""
    solver = dfc.Radau(root_finder=dfx.VeryChord(rtol=1e-13, atol=1e-13))
    term = dfx.ODETerm(lambda t, y, a: jnp.stack([5 * t**4, a * y[1]]))
    a, h, c = -3.0, 0.5, (4 - 6**0.5) / 10

    @jax.jit
    def found(y0):
        """The end, and the path and its slope at the first node."""
        state = solver.init(term, 0.0, h, y0, a)
        y1, _, dense, _, _ = solver.step(term, 0.0, h, y0, a, state, False)
        path = solver.interpolation_cls(t0=0.0, t1=h, **dense)
        return y1, *jax.jvp(path.evaluate, (c * h,), (1.0,))

    y1, y, slope = found(jnp.array([0.0, 1.0]))
    z = a * h
    pade = (1 + 2 * z / 5 + z**2 / 20) / (1 - 3 * z / 5 + 3 * z**2 / 20 - z**3 / 60)
    assert np.allclose(y1, [h**5, pade], rtol=1e-14)
    assert np.allclose(slope, [5 * (c * h) ** 4, a * y[1]], rtol=1e-12)


def test_the_error_of_a_component_that_follows_a_force_is_controlled():
    """`y' = λ (cos t - y)` (A. Prothero and A. Robinson, 1974), from the solution without a
    transient and from another start, stiff or not, and the same backwards in time: in each step by
    some tolerances, and without many steps that are rejected, because a transient is left from the
    step before."""

    @jax.jit
    @jax.vmap
    def worst(rate, tol, off, way):
        exact = lambda t: rate * (rate * jnp.cos(t) + way * jnp.sin(t)) / (rate**2 + 1)  # noqa: E731
        field = dfx.ODETerm(lambda t, y, args: way * rate * (jnp.cos(t) - y))
        steps = dfx.PIDController(rtol=tol, atol=tol)
        options = dict(stepsize_controller=steps, saveat=dfx.SaveAt(steps=True), max_steps=1024)
        times = 0.0, way * 10.0, way * 1e-6
        found = dfx.diffeqsolve(field, dfc.Radau(), *times, exact(0.0) + off, **options)
        transient = off * jnp.exp(-rate * jnp.abs(found.ts))
        error = jnp.abs(found.ys - exact(found.ts) - transient) / (1 + jnp.abs(found.ys))
        return jnp.max(jnp.where(jnp.isfinite(found.ts), error, 0)) / tol, found.stats

    cases = itertools.product([1e2, 1e4, 1e6], [1e-4, 1e-6, 1e-8], [0.0, 1.0], [1.0, -1.0])
    error, stats = worst(*map(np.array, zip(*cases, strict=True)))
    assert np.max(error) < 5
    assert np.all(stats["num_rejected_steps"] <= 5 + stats["num_accepted_steps"] / 2)


@pytest.mark.slow
def test_hires():
    """Published by the test set for initial value problem solvers (Bari)."""
    field, end, y0, scale, published = benchmark("stiff").PROBLEMS["HIRES"]
    found = solve(dfx.ODETerm(field), dfc.Radau(), end, jnp.array(y0), None, 1e-6, scale=scale)
    np.testing.assert_allclose(found.ys[-1], published, rtol=1e-5)
    assert found.stats["num_accepted_steps"] <= 156 * 1.3  # of scipy's `Radau`


# ---- Index 1 ----

MASS, START = np.array([[1.0, -1.0], [-1.0, 1.0]]), np.array([2.0, 1.0])


def condenser(t, y, args):
    """The charge `u - v` flows off through a resistor beside one that is not linear."""
    return (1.0 if args is None else args) * jnp.stack([-y[0], y[1] ** 3 + y[1]])


CONDENSER = dfc.DAE(condenser, mass=MASS)


@pytest.mark.slow
def test_a_singular_mass_matrix_and_a_gradient_through_it():
    """`u = v³ + v`, so that `v² + 1 = 2 exp(-2/3 a t)`. `consistent` keeps the charge."""
    finder = dfx.VeryChord(rtol=1e-12, atol=1e-12)
    solver = CONDENSER.wrap(dfc.Radau(root_finder=finder))

    @jax.jit
    @jax.value_and_grad
    def end(a):
        y0 = CONDENSER.consistent(START + 0.1, args=a)
        return dfx.diffeqsolve(CONDENSER.term, solver, 0.0, 0.5, 0.02, y0, a).ys[-1, 1]

    v = np.sqrt(2 * np.exp(-1 / 3) - 1)
    np.testing.assert_allclose(end(1.0), (v, -(v**2 + 1) / (6 * v)), rtol=1e-9)


@pytest.mark.slow
def test_zeros_in_args_decide_about_the_index():
    """With those of `at` by an exact solution; with others it is no success."""
    guess, singular, regular = (jnp.array(x) for x in ([0.5, 0.1], [2.0, 0.0], [2.0, 3.0]))
    dae = dfc.DAE(
        lambda t, y, a: jnp.stack([-y[0] + y[1], y[0] ** 2 - y[1]]),
        mass=lambda t, y, a: jnp.diag(a),
    ).at(guess, args=singular)
    y0 = dae.consistent(guess, args=singular)
    end = lambda args: solve(dae.term, dae.wrap(dfc.Radau()), 1.0, y0, args, 1e-8)  # noqa: E731
    x = 1 / (1 + np.exp(1 / 2))  # `2 x' = x² - x`
    assert np.allclose(end(singular).ys[-1], [x, x**2], rtol=1e-7)
    assert end(regular).result != dfx.RESULTS.successful
    assert np.all(np.isnan(dae.term.vf(0.0, y0, regular)))


def test_what_is_fixed_stays():
    dae = dfc.DAE(residual=lambda t, y, dy, args: (dy[0] - y[1], y[0] ** 2 + y[1] ** 2 - 1))
    guess = jnp.array([0.6, 0.9])
    assert np.allclose(dae.consistent(guess), [0.6, 0.8], rtol=1e-15)
    first = lambda y: dae.consistent(guess.at[1].set(y), fixed=np.array([False, True]))  # noqa: E731
    found, slope = jax.jit(lambda y: jax.jvp(first, (y,), (1.0,)))(0.9)
    root = np.sqrt(1 - 0.9**2)
    assert np.allclose(found, [root, 0.9], rtol=1e-14)
    assert np.isclose(slope[0], -0.9 / root, rtol=1e-12)


@pytest.mark.parametrize("fixed", [(0, 0, 0, 1), (0, 0, 1, 0), (1, 0, 0, 1)])
def test_what_is_fixed_stays_and_what_is_differentiated_moves_least(fixed):
    """Of `x' = -x`, `C x + D z = 1`, beside the conditions of optimality. In a chain of algebraic
    unknowns whose last one is fixed, the others are in more equations than they can meet."""
    dae = dfc.DAE(
        lambda t, x, z, a: -x, algebraic=lambda t, x, z, a: a[0] @ x + jnp.tril(a[1]) @ z - 1
    )
    numbers = np.random.default_rng(0).uniform(1.0, 2.0, (12, 6, 2))
    C, D, guess = numbers[:, :2] * [[[1.0], [0.0]]], np.tril(numbers[:, 2:4]), numbers[:, 4:]
    still = np.array(fixed, bool)
    flags = still[:2], still[2:]
    found = jax.vmap(lambda C, D, y: dae.consistent(*y, args=(C, D), fixed=flags))(C, D, guess)
    for y, start, c, d in zip(np.hstack(found), guess.reshape(-1, 4), C, D, strict=True):
        np.testing.assert_array_equal(y[still], start[still])
        rows = np.vstack([np.hstack([c, d]), np.eye(4)[still]])
        matrix = np.block([[np.diag([1, 1, 0, 0]), rows.T], [rows, np.zeros((len(rows),) * 2)]])
        right = np.concatenate([start[:2], [0, 0, 1, 1], start[still]])
        np.testing.assert_allclose(y, np.linalg.solve(matrix, right)[:4], rtol=1e-12)


def test_equations_have_the_names_of_their_functions():
    """Also where those of another `DAE` of the same shapes are differentiated more often."""
    y = {"u": jnp.array(0.0), "v": jnp.array(1.0)}, jnp.array(1.0)

    def report(flow):
        return dfc.DAE(
            lambda t, x, z, args: {"u": z, "v": -x["v"]},
            algebraic=lambda t, x, z, args: {"flow": flow(t, x, z)},
        ).report(*y)

    of_a_slope = report(lambda t, x, z: x["u"] - jnp.sin(t))
    of_a_value = report(lambda t, x, z: z - jnp.cos(t))
    assert of_a_slope.differentiated == {"algebraic['flow']": 2}
    assert of_a_value.differentiated == {"algebraic['flow']": 1}


def test_an_implicit_equation_that_determines_all_slopes():
    """Not linear in the slope: `y' + y'³ = 2 - y`, so that `log y' + 3/2 y'² + t` is constant."""
    dae = dfc.DAE(residual=lambda t, y, dy, args: dy + dy**3 + y - 2)
    y0 = dae.consistent(jnp.zeros(1))
    assert dae.report(y0).index == 0
    found = solve(dae.term, dae.wrap(dfc.Radau()), 1.0, y0, None, 1e-9)
    slope = brentq(lambda p: np.log(p) + 1.5 * p**2 - 0.5, 0.1, 1.0, xtol=1e-15)
    assert largest(found.ys[-1] - (2 - slope - slope**3)) < 1e-8


# ---- Index 2 and 3 ----

WEIGHT = np.array([0.0, -9.81])


def swing(times):
    """The position of a pendulum that starts at rest beside its pivot, by elliptic functions."""
    _, cn, dn, _ = ellipj(np.sqrt(9.81) * np.asarray(times), 0.5)
    sine = np.sqrt(0.5) * cn / dn  # of half the angle
    return np.stack([2 * sine * np.sqrt(1 - sine**2), 2 * sine**2 - 1], axis=-1)


def stabilised(t, y, dy, args):
    (q, v, force, zero), (dq, dv, *_) = y, dy
    return dq - v + zero * q, dv + force * q - WEIGHT, jnp.sum(q**2) - 1, jnp.sum(q * v)


@pytest.mark.slow
def test_a_multiplier_that_is_zero():
    """The form of Gear, Gupta and Leimkuhler: its second multiplier has no size."""
    dae = dfc.DAE(residual=stabilised)
    nothing = jnp.array(0.0)
    y0 = dae.consistent((jnp.array([1.0, 0.0]), jnp.zeros(2), nothing, nothing))
    found = solve(dae.term, dae.wrap(dfc.Radau()), 2.0, y0, None, 1e-8)
    assert largest(found.ys[0] - swing([2.0])) < 1e-6
    assert largest(found.ys[3]) < 1e-12


def pendulum(t, y, args):
    q, v, force = y[:2], y[2:4], y[4]
    return jnp.concatenate([v, WEIGHT - force * q, jnp.sum(q**2)[None] - 1])


@pytest.mark.parametrize(
    "solver",
    [dfc.Radau(), pytest.param(dfx.Tsit5(), marks=pytest.mark.slow)],
    ids=["Radau", "Tsit5"],
)
def test_a_pendulum_in_cartesian_coordinates(solver):
    """Of index 3. What is hidden holds at steps and between them."""
    dae = dfc.DAE(pendulum, mass=np.diag([1.0, 1, 1, 1, 0]))
    y0 = dae.consistent(jnp.array([1.0, 0, 0, 0, 0.3]))
    assert np.allclose(y0, [1, 0, 0, 0, 0], rtol=0, atol=EPS)
    # Positions first: velocities that are noise turn no body.
    at_rest, noisy = (dae.consistent(jnp.array([0.8, -0.61, c, c / 3, 0.3])) for c in (0, 1e-14))
    assert np.allclose(noisy[:2], at_rest[:2], rtol=0, atol=EPS)
    assert largest(at_rest[:2] - np.array([0.8, -0.61])) < 1e-2
    assert largest(noisy[2:4]) < 1e-14
    report = dae.report(y0)
    assert (report.differentiated, report.algebraic) == ({"f[4]": 3}, ("y[4]",))
    assert str(report).startswith("Index 3, with 2 degrees of freedom.")
    times = np.linspace(0.0, 2.0, 21)
    saveat = dfx.SaveAt(ts=times)
    found = solve(dae.term, dae.wrap(solver), 2.0, y0, None, 1e-9, saveat=saveat)
    q, v, force = np.split(np.asarray(found.ys), [2, 4], axis=1)
    centripetal = np.sum(v**2, axis=1) - force[:, 0] - 9.81 * q[:, 1]
    hidden = np.sum(q**2, axis=1) - 1, np.sum(q * v, axis=1), centripetal
    assert largest(hidden) < 16 * EPS * 4 * 9.81
    assert largest(q - swing(times)) < 1e-8


# ---- What is refused ----

ONE = jnp.ones(2)
DOUBLED = dfc.DAE(condenser, mass=2 * MASS)
NOWHERE = dfc.DAE(residual=lambda t, y, dy, args: dy - jnp.log(-jnp.abs(y)))


test_mistakes_are_named = refused(
    (lambda: dfc.DAE(lambda t, y, args: y), ValueError, r"`diffrax.ODETerm\(f\)`"),
    (lambda: dfc.DAE(condenser, mass=MASS, algebraic=stabilised), ValueError, "is given as"),
    (lambda: dfc.DAE(residual=condenser), TypeError, "`residual` of a `DAE`"),
    (lambda: dfc.DAE(condenser, mass=MASS[:1]), ValueError, "`mass` of a `DAE`"),
    (lambda: dfc.DAE(condenser, mass=MASS * np.nan), ValueError, "not finite"),
    (lambda: dfc.DAE(stabilised, mass=MASS), TypeError, "`f` of a `DAE`"),
    (lambda: CONDENSER.consistent(jnp.ones(3)), ValueError, "the state has 3"),
    (lambda: CONDENSER.consistent(ONE, ONE), ValueError, "1 positional"),
    (lambda: CONDENSER.consistent(START, fixed=(True, False)), ValueError, "`fixed`"),
    (lambda: CONDENSER.consistent(jnp.ones(2, int)), TypeError, "floating-point"),
    (lambda: NOWHERE.report(ONE), ValueError, "not finite"),
    (
        lambda: dfc.DAE(residual=lambda t, y, dy, args: dy[:1] - y[:1]).consistent(ONE),
        ValueError,
        "`residual` returns 1 numbers, but the state has 2",
    ),
    (  # the same equation twice
        lambda: dfc.DAE(residual=lambda t, y, dy, args: (y[0], y[0])).consistent(ONE),
        ValueError,
        r"singular: `\[1\]`",
    ),
    (  # an unknown that no equation contains
        lambda: dfc.DAE(residual=lambda t, y, dy, args: dy * jnp.array([1.0, 0])).report(ONE),
        ValueError,
        r"singular: `\[1\]`.*No equation contains `y\[1\]`",
    ),
    (
        lambda: jax.eval_shape(
            lambda y: solve(DOUBLED.term, CONDENSER.wrap(dfc.Radau()), 1.0, y, None, 1e-6), START
        ),
        ValueError,
        "of the same `dae`",
    ),
    (lambda: CONDENSER.wrap(CONDENSER.wrap(dfc.Radau())), TypeError, "itself"),
    (lambda: dfc.Radau(root_finder=3), TypeError, "VeryChord"),
    (lambda: CONDENSER.consistent(START, fixed="y"), ValueError, "`True` or `False`"),
    (lambda: jax.jit(lambda x: CONDENSER.consistent(START, fixed=x))(True), TypeError, "`fixed`"),
    (
        lambda: jax.jit(lambda m: dfc.DAE(condenser, mass=m).term.vf(0.0, START, None))(MASS),
        TypeError,
        r"a function `mass\(t, y, args\)`",
    ),
)
