"""Circuits of textbooks, as the nodal analysis states them, beside scipy on reduced equations, and
exact solutions."""

import functools as ft

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import diffrax_conserve as dfc

from ..problems import TO_THE_END, largest

PEAK, FREQUENCY = 10.0, 100 * np.pi


def source(t, module=jnp):
    return PEAK * module.sin(FREQUENCY * t)


def diode(voltage, module=jnp):
    return 1e-12 * module.expm1(voltage / 0.02585)


# Optimised, as users compile: a product that is added to a sum has no roundoff of its own then.
@ft.partial(jax.jit, static_argnums=0, compiler_options=dict(xla_backend_optimization_level="2"))
def solve(dae, y0, time, dt0, dtmax=None, tol=1e-6):
    """The last state, the result, and how many steps were rejected."""
    steps = dfx.PIDController(rtol=tol, atol=tol, dtmax=dtmax)
    options = TO_THE_END | dict(stepsize_controller=steps, max_steps=4096)
    solver = dae.wrap(dfc.Radau())
    found = dfx.diffeqsolve(dae.term, solver, 0.0, time, dt0, y0, **options)
    return found.ys[-1], found.result, found.stats["num_rejected_steps"]


def doubler(t, y, slopes, args):
    """Two diodes and two condensers charge to twice the peak of the source."""
    v, by_slope = y[:3], slopes[:3]
    charging = 1e-5 * (by_slope[0] - by_slope[1])
    up, on = diode(-v[1]), diode(v[1] - v[2])
    output = 1e-5 * by_slope[2] - on + v[2] / 1e5
    return jnp.stack([y[3] + charging, on - up - charging, output, v[0] - source(t)])


def test_a_step_in_which_newton_fails_is_tried_again():
    """A first step that is far too long fails, with the voltage of the source far from where it
    started, and the solve goes on with shorter ones: whether the projection of a failed step
    succeeds says nothing."""

    def slopes(t, v):
        up, on = diode(-v[0], np), diode(v[0] - v[1], np)
        rise = PEAK * FREQUENCY * np.cos(FREQUENCY * t)
        return np.array([rise + (up - on) / 1e-5, (on - v[1] / 1e5) / 1e-5])

    time = 4e-3
    exact = solve_ivp(slopes, (0, time), [0.0, 0.0], "Radau", rtol=1e-9, atol=1e-9).y[:, -1]
    dae = dfc.DAE(residual=doubler)
    y0 = dae.consistent(jnp.zeros(4))
    for dt0 in (1e-6, 1e-3, 4e-3):
        y, result, num_rejected = solve(dae, y0, time, jnp.array(dt0))
        assert result == dfx.RESULTS.successful
        assert num_rejected > 0
        np.testing.assert_allclose(y[1:3], exact, rtol=1e-5)


def bridge(t, y, slopes, args):
    """Four diodes, a condenser and a load behind a source with a leak to the ground."""
    a, b, v, current = y
    forth = current + diode(a - v) - diode(-a)
    back = b / 1e6 - current + diode(b - v) - diode(-b)
    load = 1e-4 * slopes[2] - diode(a - v) - diode(b - v) + v / 1e3
    return jnp.stack([forth, back, load, a - b - source(t)])


def test_diodes_that_block_leave_no_current_but_roundoff():
    """The currents through two diodes are equal to the last digit then, and the current through the
    source is the roundoff of their difference, in which no correction converges."""

    def slope(t, y):
        (v,) = y

        def leak(b):
            a = b + source(t, np)
            through = diode(a - v, np) + diode(b - v, np) - diode(-a, np) - diode(-b, np)
            return through + b / 1e6

        b = brentq(leak, -2 * PEAK, 2 * PEAK, xtol=1e-13)
        through = diode(b + source(t, np) - v, np) + diode(b - v, np)
        return [(through - v / 1e3) / 1e-4]

    dae, time = dfc.DAE(residual=bridge), 1.5e-2
    y0 = dae.consistent(jnp.zeros(4))
    y, result, _ = solve(dae, y0, time, jnp.array(1e-6), dtmax=1e-4, tol=1e-5)
    assert result == dfx.RESULTS.successful
    options = dict(rtol=1e-8, atol=1e-8, max_step=1e-4)
    with np.errstate(over="ignore"):
        exact = solve_ivp(slope, (0, time), [0.0], "Radau", **options).y[0, -1]
    np.testing.assert_allclose(y[2], exact, rtol=1e-5)
    np.testing.assert_allclose(y[0] - y[1], source(time), rtol=1e-12)


