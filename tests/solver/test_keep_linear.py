"""Linear invariants that nobody declared stay, although the projection knows nothing of them."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc

MASSES = jnp.array([1.0, 0.3, 2.0, 0.7, 1.5])


def springs(t, y, args):
    """A chain of bodies on a line, `y = (q, v)`, with stiffening springs between neighbours."""
    q, v = y
    stretch = jnp.diff(q) - 1
    pull = args * stretch + stretch**3
    return v, (jnp.append(pull, 0.0) - jnp.append(0.0, pull)) / MASSES


def energy(t, y, args):
    q, v = y
    stretch = jnp.diff(q) - 1
    return jnp.sum(MASSES * v**2) / 2 + jnp.sum(args * stretch**2 / 2 + stretch**4 / 4)


def start(x):
    return jnp.arange(5.0) + 0.3 * jnp.sin(x * jnp.arange(1.0, 6.0)), jnp.cos(x + jnp.arange(5.0))


def momentum(t, y, args):
    return jnp.sum(MASSES * y[1])


def solved(solver, controller, x, stiffness, **options):
    solver = dfc.ManifoldProjection(solver, dfc.FirstIntegral(energy), **options)
    return dfx.diffeqsolve(
        dfx.ODETerm(springs), solver, 0.0, 6.0, 0.1, start(x), args=stiffness,
        stepsize_controller=controller, saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 6.0, 38)),
    )  # fmt: skip


FIXED, ADAPTIVE = dfx.ConstantStepSize(), dfx.PIDController(rtol=1e-5, atol=1e-5)


SLOW = pytest.mark.slow  # all of their time is compilation


@pytest.mark.parametrize(
    ("solver", "controller"),
    [
        pytest.param(dfc.RK4(), FIXED, marks=SLOW),
        (dfx.Bosh3(), ADAPTIVE),
        pytest.param(dfx.Kvaerno3(), ADAPTIVE, marks=SLOW),
    ],
    ids=["RK4", "Bosh3", "Kvaerno3"],
)
def test_the_momentum_stays_beside_the_energy(solver, controller):
    """At saved times too, in every lane of a batch. Without the option it is lost, and the error of
    the solution is about the same."""
    xs = jnp.array([0.4, 1.1, 2.3])

    def moved(keep_linear):
        """The largest changes, relative to the sizes of the terms, and the states."""

        @jax.jit
        @jax.vmap
        def found(x):
            ys = solved(solver, controller, x, 2.0, keep_linear=keep_linear).ys
            return [jax.vmap(f, (None, 0, None))(0.0, ys, 2.0) for f in (energy, momentum)], ys

        values, ys = found(xs)
        return *(np.abs(v - v[:, :1]).max() for v in values), ys

    eps = np.finfo(float).eps
    kept_energy, kept_momentum, ys = moved(True)
    lost_energy, lost_momentum, others = moved(False)
    assert kept_energy < 200 * eps > lost_energy  # the energy is about 10
    # A hundred steps of plain summation, and the small share of a correction that leaves the span.
    assert lost_momentum > 1e-7
    assert kept_momentum < 100 * eps + 1e-9 * lost_momentum
    for y, other in zip(ys, others, strict=True):
        assert np.abs(y - other).max() < 0.05


def test_the_method_of_euler_moves_in_its_first_step():
    """Along its only slope the energy hardly changes. A correction along it alone would undo the
    step, and lose the digits of the next direction."""
    kept = dfc.ManifoldProjection(dfx.Euler(), dfc.FirstIntegral(energy), keep_linear=True)

    @jax.jit
    def found(y0, args):
        sol = dfx.diffeqsolve(
            dfx.ODETerm(springs), kept, 0.0, 0.05, 0.005, y0, args,
            saveat=dfx.SaveAt(steps=True, t0=True), max_steps=16,
        )  # fmt: skip
        values = [jax.vmap(f, (None, 0, None))(0.0, sol.ys, args) for f in (energy, momentum)]
        return *(jnp.max(jnp.abs(v - v[0]), where=jnp.isfinite(v), initial=0) for v in values), sol

    y0 = start(0.4)
    kept_energy, kept_momentum, sol = found(y0, 2.0)
    assert kept_energy < 1e-14 > kept_momentum
    change = sol.ys[0][1] - y0[0]
    np.testing.assert_allclose(change, 0.005 * y0[1], rtol=0.2, atol=1e-5)


def test_a_declared_linear_invariant_is_kept_too():
    """Its gradient is orthogonal to all directions in which the solution moves."""
    manifold = {"energy": dfc.FirstIntegral(energy), "momentum": dfc.FirstIntegral(momentum)}
    solver = dfc.ManifoldProjection(dfc.RK4(), manifold, keep_linear=True)

    @jax.jit
    def off(y0, args):
        sol = dfx.diffeqsolve(
            dfx.ODETerm(springs), solver, 0.0, 6.0, 0.1, y0, args,
            saveat=dfx.SaveAt(steps=True, t0=True), max_steps=64,
        )  # fmt: skip
        return dfc.off_manifold(sol, manifold, args=args)

    assert not np.any(off(start(0.4), 2.0))


@SLOW
def test_the_derivative_is_that_of_differences():
    def end(stiffness):
        return solved(dfc.RK4(), FIXED, 0.4, stiffness, keep_linear=True).ys[0][-1]

    derivative = jax.jacrev(end)(2.0)
    plus, minus = end(2.0 + 1e-5), end(2.0 - 1e-5)
    np.testing.assert_allclose(derivative, (plus - minus) / 2e-5, rtol=1e-6, atol=1e-7)


def test_more_constraints_than_directions_are_refused():
    many = dfc.FirstIntegral(lambda t, y, args: jnp.concatenate(y))
    solver = dfc.ManifoldProjection(dfc.RK4(), many, keep_linear=True)
    with pytest.raises(ValueError, match=r"keep_linear.*8 directions.*10 scalar.*compare"):
        solver.init(dfx.ODETerm(springs), 0.0, 0.1, start(0.4), 2.0)
