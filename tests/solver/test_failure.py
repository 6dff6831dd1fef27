"""A failed projection says so: why, which entry, and what to do."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc

from ..problems import oscillator, printed, solve
from ..thinned import some_of

Y0, NAN, LARGE = jnp.array([1.0, 0.0]), jnp.array([1.0, jnp.nan]), jnp.array([2e19, 0], "f4")


def square(t, y, args):
    return jnp.sum(y**2)


def run(manifold, solver=None, y0=Y0, vector_field=oscillator, **kwargs):
    options = {k: kwargs.pop(k) for k in ("projection", "max_correction") if k in kwargs}
    wrapped = dfc.ManifoldProjection(solver or dfc.RK4(), manifold, **options)
    return solve(vector_field, wrapped, y0, **kwargs)


def out_of_reach(t, y, args):
    """The square, which after t = 0.5 must be negative to be as before."""
    return jnp.sum(y**2) + jnp.where(t > 0.5, 2.0, 0.0)


OUT_OF_REACH = {"square": dfc.FirstIntegral(square), "jump": dfc.FirstIntegral(out_of_reach)}
NOT_FINITE, TOO_FAR, NOT_REACHED = "is not finite, or", "`max_correction`", "was not reached"
CANNOT_START, NO_STATE = "a step cannot start", "may contradict itself"
HOPELESS = 150  # attempts after which an adaptive solve ends


def test_the_error_of_fixed_steps_leads_to_the_entry_and_a_remedy(errors_raise):
    with pytest.raises(eqx.EquinoxRuntimeError, match=NOT_REACHED) as e:
        run(OUT_OF_REACH)
    assert "Take smaller steps" in str(e.value)
    assert NO_STATE not in str(e.value)
    assert "print(diffrax_conserve.statistics(sol))" in str(e.value)


def test_statistics_name_the_entry_that_failed():
    """The entry before it holds two integrals."""
    kept = dfc.FirstIntegral(lambda t, y, args: y[:2])
    jump = dfc.FirstIntegral(lambda t, y, args: out_of_reach(t, y[2:], args))
    field = lambda t, y, args: jnp.concatenate([jnp.zeros(2), oscillator(t, y[2:], args)])  # noqa: E731
    y0, saveat = jnp.array([0.5, 0.25, 1.0, 0.0]), dfx.SaveAt(t1=True, solver_state=True)
    sol = run({"kept": kept, "last": jump}, None, y0, field, throw=False, saveat=saveat)
    assert NOT_REACHED in dfx.RESULTS[sol.result]
    assert np.all(np.isnan(sol.ys[-1]))
    assert "worst manifold['last']" in printed(dfc.statistics(sol))


def spoilt(t, y, args):
    """The square, but not after the time `args[1]`."""
    after, when = args
    return square(t, y, args) * jnp.where(t > when, after, 1.0) + jnp.where(t > when, 9.0, 0.0)


SPOILT = dfc.FirstIntegral(spoilt)


def adaptive(manifold, *args, max_steps=4096):
    options = dict(stepsize_controller=dfx.PIDController(1e-6, 1e-6), max_steps=max_steps)
    return run(manifold, dfx.Tsit5(), args=jnp.array(args), throw=False, **options)


@pytest.mark.parametrize(
    ("manifold", "args", "message"),
    [
        (dfc.Constraint(lambda t, y, args: square(t, y, args) - 1.001), (), CANNOT_START),
        (SPOILT, (jnp.nan, -1.0), NOT_FINITE),
        (dfc.FirstIntegral(square, value=-1.0), (), NO_STATE),
    ],
    ids=["violated", "not-finite", "out-of-reach"],
)
def test_what_cannot_start_ends_at_once(manifold, args, message):
    sol = adaptive(manifold, *args, max_steps=4096 if args else None)
    assert message in dfx.RESULTS[sol.result]
    # Where the solve can start, smaller steps are tried.
    assert sol.stats["num_steps"] <= (HOPELESS if message == NO_STATE else 1)


def later(t, args, before, after):
    return jnp.where(t > args[1], after, before)


WITHOUT_HOPE = {
    "nan": (SPOILT, jnp.nan),
    "jump": (SPOILT, 5.0),
    "nan of the gradient": (
        dfc.FirstIntegral(
            lambda t, y, a: square(t, y, a) + 0 * later(t, a, 1, -1 + 0 * y[0]) ** 0.5
        ),
        1.0,
    ),
    "jump of a constant": (dfc.FirstIntegral(lambda t, y, a: later(t, a, 0, 1) + 0 * y[0]), 1.0),
    "jump of a constraint": (dfc.Constraint(lambda t, y, a: later(t, a, 0, 1) + 0 * y[0]), 1.0),
    "what runs away": (
        dfc.FirstIntegral(lambda t, y, a: square(t, y, a) + 10 * later(t, a, 0, t - a[1])),
        1.0,
    ),
    "two that contradict": ((SPOILT, dfc.FirstIntegral(square)), 5.0),
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(x, marks=() if x in ("nan", "jump") else pytest.mark.slow) for x in WITHOUT_HOPE],
)
def test_an_adaptive_solve_without_hope_ends(name):
    """A state that runs away first shrinks to the origin in many steps that succeed."""
    manifold, after = WITHOUT_HOPE[name]
    sol, plain = adaptive(manifold, after, 0.5), adaptive(manifold, after, 9.0)
    assert (NOT_FINITE if "nan" in name else NOT_REACHED) in dfx.RESULTS[sol.result]
    assert dfx.is_okay(plain.result)
    kind = "num_rejected_steps" if "runs away" in name else "num_steps"
    assert sol.stats[kind] <= plain.stats[kind] + HOPELESS


def from_value(value, y0=Y0, lower=-9.0):
    """By one program for all."""
    projection = dfc.SimplifiedNewton(lower=jnp.asarray(lower, y0.dtype))
    integral = dfc.FirstIntegral(square, value=jnp.asarray(value, y0.dtype))
    options = dict(projection=projection, saveat=dfx.SaveAt(steps=True), max_steps=16, throw=False)
    return run(integral, y0=y0, **options)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: from_value(1.0, NAN), NOT_FINITE),
        (lambda: run(dfc.Constraint(square), y0=NAN, throw=False), NOT_FINITE),
        (lambda: run(dfc.FirstIntegral(square), y0=LARGE, throw=False), NOT_FINITE),
        (lambda: from_value(-1.0), NO_STATE),
        (lambda: from_value(1.0, lower=1.5), NO_STATE),
    ],
    ids=["nan", "nan of a constraint", "overflow", "out of reach", "bound above the start"],
)
def test_the_first_of_fixed_steps_tells_what_is_wrong_with_the_start(make, message):
    told = dfx.RESULTS[make().result]
    assert message in told
    assert "`project" not in told


def test_a_first_projection_may_be_as_long_as_a_given_value_needs():
    squares = np.sum(np.asarray(from_value(4.0).ys)[:10] ** 2, axis=1)
    np.testing.assert_allclose(squares, 4.0, rtol=1e-14)


@pytest.mark.slow
def test_what_a_vector_field_does_not_conserve_is_kept_and_the_statistics_tell():
    """Whether a quantity is conserved is the question of `check_invariance`, not of the solve."""
    options = dict(stepsize_controller=dfx.PIDController(1e-6, 1e-6), t1=3.0)
    options["saveat"] = dfx.SaveAt(t1=True, solver_state=True)
    for wrong in (lambda t, y, args: y[1], lambda t, y, args: y[1] ** 2 + 1.1 * y[0] ** 2):
        sol = run(dfc.FirstIntegral(wrong), dfx.Tsit5(), **options)
        assert abs(wrong(0, sol.ys[-1], None) - wrong(0, Y0, None)) < 1e-15
        assert "check_invariance" in str(dfc.statistics(sol))
    sol = run(dfc.FirstIntegral(square), dfx.Tsit5(), **options)
    assert "check_invariance" not in str(dfc.statistics(sol))


def test_what_failed_is_nan_and_takes_no_iterations():
    """In a batch a lane that ended is evaluated until the last one ends."""
    sol = run(dfc.FirstIntegral(lambda t, y, args: y[1]), max_correction=0.5, throw=False)
    assert TOO_FAR in dfx.RESULTS[sol.result]
    assert np.all(np.isnan(sol.ys[-1]))
    unit = dfc.FirstIntegral(square, value=1.0)
    candidates = jnp.array([[jnp.nan, 1.0], [jnp.inf, 1.0], [1.0, jnp.nan]])
    for kind in (dfc.SimplifiedNewton(), dfc.Newton()):
        _, info = jax.vmap(lambda y, kind=kind: dfc.project(unit, y, projection=kind))(candidates)
        assert not np.any(info.ok)
        assert np.all(info.num_steps <= 3), info


@some_of(
    "late, dtype", [(1e13, jnp.float64), (2e4, jnp.float32)], ids=["float64", "float32"], period=2
)
def test_an_adaptive_solve_without_hope_ends_at_late_times(late, dtype):
    """There even the shortest step of time moves the state by much."""
    jump = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - jnp.where(t > late, -1, 1))
    slow, span = lambda *args: 0.3 * oscillator(*args), dict(t0=late - 20, t1=late + 20, dt0=None)
    options = span | dict(stepsize_controller=dfx.PIDController(1e-4, 1e-4), max_steps=4096)
    sol = run(jump, dfx.Tsit5(), Y0.astype(dtype), slow, throw=False, **options)
    assert NOT_REACHED in dfx.RESULTS[sol.result]
    assert sol.stats["num_steps"] <= HOPELESS


double_well = lambda t, y, args: jnp.stack([y[1], y[0] - y[0] ** 3])  # noqa: E731
WELL = dfc.FirstIntegral(lambda t, y, args: y[1] ** 2 / 2 + y[0] ** 4 / 4 - y[0] ** 2 / 2)
RIGHT = jnp.array([1.38, 0.0])  # the energy is negative: the two wells are not connected
FIXED = dfx.Euler(), dfx.ConstantStepSize(), 0.3
ADAPTIVE = dfx.Heun(), dfx.PIDController(rtol=1e3, atol=1e3, factormax=1.2), 0.1


@eqx.filter_jit
def in_the_well(solver, controller, max_correction):
    """The solve, and whether nothing of it is in the left well."""
    given = dict(projection=dfc.Newton(), max_correction=max_correction)
    options = dict(saveat=dfx.SaveAt(steps=True), max_steps=300, stepsize_controller=controller)
    options |= given | dict(vector_field=double_well, t1=42.0, dt0=1.4, throw=False)
    sol = run(WELL, solver, RIGHT, **options)
    return sol, ~jnp.any(sol.ys[:, 0] < 0)


@pytest.mark.parametrize(
    ("solver", "controller", "limit"), [FIXED, pytest.param(*ADAPTIVE, marks=pytest.mark.slow)]
)
def test_max_correction_guards_against_another_component(solver, controller, limit):
    """Fixed steps fail, adaptive ones become smaller."""
    sol, right = in_the_well(solver, controller, jnp.array(1e9))
    assert sol.result == dfx.RESULTS.successful
    assert not right  # what it is for
    sol, right = in_the_well(solver, controller, jnp.array(limit))
    assert right
    if limit == 0.3:
        assert TOO_FAR in dfx.RESULTS[sol.result]
    else:
        assert sol.result == dfx.RESULTS.successful
        assert sol.stats["num_rejected_steps"] > 0


@pytest.mark.slow
def test_a_state_within_a_loose_tolerance_goes_on_after_a_declared_jump():
    controller = dfx.ClipStepSizeController(dfx.PIDController(1e-3, 1e-3), jump_ts=jnp.array([1.0]))
    energy = dfc.FirstIntegral(lambda t, y, args: y[1] ** 2 / 2 - jnp.cos(y[0]))
    projection = dfc.SimplifiedNewton(rtol=1e-3)
    sol = dfx.diffeqsolve(
        dfx.ODETerm(lambda t, y, args: jnp.array([y[1], -jnp.sin(y[0])])),
        dfc.ManifoldProjection(dfx.Bosh3(), energy, projection=projection),
        0.0, 10.0, 0.1, jnp.array([2.0, 0.0]), stepsize_controller=controller, throw=False,
    )  # fmt: skip
    assert sol.result == dfx.RESULTS.successful


def test_a_constraint_that_jumps_is_told_at_a_declared_jump():
    """The rod becomes longer at t = 1/2: there a solve must end, be projected, and go on."""

    @eqx.filter_jit
    def result(longer):
        rod = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - jnp.where(t > 0.5, longer, 1.0))
        controller = dfx.PIDController(rtol=1e-6, atol=1e-6)
        controller = dfx.ClipStepSizeController(controller, jump_ts=jnp.array([0.5]))
        return run(rod, dfx.Tsit5(), stepsize_controller=controller, throw=False).result

    told = dfx.RESULTS[result(1.2)]
    assert CANNOT_START in told
    assert "`project`, and go on" in told
    assert result(1.0) == dfx.RESULTS.successful


@pytest.mark.parametrize("factor", [1.0, 1.1])
def test_statistics_tell_a_law_that_is_not_conserved_from_roundoff(factor):
    """In float32, where the error estimates of short steps are below the roundoff that is
    corrected."""
    law = dfc.FirstIntegral(lambda t, y, args: y[0] ** 2 + factor * y[1] ** 2)
    found = dfx.diffeqsolve(
        dfx.ODETerm(oscillator), dfc.ManifoldProjection(dfx.Tsit5(), law),
        *np.float32([0.0, 5.0, 0.02]), np.float32([1.0, 0.0]),
        saveat=dfx.SaveAt(t1=True, solver_state=True), max_steps=300,
    )  # fmt: skip
    statistics = dfc.statistics(found)
    assert statistics.correction > 10 * statistics.error
    assert ("check by `check_invariance`" in str(statistics)) == (factor != 1)
