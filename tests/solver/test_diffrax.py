"""What diffrax offers around a solve works around a projected one."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import diffrax_conserve as dfc

from ..problems import (
    OMEGA0,
    RIGID_BODY,
    Counted,
    difference,
    drift_of,
    largest,
    oscillator,
    rigid_body,
    solve,
)
from ..thinned import some_of

BALL = dfc.ManifoldProjection(dfx.Heun(), RIGID_BODY)


@pytest.mark.parametrize(
    ("backwards", "forwards"),
    [
        (dfx.RecursiveCheckpointAdjoint(), dfx.ForwardMode()),
        pytest.param(dfx.DirectAdjoint(), dfx.DirectAdjoint(), marks=pytest.mark.slow),
    ],
    ids=["one-mode", "both-modes"],
)
def test_adjoints_agree(backwards, forwards):
    """Reverse and forward mode, through the loops of each adjoint."""

    def final(y0, adjoint):
        return solve(rigid_body, BALL, y0, t1=0.5, max_steps=16, adjoint=adjoint).ys[-1]

    direction, weights = jnp.array([0.3, -1.0, 0.5]), jnp.array([1.0, -0.7, 0.4])
    reverse = jax.jit(jax.grad(lambda y0: weights @ final(y0, backwards)))(OMEGA0)
    jvp = jax.jit(lambda y0: jax.jvp(lambda y0: final(y0, forwards), (y0,), (direction,)))
    _, forward = jvp(OMEGA0)
    plus, minus = (jvp(OMEGA0 + h * direction)[0] for h in (1e-5, -1e-5))
    expected = (plus - minus) / 2e-5
    np.testing.assert_allclose(reverse @ direction, weights @ expected, rtol=0, atol=1e-8)
    np.testing.assert_allclose(forward, expected, rtol=0, atol=1e-8)


def test_a_batch_whose_size_is_not_known_yet_is_exported():
    final = jax.vmap(lambda y0: solve(rigid_body, BALL, y0, t1=0.5, throw=False).ys[-1])
    like = jax.ShapeDtypeStruct((*jax.export.symbolic_shape("lanes"), 3), OMEGA0.dtype)
    starts = jnp.stack([OMEGA0, 2 * OMEGA0])
    exported = jax.export.export(jax.jit(final))(like)
    np.testing.assert_allclose(exported.call(starts), final(starts), rtol=1e-15)


CIRCLE = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))


def test_backsolve_adjoint_explains():
    with pytest.raises(ValueError, match=r"BacksolveAdjoint\(solver=inner\)"):
        jax.eval_shape(
            jax.grad(
                lambda y0: solve(rigid_body, BALL, y0, adjoint=dfx.BacksolveAdjoint()).ys[0, 0]
            ),
            OMEGA0,
        )


def test_gradient_with_respect_to_conserved_value_end_time_and_what_is_closed_over():
    def loss(value, t1, k):
        integral = dfc.FirstIntegral(lambda t, y, args: k * jnp.sum(y**2), value=k * value)
        nearest = dfc.SimplifiedNewton(metric=1.0)
        solver = dfc.ManifoldProjection(dfc.RK4(), integral, projection=nearest)
        y0 = jnp.array([1.0, 0.0])
        sol = solve(lambda t, y, args: k * oscillator(t, y, args), solver, y0, t1=t1, dt0=0.05)
        return sol.ys[-1, 0]

    # The solution is `sqrt(value) cos kt`, up to the error of the integrator.
    dv, dt, dk = jax.jit(jax.grad(loss, argnums=(0, 1, 2)))(1.0, 2.0, 1.0)
    np.testing.assert_allclose([dv, dt], [np.cos(2.0) / 2, -np.sin(2.0)], rtol=0, atol=1e-6)
    np.testing.assert_allclose(dk, -2 * np.sin(2.0), rtol=0, atol=1e-4)


def test_event_lands_on_the_manifold_at_the_right_time_with_a_right_gradient():
    event = dfx.Event(lambda t, y, args, **kwargs: y[0], optx.Newton(1e-12, 1e-12))

    def crossing(y0, direction):
        solver = dfc.ManifoldProjection(dfc.RK4(), CIRCLE)
        times = dict(t1=9.0 * direction, dt0=0.01 * direction)
        sol = solve(oscillator, solver, y0, event=event, adjoint=dfx.ForwardMode(), **times)
        return sol.ts[0], (sol.ts[0], sol.ys[0])

    compiled = jax.jit(jax.jacfwd(crossing, has_aux=True))
    for direction in (1.0, -1.0):
        gradient, (t, y) = compiled(jnp.array([1.0, 0.0]), direction)
        np.testing.assert_allclose(t, direction * np.pi / 2, rtol=0, atol=1e-9)
        assert abs(float(jnp.sum(y**2)) - 1) <= 4e-15
        # The time from (x, v) to x = 0 is atan(v/x), and a quarter of a turn.
        np.testing.assert_allclose(gradient, [0.0, 1.0], rtol=0, atol=1e-6)


TIMED = dfc.FirstIntegral(lambda t, y, args: y - jnp.sin(t))


@pytest.mark.parametrize("t1", [3.0, -3.0])
def test_time_dependent_integral_in_either_direction(t1):
    """diffrax shows a solver negated times when it solves backwards."""
    ts = jnp.linspace(0, t1, 7)
    solver = dfc.ManifoldProjection(dfx.Euler(), TIMED)
    options = dict(t1=t1, dt0=0.1 * np.sign(t1), saveat=dfx.SaveAt(ts=ts))
    sol = solve(lambda t, y, args: jnp.cos(t), solver, jnp.array(1.0), **options)
    np.testing.assert_allclose(sol.ys, 1 + jnp.sin(ts), rtol=0, atol=1e-15)


def test_a_continued_solve_keeps_the_first_conserved_value_and_refuses_another():
    def run(y0, t0, t1, state=None):
        saveat = dfx.SaveAt(t1=True, solver_state=True)
        options = dict(t0=t0, t1=t1, solver_state=state, saveat=saveat, throw=False)
        return solve(oscillator, dfc.ManifoldProjection(dfx.Heun(), CIRCLE), y0, **options)

    first = run(jnp.array([1.0, 0.0]), 0.0, 1.0)
    pushed, struck = (run(first.ys[-1] + x, 1.0, 2.0, first.solver_state) for x in (1e-9, 1e-3))
    assert abs(float(jnp.sum(pushed.ys[-1] ** 2)) - 1) <= 4e-15
    assert "a step cannot start" in dfx.RESULTS[struck.result]


def grows(t, y, args):
    return y / (2 * (1 + t))


def growing(more=0.0):
    """`|y|² = args[0] (1 + t)`."""
    return dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - args[0] * (1 + t) - more)


GROWING = growing()


@pytest.mark.parametrize(
    ("changed", "fits"),
    [
        ({}, True),
        ({"law": growing()}, True),
        ({"law": growing(0.1)}, False),
        ({"args": 2.0}, False),
        ({"t0": 1.5}, False),
    ],
    ids=["nothing", "the same law", "another law", "args", "t0"],
)
def test_what_a_new_solve_refuses_is_refused_by_one_that_goes_on(changed, fits):
    """With the end of the first solve as its start, and one thing changed."""

    def run(y0, t0=1.0, args=1.0, law=GROWING, **options):  # beside a number in other units
        solver = dfc.ManifoldProjection(dfx.Heun(), law)
        options = dict(saveat=dfx.SaveAt(t1=True, solver_state=True), throw=False) | options
        return solve(grows, solver, y0, t0=t0, t1=t0 + 1, args=(jnp.array(args), 1e30), **options)

    first = run(jnp.array([1.0, 0.0]), t0=0.0)
    new, on = (run(first.ys[-1], **changed, solver_state=x) for x in (None, first.solver_state))
    assert on.result == new.result
    assert bool(new.result == dfx.RESULTS.successful) is fits
    np.testing.assert_allclose(on.ys, new.ys, rtol=1e-15)


def test_steps_may_become_much_shorter_where_the_terms_of_a_constraint_vanish():
    """A pendulum at its turning point: `q · v` is zero to roundoff of the speeds before."""
    rod = lambda t, y, args: (jnp.sum(y[0] ** 2) - 1, y[0] @ y[1])  # noqa: E731

    def swing(t, y, args):
        (q, v), down = y, jnp.array([0.0, 1.0])
        return v, -(v @ v - down @ q) * q - down

    @jax.jit
    def result(angle, step):
        q = jnp.stack([jnp.sin(angle), -jnp.cos(angle)])
        speed = 1e-3 * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        ts = jnp.cumsum(jnp.concatenate([jnp.zeros(1), step]))
        return dfx.diffeqsolve(
            dfx.ODETerm(swing), dfc.ManifoldProjection(dfc.RK4(), dfc.Constraint(rod)),
            ts[0], ts[-1], None, (q, speed), throw=False,
            stepsize_controller=dfx.StepTo(ts), saveat=dfx.SaveAt(t1=True),
        ).result  # fmt: skip

    for angle in (0.5, np.pi / 2):
        # To where the speed is about zero, and on in steps that are shorter by up to ten digits.
        step = jnp.concatenate([jnp.full(8, 1e-3 / np.sin(angle) / 8), 10.0 ** -jnp.arange(3, 14)])
        assert result(angle, step) == dfx.RESULTS.successful


def test_a_body_at_rest_may_have_a_speed_whose_gradient_is_nan_there():
    energy = lambda t, y, args: jnp.linalg.norm(y[1]) ** 2 / 2 + y[0] @ y[0] / 2  # noqa: E731
    solver = dfc.ManifoldProjection(dfx.Tsit5(), dfc.FirstIntegral(energy))
    y0 = jnp.array([[1.0, 0.0], [0.0, 0.0]])
    sol = solve(lambda t, y, args: jnp.stack([y[1], -y[0]]), solver, y0, t1=2.0, dt0=0.01)
    assert abs(float(energy(0, sol.ys[-1], None)) - 0.5) <= 4e-15


def test_a_projection_around_a_projection_is_refused():
    inner = dfc.ManifoldProjection(dfx.Heun(), CIRCLE)
    with pytest.raises(ValueError, match="one manifold"):
        dfc.ManifoldProjection(dfx.HalfSolver(inner), CIRCLE)


def test_a_step_begins_with_the_slope_at_the_projected_state():
    """Not at the candidate, whose last stage the solver has kept for its next step."""
    euclidean = dfc.SimplifiedNewton(metric=1.0)
    solver = dfc.ManifoldProjection(dfx.Tsit5(), CIRCLE, projection=euclidean)

    def end(y0, t0, t1):
        return solve(oscillator, solver, y0, t0=t0, t1=t1, dt0=1.0, max_steps=4).ys[-1]

    y0 = jnp.array([1.0, 0.0])
    np.testing.assert_allclose(end(y0, 0.0, 2.0), end(end(y0, 0.0, 1.0), 1.0, 2.0), 0, 4e-16)


def test_failure_with_adaptive_steps_is_retried_with_smaller_ones():
    """Two iterations are too few for a long step with the first-order method."""
    solver = dfc.ManifoldProjection(
        dfx.HalfSolver(dfx.Euler()), RIGID_BODY, projection=dfc.SimplifiedNewton(max_steps=2)
    )
    careless = dfx.PIDController(rtol=1e9, atol=1e9)  # accepts any error estimate
    options = dict(stepsize_controller=careless, saveat=dfx.SaveAt(t0=True, t1=True))
    sol = solve(rigid_body, solver, OMEGA0, t1=0.2, dt0=0.2, **options)
    assert sol.stats["num_rejected_steps"] > 0
    assert largest(drift_of(sol, RIGID_BODY)) <= 4e-15


@pytest.mark.slow
def test_transformations():
    """One inside the other: of a loop, of a batch, for less memory, compiled."""
    solver = dfc.ManifoldProjection(dfx.Euler(), CIRCLE)

    def end(y0):
        return dfx.diffeqsolve(dfx.ODETerm(oscillator), solver, 0.0, 0.3, 0.1, y0).ys[-1]

    def transformed(y0):
        batched = jax.vmap(jax.checkpoint(end))
        return jax.lax.scan(lambda y, _: (batched(y), None), y0[None], None, length=1)[0][0]

    y0 = jnp.array([1.0, 0.3])
    found = (jax.jit(lambda y, f=f: (f(y), jax.jacrev(f)(y)))(y0) for f in (end, transformed))
    assert difference(*found) < 1e-12


@pytest.mark.slow
def test_parts_that_are_none_or_integers_change_nothing():
    """diffrax makes integers floating-point; parts of a state that are `None` have no leaf."""

    def with_more(t, y, args):
        return {"speed": rigid_body(t, y["speed"], args), "index": 0, "controller": None}

    kept = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y["speed"] ** 2))
    alone = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))
    y0 = {"speed": OMEGA0, "index": 3, "controller": None}
    # By default the metric of a single array is that of its components.
    one = dfc.SimplifiedNewton(metric=1.0)
    solver = dfc.ManifoldProjection(dfx.Heun(), kept, projection=one)
    more = solve(with_more, solver, y0, t1=0.5).ys
    solver = dfc.ManifoldProjection(dfx.Heun(), alone, projection=one)
    ys = solve(rigid_body, solver, OMEGA0, t1=0.5).ys
    np.testing.assert_allclose(more["speed"], ys, rtol=0, atol=1e-12)
    assert more["controller"] is None
    assert jnp.all(more["index"] == 3)


def sum_of_saved(y0):
    solver = dfc.ManifoldProjection(dfx.Euler(), RIGID_BODY)
    saveat = dfx.SaveAt(ts=jnp.linspace(0, 0.3, 3))
    return jnp.sum(solve(rigid_body, solver, y0, t1=0.3, saveat=saveat).ys)


class OwnTerm(dfx.AbstractTerm):
    """A term of a user's class, as packages write them, that does what `part` does."""

    part: dfx.AbstractTerm

    def vf(self, t, y, args):
        return self.part.vf(t, y, args)

    def contr(self, t0, t1, **kwargs):
        return self.part.contr(t0, t1, **kwargs)

    def prod(self, vf, control):
        return self.part.prod(vf, control)