def test_derivatives_through_diodes_that_block():
    """With the least conductance of circuit simulators beside each diode, the mean of two voltages
    is hardly determined while all block. What it is decides about nothing, so that a derivative is
    as exact as the solution."""

    def charging(t, x, z, peak):
        return (diode(z[0] - x) + diode(z[1] - x) - x / 100) / 470e-6

    def kirchhoff(t, x, z, peak):
        through = lambda voltage: diode(voltage) + 1e-12 * voltage  # noqa: E731
        current = (peak / PEAK * source(t) - (z[0] - z[1])) / 0.5
        into = current - through(z[0] - x) + through(-z[0])
        return jnp.stack([into, -current - through(z[1] - x) + through(-z[1])])

    dae = dfc.DAE(charging, algebraic=kirchhoff)
    steps = dfx.PIDController(rtol=1e-7, atol=1e-7)

    def end(peak):
        y0 = dae.consistent(jnp.zeros(()), jnp.zeros(2), args=peak)
        options = dict(stepsize_controller=steps, adjoint=dfx.ForwardMode(), max_steps=1024)
        solver = dae.wrap(dfc.Radau())
        found = dfx.diffeqsolve(dae.term, solver, 0.0, 6e-3, 1e-6, y0, peak, **options)
        return found.ys[0][-1]

    derivative = jax.jit(lambda peak: jax.jvp(end, (peak,), (1.0,)))
    (above, _), (below, _) = derivative(PEAK + 1e-2), derivative(PEAK - 1e-2)
    np.testing.assert_allclose(derivative(PEAK)[1], (above - below) / 2e-2, rtol=2e-5)


@pytest.mark.parametrize("copies", [1, pytest.param(25, marks=pytest.mark.slow)])
def test_a_virtual_ground_has_not_moved(copies):
    """A differentiator by an ideal amplifier, whose input is at a voltage of zero all the time: an
    unknown that has no size. Its transient ends within microseconds. By sparse matrices too."""
    into, feedback, resistance, omega = 1e-6, 1e-9, 1e3, 1e3

    def residual(t, y, slopes, args):
        v_in, ground, v_out, i_in, i_out = y
        charging, back = into * (slopes[0] - slopes[1]), feedback * (slopes[2] - slopes[1])
        through = back + (v_out - ground) / resistance
        source, load = v_in - jnp.sin(omega * t), v_out / 1e4
        return jnp.stack(
            [i_in + charging, charging + through, i_out + through + load, source, ground]
        )

    dae, time = dfc.DAE(residual=residual), 1e-2
    y, result, _ = solve(dae, dae.consistent(jnp.zeros((5, copies))), time, jnp.array(1e-6))
    assert result == dfx.RESULTS.successful
    rate, angle = 1 / (resistance * feedback), omega * time
    wave = rate * np.cos(angle) + omega * np.sin(angle)
    v_out = -into / feedback * omega * wave / (rate**2 + omega**2)
    np.testing.assert_allclose(y[2], v_out, rtol=1e-6)
    assert largest(y[1]) < 1e-15


def differentiator(t, y, slopes, args):
    """As above, without a load, and with units as in a textbook: exact are `0, 0, -1, -1, 1`."""
    v_in, ground, v_out, i_in, i_out = y
    charging, back = slopes[0] - slopes[1], v_out - ground
    return jnp.stack([i_in + charging, -charging - back, back + i_out, v_in - jnp.sin(t), ground])


def controlled(t, y, slopes, args):
    """A pendulum hangs where a controller measures zero and pushes with a force of two."""
    q, v, (tension, measured, push) = y[:2], y[2:4], y[4:]
    forces = jnp.stack([push, -9.81]) - tension * q
    outputs = jnp.stack([measured - q[0], push - 4 * (0.5 - measured)])
    return jnp.concatenate([slopes[:2] - v, slopes[2:4] - forces, (q @ q - 1)[None], outputs])


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize(
    ("residual", "guess", "exact"),
    [
        (differentiator, jnp.zeros(5), [0, 0, -1, -1, 1]),
        (controlled, jnp.zeros(7).at[1].set(-1), [0, -1, 0, 0, 9.81, 0, 2]),
    ],
)
def test_a_zero_beside_what_is_not_is_found_from_zero(residual, guess, exact, dtype):
    """Roundoff of the others leaves it at a number that no size of its own says is zero."""
    found = dfc.DAE(residual=residual).consistent(guess.astype(dtype))
    np.testing.assert_allclose(found, exact, rtol=4 * jnp.finfo(dtype).eps)


def test_an_output_of_a_nonlinear_slope():
    """`y = p³ + p`, `p = y'`: `3/2 p² + log p - t` is constant. A first Jacobian at slopes of zero
    would be a third of that at the slope, at which Newton's method diverges in any step."""

    def residual(t, y, slopes, args):
        return jnp.stack([slopes[0] ** 3 + slopes[0] - y[0], y[1] - slopes[0]])

    dae = dfc.DAE(residual=residual)
    y0 = dae.consistent(jnp.array([2.0, 0.5]))
    np.testing.assert_allclose(y0, [2.0, 1.0], rtol=1e-14)
    (_, p), result, _ = solve(dae, y0, 1.0, jnp.array(1e-3))
    assert result == dfx.RESULTS.successful
    np.testing.assert_allclose(1.5 * p**2 + np.log(p), 2.5, rtol=1e-6)
