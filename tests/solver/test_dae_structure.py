"""The structure of a DAE belongs to the equations: it depends neither on what is called first nor
on values, unless `at` says so. What is below roundoff is no error."""

import itertools

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc
from diffrax_conserve._dae.dae import _Constraints, _structure

from ..problems import EPS, refused
from ..thinned import some_of

GUESS = jnp.array([0.5, 0.2])


def decided():
    """Of index 1 if `a = 0`, and of index 0 otherwise; with functions of its own."""
    return dfc.DAE(
        residual=lambda t, y, dy, a: jnp.stack([dy[0] + y[0] - y[1], a * dy[1] + y[1] - y[0] ** 2])
    )


def solve(dae, y0, args):
    steps = dfx.PIDController(rtol=1e-8, atol=1e-8)
    return dfx.diffeqsolve(
        dae.term, dae.wrap(dfc.Radau()), 0.0, 1.0, 1e-3, y0, args, stepsize_controller=steps,
        throw=False,
    )  # fmt: skip


def outcome(call, dae):
    try:
        return jax.tree.map(np.asarray, call(dae))
    except ValueError as error:
        return str(error)


def test_results_do_not_depend_on_what_was_called_before():
    """Nor on whether anything was: a solve in which JAX traces `args` needs no `consistent`."""
    zero, one = jnp.array(0.0), jnp.array(1.0)
    calls = {
        "report of 0": lambda dae: str(dae.report(GUESS, args=zero)),
        "report of 1": lambda dae: str(dae.report(GUESS, args=one)),
        "consistent": lambda dae: dae.consistent(GUESS, args=one),
        "solve": lambda dae: jax.jit(lambda args: solve(dae, GUESS, args).ys)(one),
    }

    def of(order):
        dae = decided()
        return {name: outcome(calls[name], dae) for name in order}

    there, back = of(list(calls)), of(list(calls)[::-1])
    for name in calls:
        np.testing.assert_array_equal(there[name], back[name])
    assert there["report of 1"].item().startswith("Index 0")
    assert "`dae = dae.at(guess" in there["report of 0"]


def test_at_takes_the_values_that_decide():
    """By an exact solution: `y' = y² - y` of the first, from a solve in which `args` are traced,
    also after other values were asked for."""
    dae, zero = decided(), jnp.array(0.0)
    assert dae.report(GUESS, args=jnp.array(1.0)).index == 0
    there = dae.at(GUESS, args=zero)
    assert there.report(GUESS, args=zero).index == 1
    y0 = jax.jit(lambda args: there.consistent(GUESS, args=args))(zero)
    found = solve(there, y0, zero).ys[-1]
    x = 1 / (1 + np.e)
    assert np.allclose(found, [x, x**2], rtol=1e-7)
    assert there == dae.at(GUESS, args=zero)  # nothing compiles again


def test_numbers_of_python_are_part_of_the_equations():
    """Zeros too. And one search serves them all, and the numbers that JAX traces."""
    dae = decided()
    before = len(dfc._dae.dae._SEARCHES)
    assert [dae.report(GUESS, args=a).index for a in (1.0, 0.0, 9.81)] == [0, 1, 0]
    jax.eval_shape(lambda a: dae.term.vf(0.0, GUESS, a), 2.0)
    assert len(dfc._dae.dae._SEARCHES) == before + 1
    asked = dfc.DAE(residual=lambda t, y, dy, a: (dy[0] - y[1], y[1] - y[0] if a > 0 else dy[1]))
    assert [asked.report(GUESS, args=a).index for a in (1.0, -1.0)] == [1, 0]


def test_a_number_that_is_zero_where_the_structure_is_taken():
    """It may be another one later, and has a derivative: here it brings the slope of a further
    unknown into a hidden constraint."""

    def residual(t, y, dy, share):
        (x, force, other), (dx, _, dother) = y, dy
        return dx - force, x + share * other - jnp.sin(t), dother - other**2

    dae, state = dfc.DAE(residual=residual), (jnp.array(0.2), jnp.array(1.0), jnp.array(0.7))
    there = dae.at(state, args=jnp.array(0.0))
    force = lambda share: there.consistent(state, args=share)[1]  # noqa: E731
    for share in (0.0, 0.3):
        value, by_share = jax.jit(lambda x: jax.jvp(force, (x,), (1.0,)))(share)
        _, _, other = there.consistent(state, args=share)
        assert abs(value - (1 - share * other**2)) < 8 * EPS
        shift = 1e-6
        difference = (force(share + shift) - force(share - shift)) / (2 * shift)
        assert abs(by_share - difference) < 1e-8