@pytest.mark.parametrize(
    ("solver", "keep_linear"),
    [
        (dfx.Tsit5(), True),
        (dfx.Kvaerno3(), False),
        pytest.param(dfx.Tsit5(), False, marks=pytest.mark.slow),
        pytest.param(dfx.Kvaerno3(), True, marks=pytest.mark.slow),
    ],
)
def test_a_term_of_ones_own_class_changes_nothing(solver, keep_linear):
    """The metric of motion, in which units do not matter and what never moves is not corrected,
    belongs to the equation and not to the class of the term. Here the mass is part of the state."""

    def field(t, y, args):
        q, v, mass = y
        return jnp.stack([v, -q / mass, 0.0 * mass])

    energy = dfc.FirstIntegral(lambda t, y, args: (y[2] * y[1] ** 2 + y[0] ** 2) / 2)
    kept = dfc.ManifoldProjection(solver, energy, keep_linear=keep_linear)
    y0, controller = jnp.array([1.0, 0.0, 2.0]), dfx.PIDController(rtol=1e-2, atol=1e-2)

    @eqx.filter_jit
    def end(term):
        return dfx.diffeqsolve(term, kept, 0, 9, 0.5, y0, stepsize_controller=controller).ys[-1]

    term = dfx.ODETerm(field)
    expected = end(term)
    np.testing.assert_array_equal(end(OwnTerm(term)), expected)
    np.testing.assert_allclose(expected[2], 2, rtol=1e-9)


