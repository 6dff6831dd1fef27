"""Linear invariants that nobody declared stay, although the projection knows nothing of them."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

from .. import problems

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


def solved(solver, controller, x, stiffness, adjoint=dfx.ForwardMode(), **options):
    solver = dfc.ManifoldProjection(solver, dfc.FirstIntegral(energy), **options)
    return dfx.diffeqsolve(
        dfx.ODETerm(springs), solver, 0.0, 6.0, 0.1, start(x), args=stiffness,
        stepsize_controller=controller, saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 6.0, 38)),
        adjoint=adjoint,
    )  # fmt: skip


def steps(solver, y0, args, field=springs, **options):
    """A solve that saves all of its steps."""
    saveat = dfx.SaveAt(steps=True, t0=True)
    return problems.solve(field, solver, y0, args=args, saveat=saveat, **options)


FIXED, ADAPTIVE = dfx.ConstantStepSize(), dfx.PIDController(rtol=1e-5, atol=1e-5)


SLOW = pytest.mark.slow  # all of their time is compilation


@pytest.mark.parametrize(
    ("solver", "controller"),
    [
        (dfc.RK4(), FIXED),
        pytest.param(dfx.Bosh3(), ADAPTIVE, marks=SLOW),
        pytest.param(dfx.Kvaerno3(), ADAPTIVE, marks=SLOW),
    ],
    ids=["RK4", "Bosh3", "Kvaerno3"],
)
def test_the_momentum_stays_beside_the_energy(solver, controller):
    """At saved times too. Without the option it is lost, and the error of the solution is about the
    same."""
    xs = jnp.array([0.4, 1.1, 2.3])

    def moved(keep_linear):
        """The largest changes, relative to the sizes of the terms, and the states."""

        @jax.jit
        def found(x):
            ys = solved(solver, controller, x, 2.0, keep_linear=keep_linear).ys
            return [jax.vmap(f, (None, 0, None))(0.0, ys, 2.0) for f in (energy, momentum)], ys

        values, ys = jax.tree.map(lambda *v: np.stack(v), *map(found, xs))
        return *(np.abs(v - v[:, :1]).max() for v in values), ys

    eps = np.finfo(float).eps
    kept_energy, kept_momentum, ys = moved(True)
    lost_energy, lost_momentum, others = moved(False)
    assert kept_energy < 200 * eps > lost_energy  # the energy is about 10
    # A hundred steps of plain summation, of an implicit method with its linear systems, and the
    # small share of a correction that leaves the span.
    summation = 500 if isinstance(solver, dfx.AbstractImplicitSolver) else 100
    assert lost_momentum > 1e-7
    assert kept_momentum < summation * eps + 1e-9 * lost_momentum
    for y, other in zip(ys, others, strict=True):
        assert np.abs(y - other).max() < 0.05


def test_the_method_of_euler_moves_in_its_first_step():
    """Along its only slope the energy hardly changes. A correction along it alone would undo the
    step, and lose the digits of the next direction."""
    kept = dfc.ManifoldProjection(dfx.Euler(), dfc.FirstIntegral(energy), keep_linear=True)

    @jax.jit
    def found(y0, args):
        sol = steps(kept, y0, args, t1=0.05, dt0=0.005, max_steps=16)
        values = [jax.vmap(f, (None, 0, None))(0.0, sol.ys, args) for f in (energy, momentum)]
        made = ~jnp.isinf(sol.ts)
        return *(jnp.max(jnp.abs(v - v[0]), where=made, initial=0) for v in values), sol

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
        sol = steps(solver, y0, args, t1=6.0, max_steps=64)
        return dfc.off_manifold(sol, manifold, args=args)

    assert not np.any(off(start(0.4), 2.0))


def test_five_integrals_take_the_directions_of_two_steps():
    """Pairs of bodies, each on a spring of its own. A step of RK4 has three directions, so that the
    momenta of the pairs stay from the second step on."""
    stiffness = jnp.arange(1.0, 6.0) ** 2

    def field(t, y, args):
        q, v = y
        pull = stiffness * (q[0] - q[1])
        return v, jnp.stack([-pull, pull])

    def energies(t, y, args):
        q, v = y
        return (jnp.sum(v**2, axis=0) + stiffness * (q[0] - q[1]) ** 2) / 2

    squares = jnp.arange(10.0).reshape(2, 5) ** 2
    y0 = jnp.sin(squares), jnp.cos(squares)
    solver = dfc.ManifoldProjection(dfc.RK4(), dfc.FirstIntegral(energies), keep_linear=True)
    _, v = steps(solver, y0, None, field, t1=0.45, max_steps=5).ys
    first, *later = np.abs(np.diff(np.sum(v, axis=1), axis=0)).max(axis=1)
    assert first > 1e-8
    assert np.max(later) < 1e-3 * first


@SLOW
def test_the_derivative_is_that_of_differences():
    def end(stiffness):
        adjoint = dfx.RecursiveCheckpointAdjoint()
        return solved(dfc.RK4(), FIXED, 0.4, stiffness, adjoint, keep_linear=True).ys[0][-1]

    dct.assert_gradients(end, 2.0, rtol=1e-7, forward=False)


def test_more_constraints_than_directions_are_refused():
    many = dfc.FirstIntegral(lambda t, y, args: jnp.concatenate(y))
    solver = dfc.ManifoldProjection(dfc.RK4(), many, keep_linear=True)
    with pytest.raises(ValueError, match=r"keep_linear.*8 directions.*10 scalar.*compare"):
        jax.eval_shape(lambda x: solver.init(dfx.ODETerm(springs), 0.0, 0.1, start(x), 2.0), 0.4)
