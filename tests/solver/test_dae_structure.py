"""The structure of a DAE belongs to the equations: it depends neither on what is called first nor
on values, unless `at` says so. What is below roundoff is no error."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import diffrax_conserve as dfc

from ..problems import EPS, refused

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
        r"index 1 and 1 degrees of freedom.*index 0 and 2.*dae.at\(",
    ),
)