def test_a_stochastic_term_of_ones_own_class_changes_nothing():
    """In the metric of motion, which depends on the path, it would converge to something else."""
    noise = dfx.VirtualBrownianTree(0, 1, 1e-2, (), jax.random.key(0))
    term = dfx.ControlTerm(lambda t, y, args: jnp.stack([100 * y[1], -y[0] / 100]), noise)
    circle = dfc.FirstIntegral(lambda t, y, args: y[0] ** 2 + (100 * y[1]) ** 2)
    kept = dfc.ManifoldProjection(dfx.Heun(), circle)
    start = jnp.array([1.0, 0.0])
    solved = eqx.filter_jit(lambda term: dfx.diffeqsolve(term, kept, 0, 1, 0.1, start).ys)
    np.testing.assert_array_equal(solved(term), solved(OwnTerm(term)))


@some_of("m, dtype", [(1, "float64"), (3, "float32"), (6, "float64"), (20, "float32")], period=2)
def test_strict_promotion_and_rank_promotion(m, dtype):
    """Alone and in a batch, for each way in which dense constraints are solved."""

    def squares(t, y, args):
        return jnp.sum(y**2)[None] * jnp.arange(1.0, m + 1, dtype=y.dtype)

    def end(omega):
        solver = dfc.ManifoldProjection(dfx.Heun(), dfc.FirstIntegral(squares))
        return jnp.sum(solve(oscillator, solver, jnp.stack([omega, omega])).ys)

    def total(omega):
        return end(omega[0]) + jnp.sum(jax.vmap(end)(omega))

    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        assert jax.eval_shape(jax.grad(sum_of_saved), OMEGA0).shape == OMEGA0.shape
        assert jax.eval_shape(jax.grad(total), jnp.ones(2, dtype)).shape == (2,)


@pytest.mark.parametrize("jit", [lambda fn: fn, jax.jit])
def test_nan_debugging(jit):
    """Without `jit` JAX looks at every array of the forward pass."""
    with jax.debug_nans(True):
        assert bool(jnp.all(jnp.isfinite(jit(jax.grad(sum_of_saved))(OMEGA0))))


def test_nothing_is_compiled_twice():
    field, energy = Counted(oscillator), Counted(lambda t, y, args: jnp.sum(y**2))
    solver = dfc.ManifoldProjection(dfx.Heun(), dfc.FirstIntegral(energy))

    def run(y0):
        sol = solve(field, solver, y0, saveat=dfx.SaveAt(dense=True))
        return sol.evaluate(0.123)

    run(jnp.array([1.0, 0.0]))
    traced = energy.calls
    assert traced > 0
    assert field.calls <= 3  # diffrax traces each step three times, this one only once
    run(jnp.array([0.3, 0.4]))
    assert energy.calls == traced