def linkage(t, y, dy, args):
    """A four-bar linkage of three rods, each with its two places and its angle, whose joints pull
    by forces that are given as what they do to the rods: index 3."""
    (place, speed, force, pull), (dplace, dspeed, _, _) = y, dy

    def joints(place):
        along = jnp.stack([jnp.cos(place[:, 2]), jnp.sin(place[:, 2])], 1) / 2
        begin, end = place[:, :2] - along, place[:, :2] + along
        ground = jnp.concatenate([begin[0], end[-1] - jnp.array([1.5, 0.0])])
        return jnp.append(ground, end[:-1] - begin[1:])

    weight = jnp.array([0.0, -9.81, 0.0])
    mass = jnp.array([1.0, 1.0, 1 / 12]) * args[:, None]
    pulled = jax.vjp(joints, place)[1](force)[0]
    equation = mass * dspeed - args[:, None] * weight - pull
    return dplace - speed, equation, pull - pulled, joints(place)


def test_hidden_constraints_solve_for_one_slope_at_a_time():
    """Where the equations do: else each derivative of such a constraint costs as much as many
    linear systems."""
    rods = jnp.zeros((3, 3)), jnp.zeros((3, 3)), jnp.zeros(8), jnp.zeros((3, 3))
    structure = _structure(dfc.DAE(residual=linkage), 0.0, rods, jnp.ones(3))
    assert (structure.index, structure.freedom) == (3, 2)
    first, *others, last = structure.eliminations
    assert first is None
    solved = [[np.shape(one.slopes) for one in found.blocks] for found in others]
    assert solved == [[(9, 1)], [(12, 1)]]
    assert sum(map(np.prod, (np.shape(one.slopes) for one in last.blocks))) == 35


