"""A failed projection says so: which constraint, how far off, and what to do."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc

from .. import fresh
from ..problems import solve

Y0 = jnp.array([1.0, 0.0])


def rotation(t, y, args):
    return jnp.stack([y[1], -y[0]])


def square(t, y, args):
    return jnp.sum(y**2)


def run(manifold, solver=None, y0=Y0, vector_field=rotation, **kwargs):
    options = {k: kwargs.pop(k) for k in ("projection", "max_correction") if k in kwargs}
    wrapped = dfc.ManifoldProjection(solver or dfc.RK4(), manifold, **options)
    return solve(vector_field, wrapped, y0, **kwargs)


def out_of_reach(t, y, args):
    """The square, which after t = 0.5 must be negative to be as before."""
    return jnp.sum(y**2) + jnp.where(t > 0.5, 2.0, 0.0)


OUT_OF_REACH = {"square": dfc.FirstIntegral(square), "jump": dfc.FirstIntegral(out_of_reach)}


@pytest.mark.parametrize("solver", [dfc.RK4(), pytest.param(dfx.Tsit5(), marks=pytest.mark.slow)])
def test_the_error_of_fixed_steps_names_the_constraint_and_a_remedy(solver, errors_raise):
    with pytest.raises(eqx.EquinoxRuntimeError, match="entry 0 of the manifold") as e:
        run(OUT_OF_REACH, solver)
    assert dfc.entry_name(OUT_OF_REACH, 0) == "manifold['jump']"
    assert "smaller steps" in str(e.value)


def test_the_result_holds_the_message_if_nothing_is_raised():
    sol = run(OUT_OF_REACH, throw=False)
    assert sol.result != dfx.RESULTS.successful
    assert "entry 0 of the manifold" in dfx.RESULTS[sol.result]


def test_each_lane_of_a_batch_has_its_own_result():
    def lane(jump):
        def fn(t, y, args):
            return jnp.sum(y**2) + jnp.where(t > 0.5, args, 0.0)

        return run(dfc.FirstIntegral(fn), args=jump, throw=False).result

    results = jax.jit(jax.vmap(lane))(jnp.array([0.0, 2.0, jnp.nan]))
    first, second, third = (
        eqx.tree_at(lambda r: r._value, results, results._value[i]) for i in range(3)
    )
    assert first == dfx.RESULTS.successful
    assert "still not satisfied" in dfx.RESULTS[second]
    assert "not finite" in dfx.RESULTS[third]


def test_a_state_that_is_not_finite_is_called_that(errors_raise):
    with pytest.raises(eqx.EquinoxRuntimeError, match="`manifold` is not finite"):
        run(
            dfc.FirstIntegral(square),
            vector_field=lambda t, y, args: jnp.sqrt(0.5 - t) * rotation(t, y, args),
        )


def test_an_inaccurate_function_is_told_about_the_tolerance(errors_raise):
    def noisy(t, y, args):
        return jnp.sum(y**2) + jax.lax.stop_gradient(1e-12 * jnp.sin(1e15 * y[0]))

    with pytest.raises(eqx.EquinoxRuntimeError, match=r"SimplifiedNewton\(rtol="):
        run(dfc.FirstIntegral(noisy), y0=jnp.array([1.0, 0.5]))
    sol = run(
        dfc.FirstIntegral(noisy),
        y0=jnp.array([1.0, 0.5]),
        projection=dfc.SimplifiedNewton(rtol=1e-10),
    )
    assert sol.result == dfx.RESULTS.successful


def test_contradicting_constraints_name_one_of_them(errors_raise):
    manifold = (
        dfc.FirstIntegral(square, value=1.0),
        dfc.FirstIntegral(square, value=1.1),
    )
    with pytest.raises(eqx.EquinoxRuntimeError, match="value` of entry 0 of the manifold"):
        run(manifold)


@pytest.mark.slow
def test_many_entries_are_not_named_one_by_one(errors_raise):
    manifold = [
        dfc.FirstIntegral(lambda t, y, args, k=k: out_of_reach(t, y[k], args)) for k in range(18)
    ]
    y0 = jnp.ones((18, 2))
    with pytest.raises(eqx.EquinoxRuntimeError, match="the manifold"):
        run(manifold, y0=y0, vector_field=lambda t, y, args: y[:, ::-1] * jnp.array([1.0, -1.0]))


def test_the_list_of_messages_is_the_same_whatever_was_solved():
    run(OUT_OF_REACH, throw=False)
    assert fresh.interpreter()["messages"] == len(dfx.RESULTS._index_to_message)


def test_diffrax_has_the_list_that_messages_are_added_to():
    assert isinstance(getattr(dfx.RESULTS, "_index_to_message", None), list), (
        "diffrax has no list `RESULTS._index_to_message` any more: find out how this version "
        "keeps its messages, and change `_solver/diffrax_private.py`."
    )


# ---- The start ----


@pytest.mark.parametrize(
    ("manifold", "message"),
    [
        (dfc.FirstIntegral(square, value=-1.0), "value` of `manifold` cannot be reached"),
        (
            dfc.FirstIntegral(lambda t, y, args: square(t, y, args) * jnp.nan),
            "not finite at the in",
        ),
        (dfc.Constraint(lambda t, y, args: square(t, y, args) - 1.001), "initial state violates"),
        # At rest neither changes yet.
        (dfc.FirstIntegral(lambda t, y, args: y[0] ** 2), "`manifold` is not a first integral"),
        (dfc.FirstIntegral(lambda t, y, args: y[0]), "`manifold` is not a first integral"),
        (dfc.FirstIntegral(lambda t, y, args: square(t, y, args) + t), "is not a first integral"),
    ],
)
def test_what_cannot_start_ends_at_once(manifold, message):
    adaptive = dfx.PIDController(rtol=1e-6, atol=1e-6)
    sol = run(manifold, dfx.Tsit5(), stepsize_controller=adaptive, max_steps=None, throw=False)
    assert message in dfx.RESULTS[sol.result]
    assert sol.stats["num_steps"] == 1


def test_what_a_vector_field_does_not_conserve_is_kept_on_demand():
    sol = run(dfc.FirstIntegral(lambda t, y, args: y[1]), max_correction=jnp.inf)
    assert np.all(sol.ys[:, 1] == 0)


@pytest.mark.parametrize(
    "source",
    [
        pytest.param(lambda q, p: -0.1 * p, marks=pytest.mark.slow),
        lambda q, p: -(p**3),
        pytest.param(lambda q, p: (1 - q**2) * p, marks=pytest.mark.slow),
        pytest.param(lambda q, p: q - jnp.sin(q), marks=pytest.mark.slow),
    ],
    ids=["friction", "cubic-friction", "van-der-pol", "pendulum"],
)
def test_an_energy_with_a_source_is_found_from_rest(source):
    """Where the first derivatives of the energy vanish."""

    def vector_field(t, y, args):
        return rotation(t, y, args) + jnp.array([0.0, source(*y)])

    sol = run(dfc.FirstIntegral(square), vector_field=vector_field, throw=False)
    assert "is not a first integral" in dfx.RESULTS[sol.result]


def cancelling(t, y, args):
    """Two bodies in one dimension, whose forces cancel up to roundoff, and what they add up to."""
    q, p = y[:2], y[2:4]
    force = jnp.sin(3 * (q[0] - q[1])) * jnp.array([1.0, 0.1 + 0.2])
    return jnp.array([p[0], p[1], force[0], -force[1], force[1] - 0.3 * force[0]])


def attracted(t, y, args):
    """A rotation about the third axis, with an attraction to the unit sphere."""
    return jnp.cross(jnp.array([0.0, 0.0, 1.0]), y) - args * (jnp.sum(y**2) - 1) * y


@pytest.mark.parametrize(
    ("vector_field", "y0", "args", "component"),
    [
        (cancelling, [0.3, -0.4, 0.1, 0.2, 0.5], None, 4),
        (attracted, [0.6, 0.0, 0.8], 1e-12, 2),
        pytest.param(attracted, [0.6, 0.0, 0.8], 10.0, 2, marks=pytest.mark.slow),
    ],
    ids=["forces-cancel", "weak", "strong"],
)
def test_a_derivative_that_is_roundoff_or_vanishes_on_a_level_set_may_start(
    vector_field, y0, args, component
):
    kept = dfc.FirstIntegral(lambda t, y, args: y[component])
    sol = run(kept, y0=jnp.array(y0), vector_field=vector_field, args=args, throw=False)
    assert sol.result == dfx.RESULTS.successful


TIMES = {"t0": 2.0, "t1": 1.0, "dt0": -0.1}


@pytest.mark.parametrize(
    ("fn", "rate", "options"),
    [
        pytest.param(square, None, TIMES, marks=pytest.mark.slow),
        (lambda t, y, args: square(t, y, args) + t**2, lambda t, y, args: 2 * t, TIMES),
        pytest.param(
            lambda t, y, args: y[0] * jnp.cos(t) - y[1] * jnp.sin(t),
            None,
            {},
            marks=pytest.mark.slow,
        ),
        (lambda t, y, args: y[0] * jnp.cos(t) - y[1] * jnp.sin(t), None, TIMES),
    ],
    ids=["backwards", "balance-backwards", "in-time", "in-time-backwards"],
)
def test_what_changes_with_time_and_is_conserved_may_start(fn, rate, options):
    sol = run(dfc.FirstIntegral(fn, rate=rate), throw=False, **options)
    assert sol.result == dfx.RESULTS.successful


def test_one_lane_that_cannot_start_leaves_the_others_alone():
    unit = dfc.Constraint(lambda t, y, args: square(t, y, args) - 1)
    y0 = jnp.array([[1.0, 0.0], [1.001, 0.0], [0.0, 1.0]])
    batch = jax.jit(jax.vmap(lambda y0: run(unit, y0=y0, throw=False)))(y0)
    np.testing.assert_array_equal(dfx.is_okay(batch.result), [True, False, True])
    for i in (0, 2):
        np.testing.assert_allclose(batch.ys[i], run(unit, y0=y0[i]).ys, rtol=1e-14)


def spoilt(t, y, args):
    return square(t, y, args) * jnp.where(t > 0.5, args, 1.0) + jnp.where(t > 0.5, 9.0, 0.0)


@pytest.mark.parametrize("after", [jnp.nan, 5.0])
def test_an_adaptive_solve_without_hope_ends(after):
    adaptive = dfx.PIDController(rtol=1e-6, atol=1e-6)
    options = dict(stepsize_controller=adaptive, max_steps=None, throw=False)
    sol = run(dfc.FirstIntegral(spoilt), dfx.Tsit5(), args=jnp.asarray(after), **options)
    assert "`manifold`" in dfx.RESULTS[sol.result]
    plain = run(dfc.FirstIntegral(square), dfx.Tsit5(), **options)
    assert sol.stats["num_steps"] <= plain.stats["num_steps"] + 40


@pytest.mark.parametrize(("late", "dtype"), [(1e13, jnp.float64), (2e4, jnp.float32)])
def test_an_adaptive_solve_without_hope_ends_at_late_times(late, dtype):
    """There even the shortest step of time moves the state by much."""
    jump = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - jnp.where(t > late, -1, 1))
    start, end = (jnp.asarray(late + x, dtype) for x in (-20, 20))
    sol = dfx.diffeqsolve(
        dfx.ODETerm(lambda t, y, args: rotation(t, y, args) * jnp.asarray(0.3, dtype)),
        dfc.ManifoldProjection(dfx.Tsit5(), jump),
        start,
        end,
        None,
        Y0.astype(dtype),
        stepsize_controller=dfx.PIDController(rtol=1e-4, atol=1e-4),
        max_steps=None,
        throw=False,
    )
    assert "`manifold`" in dfx.RESULTS[sol.result]
    assert sol.stats["num_steps"] <= 60


# ---- max_correction ----


def double_well(t, y, args):
    q, p = y
    return jnp.stack([p, q - q**3])


WELL = dfc.FirstIntegral(lambda t, y, args: y[1] ** 2 / 2 + y[0] ** 4 / 4 - y[0] ** 2 / 2)
RIGHT = jnp.array([1.38, 0.0])  # the energy is negative: the two wells are not connected


@eqx.filter_jit
def in_the_well(solver, controller, max_correction):
    """The solve, and whether all of it is in the right well."""
    sol = run(
        WELL,
        solver,
        RIGHT,
        double_well,
        projection=dfc.Newton(),
        max_correction=max_correction,
        t1=42.0,
        dt0=1.4,
        throw=False,
        saveat=dfx.SaveAt(steps=True),
        max_steps=300,
        stepsize_controller=controller,
    )
    return sol, jnp.all(jnp.where(jnp.isfinite(sol.ts), sol.ys[:, 0], 1) > 0)


def test_max_correction_guards_against_another_component():
    fixed = dfx.ConstantStepSize()
    sol, right = in_the_well(dfx.Euler(), fixed, jnp.array(1e9))
    assert sol.result == dfx.RESULTS.successful
    assert not right  # what it is for
    sol, right = in_the_well(dfx.Euler(), fixed, jnp.array(0.3))
    assert right
    assert "max_correction" in dfx.RESULTS[sol.result]


def test_max_correction_makes_an_adaptive_solve_take_smaller_steps():
    careless = dfx.PIDController(rtol=1e3, atol=1e3, factormax=1.2)
    sol, right = in_the_well(dfx.Heun(), careless, jnp.array(1e9))
    assert sol.result == dfx.RESULTS.successful
    assert not right
    sol, right = in_the_well(dfx.Heun(), careless, jnp.array(0.1))
    assert sol.result == dfx.RESULTS.successful
    assert right
    assert sol.stats["num_rejected_steps"] > 0


def test_max_correction_lets_roundoff_pass():
    """At an equilibrium the step has length zero, but the correction need not."""
    sol = run(
        WELL,
        y0=jnp.array([1.0, 0.0]) + 1e-12,
        vector_field=double_well,
        max_correction=0.1,
        t1=10.0,
    )
    assert sol.result == dfx.RESULTS.successful


def test_max_correction_ends_what_is_not_conserved():
    """The position of a pendulum, kept at its first value."""
    adaptive = dfx.PIDController(rtol=1e-6, atol=1e-6)
    sol = run(
        dfc.FirstIntegral(lambda t, y, args: y[0] ** 2),
        dfx.Tsit5(),
        vector_field=lambda t, y, args: jnp.stack([y[1], -jnp.sin(y[0])]),
        t1=10.0,
        max_correction=0.5,
        stepsize_controller=adaptive,
        throw=False,
    )
    assert "max_correction" in dfx.RESULTS[sol.result]


def test_no_limit_is_no_limit_at_an_equilibrium():
    for limit in (None, float("inf")):
        sol = run(WELL, y0=jnp.array([1.0, 0.0]), vector_field=double_well, max_correction=limit)
        assert sol.result == dfx.RESULTS.successful


@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan")])
@pytest.mark.parametrize("option", ["max_correction", "threshold"])
def test_wrong_options_are_refused(option, bad):
    with pytest.raises(ValueError, match=option):
        dfc.ManifoldProjection(dfc.RK4(), WELL, **{option: bad})


@pytest.mark.parametrize("bad", [0, -1])
def test_wrong_every_is_refused(bad):
    with pytest.raises(ValueError, match="every"):
        dfc.ManifoldProjection(dfc.RK4(), WELL, every=bad)
