"""A lane of a batch is that lane alone, in value and derivative, for every solver and all saving.

While the longest lane of a batch goes on, diffrax evaluates steps of no length in the lanes that
have arrived, and discards the results. In reverse mode their cotangents are zero, and zero times a
derivative that is infinite is NaN. So the lanes here take unlike numbers of steps, and one fails.
"""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import diffrax_conserve as dfc

from ..learned import EAST, RADIUS, Rotation, turning

ENERGY = dfc.FirstIntegral(lambda t, y, p: y[1] ** 2 / 2 - p * jnp.cos(y[0]))
LOSSES = dfc.FirstIntegral(ENERGY.fn, rate=lambda t, y, p: -0.1 * y[1] ** 2)
PENDULUM = dfx.ODETerm(lambda t, y, p: jnp.stack([y[1], -p * jnp.sin(y[0])]))
DAMPED = dfx.ODETerm(lambda t, y, p: jnp.stack([y[1], -p * jnp.sin(y[0]) - 0.1 * y[1]]))
SPLIT = dfx.ODETerm(lambda t, v, p: v), dfx.ODETerm(lambda t, q, p: -p * jnp.stack([0 * t, 1.0]))
CIRCLE = dfc.Constraint(lambda t, q, p: jnp.sum(q**2) - 1)
TURN = dfx.ODETerm(lambda t, y, p: p * jnp.stack([-y[1], y[0]]))
# Five rotors, each of unit length.
ROTORS = dfc.Constraint(lambda t, y, p: jnp.sum(y**2, axis=1) - 1)
TURNS = dfx.ODETerm(lambda t, y, p: p * jnp.stack([-y[:, 1], y[:, 0]], axis=1))
SHARES = dfc.Constraint(lambda t, y, p: jnp.sum(y) - 1)
DECAY = dfx.ODETerm(lambda t, y, p: p * jnp.stack([-y[0], y[0] - y[1], y[1]]))
BEAD = dfc.DAE(
    lambda t, x, z, p: jnp.stack([x[2], x[3], z * x[0], z * x[1] - p]),
    algebraic=lambda t, x, z, p: x[0] ** 2 + x[1] ** 2 - 1,
)
INDEX_1 = dfc.DAE(lambda t, x, z, p: -p * z, algebraic=lambda t, x, z, p: z + z**3 - x)
SPRING = dfx.ODETerm(lambda t, y, p: jnp.stack([y[1], -y[0]]))

ON_CIRCLE = dfc.ClosedForm(lambda t, y, args, values: y / jnp.sqrt(jnp.sum(y**2)))
STAGED = dfc.Staged(("energy", dfc.Newton()))
POSITIVE = dfc.SimplifiedNewton(lower=0.0)
ROOT = optx.Newton(rtol=1e-10, atol=1e-10)
BEGIN = jnp.array([1.0, 0.5])
BEAD0 = jnp.array([1.0, 0.0, 0.0, 0.2]), jnp.array(-0.04)
wrap = dfc.ManifoldProjection


def bottom(t, y, args, **kwargs):
    """Zero before the end, in each lane."""
    return y[0] - 0.9


def nearby(**options):
    return wrap(dfx.Tsit5(), ENERGY, **options)


# Terms, solver, initial state, and what else `diffeqsolve` is given.
CASES = {
    "plain": (PENDULUM, dfx.Dopri5(), BEGIN),
    "Dopri5": (PENDULUM, wrap(dfx.Dopri5(), ENERGY), BEGIN),
    "constraint": (TURN, wrap(dfx.Bosh3(), CIRCLE), EAST),
    "many constraints": (TURNS, wrap(dfx.Heun(), ROTORS), jnp.tile(EAST, (5, 1))),
    "Newton": (PENDULUM, nearby(projection=dfc.Newton()), BEGIN),
    "along the error": (PENDULUM, nearby(projection=dfc.AlongLine(direction="error")), BEGIN),
    "along the step": (PENDULUM, nearby(projection=dfc.AlongLine(direction="step")), BEGIN),
    "closed form": (TURN, wrap(dfx.Heun(), CIRCLE, projection=ON_CIRCLE), EAST),
    "staged": (PENDULUM, wrap(dfx.Heun(), {"energy": ENERGY}, projection=STAGED), BEGIN),
    "bounds": (DECAY, wrap(dfx.Heun(), SHARES, projection=POSITIVE), jnp.array([1.0, 0.0, 0.0])),
    "balance": (DAMPED, wrap(dfx.Tsit5(), LOSSES), BEGIN),
    "linear invariants": (PENDULUM, nearby(keep_linear=True), BEGIN),
    "longest correction": (PENDULUM, nearby(max_correction=0.5), BEGIN),
    "given metric": (PENDULUM, nearby(projection=dfc.SimplifiedNewton(metric=1.0)), BEGIN),
    "event": (PENDULUM, nearby(), BEGIN, dict(event=dfx.Event(bottom, ROOT))),
    "RK4": (PENDULUM, wrap(dfc.RK4(), ENERGY), BEGIN),
    "ImplicitMidpoint": (PENDULUM, dfc.ImplicitMidpoint(), BEGIN),
    "SymmetricProjection": (
        PENDULUM,
        dfc.SymmetricProjection(dfc.ImplicitMidpoint(), ENERGY),
        BEGIN,
    ),
    "RATTLE": (SPLIT, dfc.RATTLE(CIRCLE, masses=1.0), (EAST, 0.2 * EAST[::-1])),
    "Radau": (PENDULUM, dfc.Radau(), BEGIN),
    "projected Radau": (PENDULUM, wrap(dfc.Radau(), ENERGY), BEGIN),
    "DAE of index 1": (INDEX_1.term, INDEX_1.wrap(dfc.Radau()), (jnp.array(2.0), jnp.array(1.0))),
    "DAE of index 3": (BEAD.term, BEAD.wrap(dfc.Radau()), BEAD0),
    "DAE by Tsit5": (BEAD.term, BEAD.wrap(dfx.Tsit5()), BEAD0),
    "PINN": (SPRING, wrap(dfc.PINNSolver(turning()), RADIUS), EAST),
    "DeepONet": (SPRING, dfc.DeepONetSolver(Rotation()), EAST),
    "projected DeepONet": (SPRING, wrap(dfc.DeepONetSolver(Rotation(off=0.1)), RADIUS), EAST),
}
ADAPTIVE_ONLY = {"Radau", "projected Radau", "DAE of index 1", "DAE of index 3"}
FIXED_ONLY = {
    *("ImplicitMidpoint", "SymmetricProjection", "RATTLE", "RK4"),
    *("PINN", "DeepONet", "projected DeepONet"),  # their steps have a longest length
}
# The first steps of the lanes. The last lane fails.
LANES = {"adaptive": (1e-1, 1e-3, 1e-6, 1e-6), "fixed": (1 / 2, 1 / 4, 1 / 8, 1 / 8)}
OFF = jnp.array([0.0, 0.0, 0.0, jnp.nan])


