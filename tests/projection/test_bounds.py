"""The nearest point of a manifold within bounds."""

import itertools as it

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

from ..problems import EPS
from ..problems import solve as one_solve
from ..thinned import some_of

KINDS = {"simplified": dfc.SimplifiedNewton, "newton": dfc.Newton}
BOTH = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
ONE_OF_BOTH = some_of("kind", KINDS.values(), ids=KINDS, period=2)
BALANCES = dfc.FirstIntegral(lambda t, y, args: args @ y)


def chemistry(rng, count, species=8, balances=3):
    """Balances of atoms with feasible values, and candidates of which many are negative.

    As in Robertson's problem the amounts differ by orders of magnitude.
    """
    atoms = rng.integers(0, 4, size=(count, balances, species)).astype(float)
    atoms[:, np.arange(balances), np.arange(balances)] += 1
    sizes = 10 ** rng.uniform(-6, 0, size=(count, species))
    amounts = sizes * rng.uniform(0, 1, size=sizes.shape)
    amounts[rng.random(sizes.shape) < 0.2] = 0
    noise = np.where(rng.random(sizes.shape) < 0.5, sizes, 0.1)
    candidates = amounts + noise * rng.normal(size=sizes.shape)
    return tuple(map(jnp.asarray, (atoms, np.einsum("ijk,ik->ij", atoms, amounts), candidates)))


@eqx.filter_jit
def project(kind, atoms, values, candidates, metric):
    def one(atoms, value, candidate):
        projection = kind(lower=0.0, metric=metric)
        y, info = dfc.project(BALANCES, candidate, args=atoms, value=value, projection=projection)
        return y, info.ok, info.num_steps

    return jax.vmap(one)(atoms, values, candidates)


def quadratic_program(atoms, value, candidate, metric):
    """By another method: SLSQP, whose first step solves one exactly if the Hessian is one."""
    root, start = np.sqrt(metric), np.sqrt(metric) * candidate
    equal = dict(fun=lambda u: atoms @ (u / root) - value, jac=lambda u: atoms / root, type="eq")
    found = scipy.optimize.minimize(
        lambda u: np.sum((u - start) ** 2) / 2, np.maximum(start, 0), jac=lambda u: u - start,
        bounds=[(0, None)] * candidate.size, constraints=equal, method="SLSQP",
        options=dict(ftol=1e-18, maxiter=200),
    )  # fmt: skip
    return found.x / root


MANY = 2_000  # one number of candidates for several tests, so that they share what is compiled


def test_it_solves_the_quadratic_program():
    rng = np.random.default_rng(1)
    count = 30
    atoms, values, candidates = chemistry(rng, count)
    metric = 10 ** rng.uniform(-1, 1, size=8)
    repeated = (jnp.resize(x, (MANY, *x.shape[1:])) for x in (atoms, values, candidates))
    y, ok, _ = project(dfc.Newton, *repeated, jnp.asarray(metric))
    assert jnp.all(ok)
    for a, v, c, got in zip(*map(np.asarray, (atoms, values, candidates, y[:count])), strict=True):
        expected = quadratic_program(a, v, c, metric)
        # Not nearer by more than what SLSQP errs.
        near, best = (np.sum(metric * (x - c) ** 2) for x in (got, expected))
        assert near <= best * (1 + 1e-9) + 1e-12
        if np.max(np.abs(a @ expected - v)) < 1e-12 and np.min(expected) > -1e-12:
            np.testing.assert_allclose(got, expected, rtol=0, atol=1e-8)


@BOTH
def test_no_amount_is_negative_and_every_balance_holds(kind):
    atoms, values, candidates = chemistry(np.random.default_rng(2), MANY)
    y, ok, _ = project(kind, atoms, values, candidates, jnp.ones(8))
    # Few of these, whose bounds and balances nearly contradict each other, or leave nothing of an
    # element, may fail, and say so.
    assert jnp.mean(ok) >= 0.999
    assert jnp.min(y) >= 0
    amounts = jnp.einsum("ijk,ik->ij", atoms, y)
    residual = jnp.abs(amounts - values) / jnp.maximum(amounts + values, 1e-300)
    assert jnp.max(residual[ok]) <= 17 * EPS
    assert jnp.quantile(residual, 0.9) <= 4 * EPS


@pytest.mark.slow
@ONE_OF_BOTH
def test_derivatives_are_those_of_differences(kind):
    """With a component at each bound, in a metric, and through both."""
    projection = kind(lower=(0.0, jnp.array([0.0, -9.0])), upper=(1.0, jnp.array([9.0, 0.25])))
    manifold = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y[0] ** 2) + y[1][0] + args * y[1][1])

    def fn(x):
        candidate, options = (x[:2], x[2:4]), dict(args=x[4], value=x[5], projection=projection)
        return jnp.concatenate(dfc.project(manifold, candidate, **options)[0])

    x = jnp.array([-0.3, 0.6, 0.5, 0.4, 1.5, 1.4])
    y = jax.jit(fn)(x)
    assert (y[0], y[3]) == (0, 0.25)
    dct.assert_gradients(fn, x, rtol=1e-7)


