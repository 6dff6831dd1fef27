"""RATTLE: on the constraint to roundoff, symplectic, symmetric."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

from .. import problems
from ..problems import TO_THE_END, assert_lanes, difference, final, largest, refused
from ..thinned import some_of

GRAVITY = np.array([0.0, -1.0])


def rods(t, q, args):
    return jnp.sum(jnp.diff(q, axis=0, prepend=jnp.zeros((1, 2))) ** 2, axis=1) - 1


def loop(t, q, args):
    """Also the distance of the last bead from the origin: a closed loop."""
    return jnp.concatenate([rods(t, q, args), (jnp.sum(q[-1] ** 2) - 2)[None]])


def fall(t, q, args):
    return jnp.broadcast_to(GRAVITY, q.shape).astype(q.dtype)


def springs(t, q, args):
    """So that the motion is not that of a falling chain alone."""
    return fall(t, q, args) - 0.3 * q


def terms(force, masses=1.0):
    return (
        dfx.ODETerm(lambda t, v, args: v),
        dfx.ODETerm(lambda t, q, args: force(t, q, args) / masses),
    )


def chain(beads):
    q = np.stack([np.arange(1.0, beads + 1), np.zeros(beads)], axis=1)
    return jnp.asarray(q), jnp.asarray(0 * q)


MASSES = np.array([[1.0], [2.0], [0.5]])
THREE = dfc.RATTLE(dfc.Constraint(rods), MASSES)
TERMS = terms(springs, MASSES)


def solve(terms, solver, y0, t0, t1, dt0):
    return problems.solve(terms, solver, y0, t0=t0, t1=t1, dt0=dt0, **TO_THE_END)


def off(constraint, y):
    """Of positions and velocities, in units of roundoff of the terms that are added."""

    @jax.jit
    def parts(q, v):
        fn = lambda q: constraint(0.0, q, None)  # noqa: E731
        rows = jnp.abs(jax.jacobian(fn)(q)).reshape(-1, q.size)
        scales = rows @ jnp.abs(q).ravel(), rows @ jnp.abs(v).ravel() + jnp.max(jnp.abs(v))
        return [x / scale for x, scale in zip(jax.jvp(fn, (q,), (v,)), scales, strict=True)]

    return [largest(x) / 2.2e-16 for x in parts(*y)]


@some_of("constraint", [rods, loop], ids=["rods", "loop"], period=2)
def test_a_chain_and_a_closed_loop_stay_on_the_constraint_without_drift(constraint):
    """20 beads; the loop has two, where the rods fix what the third condition says again."""
    y0 = chain(20)
    if constraint is loop:
        y0 = jnp.array([[1.0, 0.0], [1.0, 1.0]]), jnp.array([[0.0, 0.3], [-0.3, 0.3]])
    solver = dfc.RATTLE(dfc.Constraint(constraint), 1.0)
    sol = solve(terms(fall), solver, y0, 0.0, 10.0, 0.01)
    assert dfx.is_okay(sol.result)
    position, velocity = off(constraint, final(sol))
    assert position <= (4 if constraint is rods else 16)
    assert velocity <= 16
    start, end = (
        np.sum(np.square(v)) / 2 - np.sum(np.multiply(q, GRAVITY)) for q, v in (y0, final(sol))
    )
    assert abs(end - start) < 1e-3 * len(y0[0])


def test_second_order_against_the_equations_of_motion():
    """Solved in another way: the tangent field at tight tolerances."""

    def free(t, y, args):
        return y[1], springs(t, y[0], args) / MASSES

    lengths = dfc.Constraint(lambda t, y, args: rods(t, y[0], args))
    field = dfc.tangent(free, lengths.derivative(free), metric=(jnp.inf, MASSES))
    exact = final(
        eqx.filter_jit(dfx.diffeqsolve)(
            dfx.ODETerm(field), dfx.Dopri8(), 0.0, 1.0, None, chain(3), adjoint=dfx.ForwardMode(),
            stepsize_controller=dfx.PIDController(rtol=1e-13, atol=1e-13), max_steps=None,
        )
    )  # fmt: skip
    ends = [final(solve(TERMS, THREE, chain(3), 0.0, 1.0, h)) for h in (0.02, 0.01)]
    coarse, fine = (difference(y, exact) for y in ends)
    assert fine < 1e-3
    assert 3.7 < coarse / fine < 4.3
    # The multipliers, forces in the rods.
    forces = jax.jit(lambda y: (THREE.multipliers(TERMS, 0.0, y), field.multipliers(0.0, y)))
    assert difference(*forces(exact)) < 1e-12


def test_a_step_is_symplectic():
    """Of a pendulum, in the angle and its rate: the area of a small triangle stays."""
    solver, pair = (
        dfc.RATTLE(dfc.Constraint(lambda t, q, args: jnp.sum(q**2) - 1), 1.0),
        terms(fall),
    )

    @jax.jit
    def step(x):
        angle, rate = x
        q = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        v = rate * jnp.stack([-q[1], q[0]])
        options = dict(max_steps=2, adjoint=dfx.ForwardMode())
        q, v = final(dfx.diffeqsolve(pair, solver, 0.0, 0.3, 0.3, (q, v), **options))
        return jnp.stack([jnp.arctan2(q[1], q[0]), q[0] * v[1] - q[1] * v[0]])

    for x in (jnp.array([0.3, 1.0]), jnp.array([-1.0, 0.0])):
        assert abs(jnp.linalg.det(jax.jacfwd(step)(x)) - 1) < 1e-14


def test_saved_times_are_on_the_constraint_and_dense_output_meets_the_states():
    """Of one solve, backwards in time."""

    def on_it(q, v):
        return jax.jvp(lambda q: rods(0.0, q, None), (q,), (v,))

    @jax.jit
    def found(y0):
        subs = dfx.SubSaveAt(ts=jnp.linspace(1.0, 0.0, 33)), dfx.SubSaveAt(steps=True)
        save = dfx.SaveAt(subs=subs, dense=True)
        options = dict(saveat=save, max_steps=32, adjoint=dfx.ForwardMode())
        sol = dfx.diffeqsolve(TERMS, THREE, 1.0, 0.0, -0.05, y0, **options)
        (_, ts), (saved, ys) = sol.ts, sol.ys
        at_steps = jax.vmap(sol.evaluate)(ts[:20]), jax.tree.map(lambda y: y[:20], ys)
        return jax.vmap(on_it)(*saved), at_steps, sol.evaluate(0.52)[1], sol.derivative(0.52)[0]

    (position, velocity), at_steps, v, slope = found(chain(3))
    assert largest(position) < 1e-14
    assert largest(velocity) < 1e-14
    assert difference(*at_steps) < 1e-13
    assert difference(slope, v) < 0.01


@pytest.mark.parametrize(("length", "speed"), [(1.0, 1.0), (1.0, -0.8), (1.2, 1.0)])
def test_a_solve_that_goes_on_equals_a_new_one(length, speed):
    """After an impact too; where the new one is refused, because a rod has become longer, so is
    the other."""
    solver = dfc.RATTLE(dfc.Constraint(lambda t, q, args: jnp.sum(q**2)[None] - args**2), 1.0)

    def run(y0, t0, length, state=None):
        options = dict(saveat=dfx.SaveAt(t1=True, solver_state=True), solver_state=state)
        args = jnp.asarray(length)
        return problems.solve(
            terms(fall), solver, y0, t0=t0, t1=t0 + 1, args=args, **TO_THE_END, **options
        )

    first = run(chain(1), 0.0, 1.0)
    q, v = final(first)
    new, on = (run((q, speed * v), 1.0, length, x) for x in (None, first.solver_state))
    assert bool(new.result == dfx.RESULTS.successful) is (length == 1)
    assert on.result == new.result
    # The multiplier of the last step is the first guess.
    np.testing.assert_allclose(*map(final, (on, new)), rtol=0, atol=1e-14)


@pytest.mark.slow
def test_dense_output_meets_the_state_after_a_jump_of_the_force():
    save = dfx.SaveAt(t1=True, solver_state=True, dense=True)
    options = dict(saveat=save, adjoint=dfx.ForwardMode(), max_steps=1)
    there = dfx.diffeqsolve(TERMS, THREE, 0.0, 0.1, 0.1, chain(3), **options)
    pair = terms(lambda t, q, args: -20 * springs(t, q, args), MASSES)
    state = dict(solver_state=there.solver_state, made_jump=True)
    after = dfx.diffeqsolve(pair, THREE, 0.1, 0.2, 0.1, final(there), **options, **state)
    assert difference(after.evaluate(0.2), final(after)) < 1e-14


def test_masses_that_are_traced_call_nothing_on_the_host(errors_raise):
    def step(masses):
        solver, times = dfc.RATTLE(dfc.Constraint(rods), masses), (0.0, 0.1)
        state = solver.init(TERMS, *times, chain(3), None)
        return solver.step(TERMS, *times, chain(3), None, state, False)[0]

    assert "callback" not in str(jax.make_jaxpr(step)(MASSES))


@pytest.mark.slow
def test_derivatives_in_both_modes_against_finite_differences():
    """Of a closed loop, whose multipliers are not unique."""
    y0 = jnp.array([[1.0, 0.0], [1.0, 1.0]]), jnp.array([[0.0, 0.3], [-0.3, 0.3]])
    solver = dfc.RATTLE(dfc.Constraint(loop), jnp.array([[1.0], [2.0]]))

    def end(strength):
        pair = terms(lambda t, q, args: fall(t, q, None) - args * q)
        options = dict(max_steps=16, adjoint=dfx.DirectAdjoint())
        return final(dfx.diffeqsolve(pair, solver, 0.0, 0.5, 0.05, y0, strength, **options))

    dct.assert_gradients(end, jnp.asarray(0.3), rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("squares", [1, 7])
def test_one_brace_too_many_changes_nothing(squares):
    """The second diagonal of a rigid square says nothing new on the constraint, but contradicts the
    other rods a little off it. In a dense matrix, and in blocks."""
    sides, diagonals = [(0, 1), (1, 2), (2, 3), (3, 0)], [(0, 2), (1, 3)]
    corners = jnp.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    q = corners + 2 * jnp.arange(squares)[:, None, None]
    v = 0.8 * jnp.stack([0.5 - corners[:, 1], corners[:, 0] - 0.1], axis=1)
    force = lambda t, q, args: fall(t, q, args) - q * jnp.array([1.0, 2.0])  # noqa: E731

    def end(pairs):
        i, j = np.array(pairs).T
        square = jnp.sum((corners[i] - corners[j]) ** 2, axis=1)
        rod = lambda t, q, args: jnp.sum((q[:, i] - q[:, j]) ** 2, axis=2) - square  # noqa: E731
        masses = jnp.array([[1.0], [2.0], [1.5], [0.7]])
        y0, solver = (q, jnp.broadcast_to(v, q.shape)), dfc.RATTLE(dfc.Constraint(rod), masses)
        return final(solve(terms(force, masses), solver, y0, 0.0, 1.0, 0.02))

    assert difference(end(sides + diagonals), end(sides + diagonals[:1])) < 1e-12


@pytest.mark.slow
def test_a_lane_is_that_lane_alone_and_float32_works():
    spin = jnp.stack([jnp.zeros(3), jnp.arange(1.0, 4.0)], axis=1)

    def run(w):
        return final(solve(TERMS, THREE, (chain(3)[0], w * spin), 0.0, 1.0, 0.02))

    assert_lanes(run, jnp.array([0.0, 0.5, -1.0]), 1e-13)
    y0 = jax.tree.map(lambda y: y.astype(jnp.float32), chain(3))
    pair = terms(springs, MASSES.astype(np.float32))
    sol = solve(pair, THREE, y0, 0.0, 1.0, 0.02)
    assert dfx.is_okay(sol.result)
    assert sol.ys[0].dtype == jnp.float32
    assert difference(final(sol), run(0.0)) < 1e-4


def test_a_moving_constraint_there_and_back():
    """A pendulum whose pivot goes up and down."""

    def pivot(t):
        return jnp.array([0.0, 0.3 * jnp.sin(2 * t)])

    def moving(t, q, args):
        return jnp.sum((q - pivot(t)) ** 2) - 1

    solver, pair = dfc.RATTLE(dfc.Constraint(moving), 1.0), terms(fall)
    y0 = jnp.array([1.0, 0.0]), jnp.array([0.0, 0.6])
    there = solve(pair, solver, y0, 0.0, 3.0, 0.01)
    assert dfx.is_okay(there.result)
    assert abs(moving(3.0, final(there)[0], None)) < 4e-15
    assert difference(final(solve(pair, solver, final(there), 3.0, 0.0, -0.01)), y0) < 1e-12


@pytest.mark.slow
def test_a_frozen_bead_and_a_plane():
    """A wall; `z = 0` has no scale of its own."""
    walls = dfc.RATTLE(dfc.Constraint(rods), jnp.array([[jnp.inf], [1.0], [1.0]]))
    still = terms(lambda t, q, args: fall(t, q, args).at[0].set(0.0))
    q, v = final(solve(still, walls, chain(3), 0.0, 1.0, 0.01))
    assert (q[0] == chain(3)[0][0]).all()
    assert largest(rods(0.0, q, None)[1:]) < 4e-15
    plane, pair = dfc.RATTLE(dfc.Constraint(lambda t, q, args: q[1]), 1.0), terms(fall)
    q, v = final(solve(pair, plane, (jnp.array([1.0, 0.0]), jnp.array([1.0, 0.0])), 0.0, 1.0, 0.1))
    assert difference((q, v), (jnp.array([2.0, 0.0]), jnp.array([1.0, 0.0]))) < 1e-14


def test_failures_are_results():
    q, v = chain(3)
    broken = terms(lambda t, q, args: jnp.where(t > 0.5, jnp.nan, 1.0) * fall(t, q, args))
    one = dfc.RATTLE(dfc.Constraint(rods), 1.0, max_steps=1)
    for pair, solver, y0, h, message in (
        (TERMS, THREE, (q + 0.1, v), 0.01, "cannot start"),
        (TERMS, THREE, (q, v + jnp.array([1.0, 0.0])), 0.01, "cannot start"),
        (broken, THREE, (q, v), 0.01, "not finite"), (TERMS, one, (q, v), 0.01, "not reached"),
        (TERMS, THREE, (q, v), 5.0, "not finite"),
    ):  # fmt: skip
        sol = solve(pair, solver, y0, 0.0, 1.0 if h < 1 else 10.0, h)
        assert not dfx.is_okay(sol.result)
        assert message in dfx.RESULTS[sol.result]
        assert not np.isfinite(final(sol)[0]).any()


def of(pair=terms(fall), solver=THREE, velocities=0):
    q, v = chain(3)
    return lambda: dfx.diffeqsolve(pair, solver, 0.0, 1.0, 0.1, (q, v[velocities:]))


NOISE_IN_EPS = dfx.VirtualBrownianTree(0.0, 1.0, 1e-3, (), jax.random.key(0))
NOISY = TERMS[0], dfx.ControlTerm(lambda t, q, args: jnp.ones_like(q), NOISE_IN_EPS)
test_mistakes_are_named = refused(
    (lambda: dfc.RATTLE(dfc.FirstIntegral(rods), 1.0), TypeError, "positions"),
    *((lambda x=x: dfc.RATTLE(dfc.Constraint(rods), x), "masses") for x in ("one", -1.0, 0.0)),
    (of(solver=dfc.RATTLE(dfc.Constraint(rods), np.ones((2, 1)))), "masses"),
    (of(velocities=1), "alike"),
    (of(NOISY), ValueError, "ODETerm"),
)


def test_a_node_may_be_pinned_at_zero():
    """Its coordinates stay zero up to roundoff of the multipliers, which cancel there. The same
    pendulum elsewhere is another reference than its own zero."""

    def end(shift):
        constraint = dfc.Constraint(
            lambda t, q, args: {"rod": jnp.sum((q[1] - q[0]) ** 2) - 1, "pin": q[0] - args}
        )
        q0 = jnp.array([[0.0, 0.0, 0.0], [0.6, 0.0, -0.8]]) + shift
        v0 = jnp.zeros((2, 3)).at[1].set(jnp.array([0.0, 0.3, 0.0]))
        terms = (
            dfx.ODETerm(lambda t, v, args: v),
            dfx.ODETerm(lambda t, q, args: jnp.zeros_like(q).at[:, 2].set(-9.81)),
        )
        solver = dfc.RATTLE(constraint, masses=1.0)
        sol = dfx.diffeqsolve(terms, solver, 0, 1, 1e-3, (q0, v0), shift, max_steps=1001)
        return sol.ys[0][-1] - shift

    here, there = jax.jit(jax.vmap(end))(jnp.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]))
    np.testing.assert_allclose(here[0], 0, atol=1e-18)
    np.testing.assert_allclose(here, there, atol=1e-12)