def observed(case, steps, adjoint, p, size, off):
    """Everything that can be saved, as a PyTree, and whether the solve succeeded."""
    terms, solver, y0, *options = CASES[case]
    saveat = dfx.SaveAt(
        subs=[dfx.SubSaveAt(t0=True, ts=jnp.array([0.33, 0.7, 1.0])), dfx.SubSaveAt(steps=True)],
        dense=True,
    )
    adaptive = dfx.PIDController(rtol=1e-4, atol=1e-4)
    sol = dfx.diffeqsolve(
        terms,
        solver,
        0.0,
        1.0,
        size,
        jax.tree.map(lambda y: p[1] * y + off, y0),
        p[0],
        saveat=saveat,
        stepsize_controller=adaptive if steps == "adaptive" else dfx.ConstantStepSize(),
        adjoint=adjoint,
        max_steps=128 if steps == "adaptive" else 16,
        throw=False,
        **(options[0] if options else {}),
    )
    between = jax.vmap(sol.evaluate)(jnp.array([0.2, 0.45]))
    # What follows an event, or the last step, is infinite.
    saved = jax.tree.map(lambda y: jnp.where(jnp.isinf(y), 0, y), (sol.ys, between))
    return saved, (sol.result == dfx.RESULTS.successful, sol.stats["num_steps"])


def derivatives(case, steps, adjoint, size, off):
    """The values, their derivatives in the modes that the adjoint has, and whether all is well."""
    run = lambda p: observed(case, steps, adjoint, p, size, off)  # noqa: E731
    p, found = jnp.array([1.3, 1.0]), []
    if not isinstance(adjoint, dfx.RecursiveCheckpointAdjoint):
        saved, tangent, okay = jax.jvp(run, (p,), (jnp.array([1.0, 0.5]),), has_aux=True)
        found.append(tangent)
    if not isinstance(adjoint, dfx.ForwardMode):
        saved, vjp, okay = jax.vjp(run, p, has_aux=True)
        # A weight of its own for each number.
        weights = lambda x: jnp.cos(jnp.arange(x.size, dtype=x.dtype)).reshape(x.shape)  # noqa: E731
        found += vjp(jax.tree.map(weights, saved))
    return saved, found, okay


def cases(by_default=None):
    """Parametrises a law by all cases, all slow but one at most: each takes half a minute."""
    pairs = [(case, "adaptive") for case in CASES if case not in FIXED_ONLY]
    pairs += [(case, "fixed") for case in CASES if case not in ADAPTIVE_ONLY]
    marks = {True: (), False: pytest.mark.slow}
    return pytest.mark.parametrize(
        ("case", "steps"),
        [pytest.param(*x, id="-".join(x), marks=marks[x == by_default]) for x in pairs],
    )


def check(case, steps, adjoint):
    lanes = eqx.filter_jit(jax.vmap(lambda *x: derivatives(case, steps, adjoint, *x)))
    sizes = jnp.asarray(LANES[steps])
    # The root finder of an event raises where one lane is not finite, in plain solves too.
    fails = case != "event"
    saved, found, (okay, count) = lanes(sizes, OFF if fails else jnp.zeros(4))
    # The only solver that does not notice a start that is not finite.
    unnoticed = case == "plain" and steps == "fixed"
    assert okay.tolist() == [True, True, True, unnoticed or not fails]
    assert count[0] < count[2], "The lanes take unlike numbers of steps."
    for i in range(3):
        # The same program, in all of whose lanes is this one.
        expected = lanes(jnp.full(4, sizes[i]), jnp.zeros(4))[:2]
        for a, b in zip(*map(jax.tree.leaves, ((saved, found), expected)), strict=True):
            assert np.all(np.isfinite(b[0]))
            limit = 1e-9 * np.max(np.abs(b[0]), initial=1e-3)
            np.testing.assert_allclose(a[i], b[0], rtol=0, atol=limit)


@cases(("Dopri5", "fixed"))
def test_in_reverse_mode(case, steps):
    check(case, steps, dfx.RecursiveCheckpointAdjoint())


@cases(("RATTLE", "fixed"))
def test_in_forward_mode(case, steps):
    check(case, steps, dfx.ForwardMode())


# Its loop, which is bounded, keeps and discards what that of reverse mode does.
@cases()
def test_in_both_modes(case, steps):
    check(case, steps, dfx.DirectAdjoint())