METRICS = {
    "none": None,
    "weights": jnp.array([1.0, 4.0, 0.5, 2.0]),
    "matrix": jnp.array(
        [[2, 0.6, 0.3, 0.3], [0.6, 1, 0, 0.2], [0.3, 0, 1, 0.3], [0.3, 0.2, 0.3, 2]]
    ),
}


@some_of(
    "kind, metric",
    it.product(KINDS.values(), METRICS.values()),
    ids=map("-".join, it.product(KINDS, METRICS)),
    period=3,
)
def test_first_and_second_derivatives_are_those_of_differences(kind, metric):
    """A component beyond its bound depends on the multipliers, and its derivative does not."""
    projection = kind(lower=0.0, metric=metric)
    manifold = dfc.FirstIntegral(lambda t, y, args: jnp.stack([jnp.sum(y), jnp.sum(y**2)]))

    def both(candidate, value):
        fn = lambda *x: dfc.project(manifold, x[0], value=x[1], projection=projection)[0]  # noqa: E731
        y, vjp = jax.vjp(fn, candidate, value)
        return y, vjp(jnp.array([1.0, 2.0, -1.0, 0.5]))

    given = jnp.array([0.51, 0.249, 0.252, -0.01]), jnp.array([1.0, 0.375])
    assert jax.jit(both)(*given)[0][3] == 0
    dct.assert_gradients(both, *given, rtol=1e-7)


def enzyme(t, y, rates):
    """A substrate is bound by an enzyme and used up; the product decays slowly."""
    s, e, c, p, _ = y
    binds, leaves, reacts, decays = rates * jnp.array([s * e, c, c, p])
    slopes = [leaves - binds, leaves + reacts - binds, binds - leaves - reacts, reacts - decays]
    return jnp.stack([*slopes, decays])


@ONE_OF_BOTH
def test_a_component_at_rest_at_its_bound_has_no_derivative_from_roundoff(kind):
    """Once the substrate is zero the steps grow far beyond those that are stable for it, so that a
    derivative of 1e-16 would grow to 1e15."""
    amounts = {
        "enzyme": dfc.FirstIntegral(lambda t, y, args: y[1] + y[2]),
        "substrate": dfc.FirstIntegral(lambda t, y, args: jnp.sum(y) - y[1]),
    }
    solver = dfc.ManifoldProjection(dfx.Tsit5(), amounts, projection=kind(lower=0.0, upper=9.0))

    def decayed(log_rates):
        sol = dfx.diffeqsolve(
            dfx.ODETerm(enzyme), solver, 0.0, 5.0, None, jnp.array([1.0, 0.1, 0.0, 0.0, 0.0]),
            jnp.exp(log_rates), stepsize_controller=dfx.PIDController(rtol=1e-4, atol=1e-5),
            saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 5.0, 6)), max_steps=256,
        )  # fmt: skip
        return jnp.sum(sol.ys[:, 4] ** 2), jnp.min(sol.ys[:, 0])

    logs = jnp.log(jnp.array([[200.0, 1.0, 30.0, 0.1], [2000.0, 1.0, 100.0, 0.1]]))
    run = jax.jit(jax.vmap(jax.value_and_grad(decayed, has_aux=True)))
    (_, least), slopes = run(logs)
    assert np.all(least == 0)
    for i, change in enumerate(1e-3 * np.eye(4)):
        high, low = (run(logs + x)[0][0] for x in (change, -change))
        np.testing.assert_allclose(slopes[:, i], (high - low) / 2e-3, rtol=2e-2, atol=1e-4)