@pytest.mark.parametrize("power", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_linear_in_the_slopes_that_are_not_known_yet(power):
    """Lagrange's equations may be written with slopes in the place of velocities: in the
    accelerations they are linear. Not so, if they contain a power of these."""

    def residual(named):
        def equations(t, y, dy, args):
            (q, v, force), (dq, dv, _) = y, dy
            speed = dq if named else v
            push = force * jnp.stack([jnp.ones(()), -2 * q[1]])
            inertia = dv**power + (1 + q**2) * dv
            return dq - v, inertia + q * speed[::-1] ** 2 - push, q[0] - q[1] ** 2 - 1

        return dfc.DAE(residual=equations)

    state = jnp.array([1.25, 0.5]), jnp.array([0.3, 0.3]), jnp.array(0.0)
    found = [_structure(residual(named), 0.0, state, None) for named in (True, False)]
    assert found[0].index == 3
    assert found[0].rounds == found[1].rounds
    for structure in found:
        linear = [[x.is_linear for x in one.blocks] for one in structure.eliminations if one]
        assert all(map(all, linear)) == (power == 1)
    constraints = [_Constraints(residual(named))(0.0, state, None) for named in (True, False)]
    for a, b in zip(*constraints, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-13)
    q, v, force = residual(True).consistent(state)
    slope = residual(True).term.vf(0.0, (q, v, force), None)
    push = force * np.array([1.0, -2 * q[1]])
    np.testing.assert_allclose(
        slope[1] ** power + (1 + q**2) * slope[1] + q * v[::-1] ** 2, push, rtol=1e-12, atol=1e-12
    )
    np.testing.assert_allclose(slope[1][0], 2 * (v[1] ** 2 + q[1] * slope[1][1]), rtol=1e-11)


def test_integers_in_args_may_change():
    """They were taken for constants, so that `consistent` returned a state that is not."""
    dae = decided()
    assert dae.report(GUESS, args=jnp.array(1)).index == 0
    _, y1 = dae.term.vf(0.0, GUESS, jnp.array(2))
    assert np.isclose(y1, (0.25 - 0.2) / 2, rtol=4 * EPS)


def test_unknowns_without_slopes():
    """Of `2 y0' + y4' = 0` neither is one, though only one of both slopes is solved for."""
    mass = np.zeros((5, 5))
    mass[2, 2] = mass[3, 3] = mass[4, 4] = 1
    mass[4, 0] = 2
    dae = dfc.DAE(
        lambda t, u, args: jnp.stack([0.7 - u[0], 0.6 - u[1], 0 * t, -u[3], 0 * t]), mass=mass
    )
    assert dae.report(jnp.ones(5)).algebraic == ("y[1]",)


def test_a_tolerance_below_the_roundoff_of_float32():
    """`z = 1 - sum(x)` is about 1e-6 at first, and has a roundoff of 6e-8."""
    one, dtype = jnp.float32(1.0), np.float32

    def rates(t, x, z, args):
        there = 0.04 * x[0] - 1e4 * x[1] * z
        return jnp.stack([-there, there - 3e7 * x[1] ** 2])

    dae = dfc.DAE(rates, algebraic=lambda t, x, z, args: jnp.sum(x) + z - 1)
    y0 = dae.consistent(jnp.array([1, 0], dtype), jnp.array(0, dtype))

    @jax.jit
    def end(atol):
        steps = dfx.PIDController(rtol=1e-3, atol=atol)
        found = dfx.diffeqsolve(
            dae.term, dae.wrap(dfc.Radau()), 0 * one, one, 1e-5 * one, y0,
            stepsize_controller=steps, max_steps=100, throw=False,
        )  # fmt: skip
        return found.ys[0][-1], found.result == dfx.RESULTS.successful

    for atol in (1e-6, 1e-8, 1e-10):
        x, ok = end(dtype(atol))
        assert x.dtype == dtype
        assert ok
        assert np.allclose(x, [0.9664597, 3.074626e-5], rtol=1e-5)


FAR = dfc.DAE(residual=lambda t, y, dy, args: (dy[0] - y[1], y[1] - jnp.sqrt(y[0] - 1e4)))
FAR_GUESS = jnp.array([2e4, 1.0])


def test_equations_that_are_finite_only_elsewhere():
    """`y = sqrt(2e4 - 1e4)` there."""
    there = FAR.at(FAR_GUESS)
    assert there.report(FAR_GUESS).index == 1
    assert np.allclose(there.consistent(FAR_GUESS), [2e4, 100], rtol=1e-14)


test_mistakes_are_named = refused(
    (lambda: FAR.report(FAR_GUESS), ValueError, r"not finite.*`dae = dae.at\(guess"),
    (lambda: FAR.at(FAR_GUESS).report(jnp.ones(3)), ValueError, "of 2 unknowns"),
    (lambda: jax.jit(lambda y: FAR.at(y).term.vf(0.0, y, None))(FAR_GUESS), TypeError, "traces"),
    (
        lambda: decided().consistent(GUESS, args=jnp.zeros(())),
        ValueError,
        r"other slopes.*index 0 and 2.*dae.at\(",
    ),
)


# ---- Combinations of equations ----


def orthogonal(n, seed):
    return np.linalg.qr(np.random.default_rng(seed).normal(size=(n, n)))[0]


@pytest.mark.parametrize("mixed", [pytest.param(False, marks=pytest.mark.slow), True])
def test_roundoff_of_a_combination_is_no_equation(mixed):
    """Of index 2: condensers between the nodes 1 and 2, and 1 and 5, a voltage between 5 and 1,
    resistors from 2 by 4 to 3, and a coil as the only way to the ground. So no current flows in the
    coil, and the charge of the first condenser is all that is free. The sums of the rows of the
    condensers, which are zero, are so only to roundoff."""
    mass, matrix = np.zeros((7, 7)), np.zeros((7, 7))
    for a, b, capacity in ((0, 1, 0.6), (0, 4, 0.1)):
        mass[np.ix_([a, b], [a, b])] += capacity * np.array([[1, -1], [-1, 1]])
    for a, b, conductance in ((1, 3, 0.8), (3, 2, 0.6)):
        matrix[np.ix_([a, b], [a, b])] -= conductance * np.array([[1, -1], [-1, 1]])
    matrix[0, 5], matrix[4, 5], matrix[5, 0], matrix[5, 4] = 1, -1, -1, 1
    mass[6, 6], matrix[0, 6], matrix[6, 0] = 0.5, -1, 1
    change = orthogonal(7, 0) if mixed else np.eye(7)
    source = -change[:, 5]
    dae = dfc.DAE(lambda t, y, a: change @ matrix @ y + source * jnp.cos(t), mass=change @ mass)
    guess = jnp.array([0.3, 0.6, 1.0, 1.3, 1.6, 0.0, 0.0])
    found = dae.report(guess)
    assert (found.index, found.freedom) == (2, 1)
    y = np.asarray(dae.consistent(guess))
    np.testing.assert_allclose(y[[0, 4, 6]], [0, 1, 0], rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(y[1:4], y[1], atol=1e-14)


def test_a_combination_of_all_equations_changes_nothing():
    """Of a pendulum of index 3: neither the index, nor the consistent state, nor the solution."""
    change = jnp.asarray(orthogonal(5, 1))

    def pendulum(t, y, dy, args):
        (q, v, force), (dq, dv, _) = jnp.split(y, [2, 4]), jnp.split(dy, [2, 4])
        down = jnp.array([0.0, -9.81])
        return jnp.concatenate([dq - v, dv + force * q - down, jnp.sum(q**2, keepdims=True) - 1])

    guess = jnp.array([1.0, 0.1, 0.1, 0.2, 0.3])
    ends = []
    for residual in (pendulum, lambda *given: change @ pendulum(*given)):
        dae = dfc.DAE(residual=residual)
        found = dae.report(guess)
        assert (found.index, found.freedom) == (3, 2)
        y0 = dae.consistent(guess)
        sol = solve(dae, y0, None)
        assert sol.result == dfx.RESULTS.successful
        assert jnp.all(jnp.abs(pendulum(0.0, sol.ys[-1], guess, None)[-1]) < 16 * EPS)
        ends.append((y0, sol.ys[-1]))
    for a, b, accuracy in zip(*ends, (1e-13, 1e-6), strict=True):
        np.testing.assert_allclose(a, b, rtol=accuracy, atol=accuracy)


OUTPUTS = {
    "acceleration": lambda y, dy: dy[1][0],
    "force along x": lambda y, dy: y[2][0] * y[0][0],
    "power": lambda y, dy: y[1] @ dy[1],  # at rest it contains no slopes
    "power of a force": lambda y, dy: y[2][0] * y[0][0] * y[1][0],  # and here nothing but itself
}


@some_of("name, speed", itertools.product(OUTPUTS, (0.0, 1.0)), period=3)
def test_an_output_changes_no_consistent_state(name, speed):
    """A double pendulum whose positions satisfy their constraints keeps them, with an output that
    nothing depends on, and whether it is at rest or not."""

    def lengths(q):
        return jnp.stack([q[0] ** 2 + q[1] ** 2 - 1, (q[2] - q[0]) ** 2 + (q[3] - q[1]) ** 2 - 1])

    def pendulum(t, y, dy, args):
        (q, v, forces), (dq, dv, _) = y, dy
        gravity = 9.81 * jnp.array([0.0, 1.0, 0.0, 1.0])
        return dq - v, dv + gravity - jax.vjp(lengths, q)[1](forces)[0], lengths(q)

    def with_output(t, y, dy, args):
        *states, output = y
        return *pendulum(t, states, dy[:3], args), output - OUTPUTS[name](states, dy)

    q = jnp.array([0.8, -0.6, 1.6, -1.2])
    guess = q, speed * jnp.array([0.3, 0.2, 0.6, 0.8]), jnp.zeros(2)
    alone = dfc.DAE(residual=pendulum).consistent(guess)
    *states, output = dfc.DAE(residual=with_output).consistent((*guess, jnp.array(0.3)))
    np.testing.assert_allclose(states[0], q, rtol=4 * EPS)
    for found, expected in zip(states, alone, strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e3 * EPS)
    slopes = dfc.DAE(residual=pendulum).term.vf(0.0, alone, None)
    np.testing.assert_allclose(output, OUTPUTS[name](alone, slopes), rtol=0, atol=1e3 * EPS)
    if name.startswith("power") and speed == 0:
        assert output == 0  # a solve compares what is left with the state


def test_a_multiplier_of_a_norm_keeps_the_positions():
    """A rod on a joint, whose direction is a unit vector with a multiplier, of index 2 beside the
    joint of index 3: wrong velocities do not move positions that are right."""

    def rod(t, y, dy, args):
        (x, p, v, w, joint, norm), (dx, dp, dv, dw, *_) = y, dy
        along, across = 0.5 * p, jnp.array([-p[1], p[0]])
        return (
            dx - v,
            dp - w * across - norm * p,
            dv - joint - jnp.array([0.0, -9.81]),
            dw + 3 * (along[0] * joint[1] - along[1] * joint[0]),
            x - along,
            p @ p - 1,
        )

    x, p, w = jnp.array([0.3, -0.4]), jnp.array([0.6, -0.8]), jnp.array(1.0)
    zero = jnp.zeros(2)
    found = dfc.DAE(residual=rod).consistent((x, p, jnp.array([0.2, 0.5]), w, zero, jnp.array(0.0)))
    for now, before in zip(found, (x, p), strict=False):
        np.testing.assert_allclose(now, before, rtol=4 * EPS)
    np.testing.assert_allclose(found[2], found[3] * jnp.array([0.4, 0.3]), rtol=1e-14)
    np.testing.assert_allclose(found[5], 0, atol=1e-14)


def test_a_tiny_output_in_single_precision_keeps_its_digits():
    """Also where the guess is many powers of ten too large."""

    def pendulum(t, y, dy, share):
        (q, v, force, output), (dq, dv, *_) = y, dy
        gravity = jnp.array([0.0, -9.81], q.dtype)
        return dq - v, dv + force * q - gravity, jnp.sum(q**2) - 1, output - share * force

    q, one = jnp.array([0.6, -0.8], jnp.float32), jnp.float32(1)
    share = jnp.float32(1e-20)
    found = dfc.DAE(residual=pendulum).consistent((q, 0 * q, 0 * one, one), args=share)
    np.testing.assert_allclose(found[3], 7.848e-20, rtol=1e-6)