@BOTH
def test_at_a_bound_a_derivative_has_no_roundoff(kind):
    """It is that of the candidate, and beyond the bound it is zero."""
    atoms, amounts = jnp.array([[0.0, 1.0, 1.0, 0.0], [1.0, 0.0, 1.0, 1.0]]), jnp.array([0.1, 1.0])
    options = dict(args=atoms, value=amounts, projection=kind(lower=0.0))
    derivative = jax.jit(jax.jacfwd(lambda y: dfc.project(BALANCES, y, **options)[0]))
    at_it, beyond = (derivative(jnp.array([s, 0.06, 0.04, 0.96])) for s in (0.0, -1e-3))
    np.testing.assert_array_equal(at_it[0], [1.0, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(beyond[0], 0.0)
    for found in (at_it, beyond):
        np.testing.assert_allclose(atoms @ found, 0, atol=2 * EPS)


def test_states_of_an_attempt_that_failed_spoil_no_derivative():
    """In a batch they are evaluated in all lanes, and discarded."""
    total = dfc.FirstIntegral(lambda t, y, args: jnp.array([y[1] + y[2], jnp.sum(y) - y[1]]))
    projection = dfc.SimplifiedNewton(lower=0.0, upper=1.0)
    solver = dfc.ManifoldProjection(dfx.Tsit5(), total, projection=projection)
    term, y0 = dfx.ODETerm(enzyme), jnp.array([1.0, 0.1, 0.0, 0.0, 0.0])

    def saved(rates, length):
        state = solver.init(term, 0.0, length, y0, rates)
        y1, _, info, *_ = solver.step(term, 0.0, length, y0, rates, state, False)
        inside = solver.interpolation_cls(t0=0.0, t1=length, **info)
        return inside.evaluate(length / 3), jnp.all(jnp.isfinite(y1))

    rates = jnp.array([1e4, 1.0, 100.0, 0.1])
    lengths = jnp.geomspace(1e-3, 1e-1, 15)
    run = jax.vmap(lambda length: jax.vjp(lambda x: saved(x, length), rates, has_aux=True))
    y, vjp, ok = jax.jit(run)(lengths)
    assert 0 < np.sum(ok) < len(ok)
    np.testing.assert_array_equal(np.all(np.isnan(y), axis=1), ~ok)
    assert np.all(jax.vmap(lambda f: f(jnp.zeros(5))[0])(vjp) == 0)


@ONE_OF_BOTH
def test_what_cannot_be_fails(kind):
    total = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y))
    y = jnp.array([0.3, -0.2, 0.5])

    @eqx.filter_jit
    def project(projection, y, value):
        return dfc.project(total, y, value=value, projection=projection)

    for value, projection in [(-0.1, kind(lower=0.0)), (3.1, kind(lower=0.0, upper=1.0))]:
        state, info = project(projection, y, jnp.asarray(value))
        assert not info.ok
        assert jnp.all(state >= 0)
    _, info = project(kind(lower=0.0), y.at[0].set(jnp.nan), jnp.asarray(1.0))
    assert not info.ok


def wanted(t, within):
    """The total: one, or negative in the middle, which no state within the bounds has."""
    return jnp.where(within, 1.0, jnp.cos(2 * jnp.pi * t / 0.12))


TOTAL = {"total": dfc.Constraint(lambda t, y, within: jnp.sum(y) - wanted(t, within))}


@eqx.filter_jit
def saved_in_a_long_step(projection, within):
    """In such a long step the interpolant of Tsit5 has the total 1, and amounts far below zero."""
    solver = dfc.ManifoldProjection(dfx.Tsit5(), TOTAL, projection=projection)
    saveat, y0 = dfx.SaveAt(t0=True, ts=jnp.linspace(0, 0.12, 12)), jnp.array([1.0, 0.0])
    field = lambda t, y, args: jnp.stack([-30 * y[0], 30 * y[0]])  # noqa: E731
    options = dict(t1=0.12, dt0=0.12, args=within, saveat=saveat)
    solution = one_solve(field, solver, y0, **options)
    return solution.ts, solution.ys, dfc.off_manifold(solution, TOTAL, within)


@some_of(
    "projection",
    [
        dfc.SimplifiedNewton(lower=0.0),
        dfc.Newton(lower=0.0),
        dfc.Staged(("total", dfc.SimplifiedNewton(lower=0.0))),
    ],
    ids=["simplified", "newton", "staged"],
    period=3,
)
def test_saved_states_are_within_the_bounds_and_one_that_cannot_be_projected_is_told(projection):
    _, ys, off = saved_in_a_long_step(projection, jnp.array(True))
    assert jnp.min(ys) >= 0
    # The tolerance, of the value, the amounts and their changes.
    assert jnp.max(jnp.abs(jnp.sum(ys, axis=1) - 1)) <= 16 * EPS * 3
    assert not jnp.any(off)
    ts, ys, off = saved_in_a_long_step(projection, jnp.array(False))
    assert jnp.min(ys) >= 0
    wrong = jnp.abs(jnp.sum(ys, axis=1) - wanted(ts, jnp.array(False))) > 1e-6
    assert jnp.any(wrong)
    assert jnp.array_equal(wrong, off)


def test_bounds_may_be_kept_alone():
    """Euler's method overshoots zero; what is not beyond a bound is the solver's own."""
    field = lambda t, y, args: jnp.stack([-30 * y[0], 30 * y[0] - y[1]])  # noqa: E731

    def end(solver, dt0):
        saveat = dfx.SaveAt(ts=jnp.linspace(0, 1, 21), solver_state=True)
        return one_solve(field, solver, jnp.array([1.0, 0.0]), dt0=dt0, saveat=saveat)

    kept = dfc.ManifoldProjection(dfx.Euler(), (), projection=dfc.SimplifiedNewton(lower=0.0))
    sol = end(kept, 0.05)
    assert jnp.min(sol.ys) == 0
    # The corrections are long, and it is right so.
    assert "check_invariance" not in str(dfc.statistics(sol))
    np.testing.assert_array_equal(end(kept, 0.02).ys, end(dfx.Euler(), 0.02).ys)
    for make in (lambda: dfc.ManifoldProjection(dfx.Euler(), ()), lambda: dfc.drift(sol, ())):
        with pytest.raises(ValueError, match=r"nothing to conserve, or to measure.*lower"):
            make()
