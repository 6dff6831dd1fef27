"""Learned solvers in `diffeqsolve`: they follow their networks, as RK4 would follow its formula."""

import functools as ft

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optimistix as optx
import pytest

import diffrax_conserve as dfc

from .. import problems
from ..learned import LORENZ, Still, flow_map, solution, unchecked
from ..problems import refused
from ..thinned import some_of


# Random weights; the path of the other core changes too fast for the dense output.
@ft.cache
def network(name):
    return solution() if name == "pinn" else flow_map(core="concatenated")


def of(name, **options):
    return (dfc.PINNSolver if name == "pinn" else unchecked)(network(name), **options)


def solve(solver, y0=LORENZ.y0, *, dt0=0.25, **kwargs):
    return problems.solve(LORENZ.vector_field, solver, y0, dt0=dt0, **kwargs)


def path(name, t):
    """The state at time `t` by hand, in steps of 0.25."""
    found = eqx.filter_jit(network(name))
    if name == "pinn":
        return found(jnp.asarray(t))
    y = LORENZ.y0
    for _ in range(int(t / 0.25)):
        y = found(y, jnp.asarray(0.25))
    return found(y, jnp.asarray(t % 0.25))


@pytest.mark.parametrize("name", ["deeponet", "pinn"])
def test_steps_saved_times_and_dense_output_follow_the_network(name):
    ts = jnp.array([0.1, 0.25, 0.6, 0.97])
    subs = dict(a=dfx.SubSaveAt(ts=ts), b=dfx.SubSaveAt(t0=True, steps=True))
    sol = solve(of(name), saveat=dfx.SaveAt(subs=subs, dense=True))
    for t, y in zip(ts, sol.ys["a"], strict=True):
        np.testing.assert_allclose(y, path(name, float(t)), rtol=0, atol=1e-8)
        np.testing.assert_allclose(sol.evaluate(t), y, rtol=0, atol=1e-14)
    for t, y in zip(np.arange(5) / 4, sol.ys["b"], strict=False):
        np.testing.assert_allclose(y, path(name, t), rtol=0, atol=1e-15)


@some_of("name", ["deeponet", "pinn"], period=2)
def test_events(name):
    # The component that changes most in the step from 0.5 to 0.75 crosses the mean of its ends.
    ends = path(name, 0.5), path(name, 0.75)
    k = int(jnp.argmax(jnp.abs(ends[1] - ends[0])))
    level = float(ends[0][k] + ends[1][k]) / 2

    def crossing(t, y, args, **kwargs):
        return y[k] - level

    event = dfx.Event(crossing, optx.Bisection(1e-10, 1e-10))
    sol = solve(of(name), path(name, 0.5), t0=0.5, event=event)
    assert sol.result == dfx.RESULTS.event_occurred
    assert 0.5 < float(sol.ts[-1]) < 0.75
    np.testing.assert_allclose(sol.ys[-1][k], level, rtol=0, atol=1e-9)
    np.testing.assert_allclose(sol.ys[-1], path(name, float(sol.ts[-1])), rtol=0, atol=1e-7)


@pytest.mark.slow
def test_a_pinn_may_start_later_and_go_back():
    pinn = network("pinn")
    later = solve(
        of("pinn"), pinn(0.5), t0=0.5, t1=0.1, dt0=-0.1, saveat=dfx.SaveAt(ts=[0.33, 0.1])
    )
    np.testing.assert_allclose(later.ys, jax.vmap(pinn)(jnp.array([0.33, 0.1])), rtol=0, atol=1e-10)


@some_of("name", ["deeponet", "pinn"], period=2)
def test_backsolve_adjoint_explains(name):
    solver = of(name)
    with pytest.raises(ValueError, match=r"BacksolveAdjoint\(solver=diffrax.Tsit5\(\)\)"):
        jax.eval_shape(
            jax.grad(lambda y0: solve(solver, y0, adjoint=dfx.BacksolveAdjoint()).ys[0, 0]),
            LORENZ.y0,
        )


def test_a_largest_step_that_is_an_array(errors_raise):
    still = unchecked(Still(jnp.array(0.25)))
    with pytest.raises(RuntimeError, match="a step is longer than the flow map was trained for"):
        jax.block_until_ready(solve(still, dt0=0.5).ys)
    np.testing.assert_array_equal(solve(still).ys[0], LORENZ.y0)


class Broken(eqx.Module):
    """A flow map that is not finite from the second step on."""

    max_step: float = 0.25

    def __call__(self, y0, h):
        return jnp.where(jnp.max(jnp.abs(y0)) > 1.2, jnp.nan, y0 + h)


FLOW, FOLLOW = ft.partial(of, "deeponet"), ft.partial(of, "pinn")
NAN, GROWING = jnp.nan * LORENZ.y0, dfc.learned.Taylor(lambda t, y, args: 2 * y)
CASES = {
    "backwards": (FLOW, dict(t1=-1.0, dt0=-0.25), "backwards in time"),
    "too long": (FLOW, dict(t1=2.0, dt0=0.5), "a step is longer"),
    "another field": (lambda: dfc.DeepONetSolver(flow_map(taylor=GROWING)), {}, "not trained for"),
    "not a number": (FLOW, dict(y0=NAN), "not finite"),
    "no longer a number": (lambda: unchecked(Broken()), {}, "not finite"),
    "another start": (FOLLOW, dict(y0=LORENZ.y0 + 0.125), "not the state that the PINN has"),
    "outside": (FOLLOW, dict(t1=3.0), "outside the interval"),
    "no number to start from": (FOLLOW, dict(y0=NAN), "not the state"),
}
FIXED, ADAPTIVE = dfx.ConstantStepSize(), dfx.PIDController(rtol=1.0, atol=1.0, dtmin=1e-3)
QUICK = [("another start", FIXED)]
# A PINN has no error estimate, and what is too long is tried again with a shorter step.
RUNS = [(name, FIXED) for name in CASES]
RUNS += [(name, ADAPTIVE) for name in CASES if CASES[name][0] is not FOLLOW and name != "too long"]


@pytest.mark.parametrize(
    ("name", "controller"),
    [pytest.param(*run, marks=() if run in QUICK else pytest.mark.slow) for run in RUNS],
)
def test_nothing_raises_in_a_batch(name, controller, errors_raise):
    """Every lane ends by itself, with its own result: an exception would end all of them."""
    make, options, text = CASES[name]
    options = dict(y0=LORENZ.y0, t1=1.0, max_steps=16, throw=False) | options

    solver = make()

    def lane(y0):
        return solve(solver, **(options | dict(y0=y0, stepsize_controller=controller)))

    both = jax.vmap(lane)(jnp.stack([options["y0"], LORENZ.y0]))
    result = jax.tree.map(lambda x: x[0], both.result)
    assert result != dfx.RESULTS.successful
    # A controller rejects what is not finite, and tries smaller steps.
    assert (controller is ADAPTIVE and text == "not finite") or text in dfx.RESULTS[result]


def test_each_leaf_of_the_start_is_compared_in_its_own_unit():
    y0 = {"position": jnp.array(1.5e11), "velocity": jnp.array(3e4)}
    solver = dfc.PINNSolver(dfc.PINN(y0, 0.0, 1.0, key=jr.key(0)))
    field = lambda t, y, args: y  # noqa: E731
    for factor, right in ((1.0, True), (1.01, False)):
        other = y0 | {"velocity": factor * y0["velocity"]}
        sol = problems.solve(field, solver, other, dt0=0.5, throw=False)
        assert (sol.result == dfx.RESULTS.successful) == right


@pytest.mark.slow
def test_roundoff_in_the_times_is_not_refused():
    sol = solve(of("deeponet"), t0=1e6, t1=1e6 + 1.0, saveat=dfx.SaveAt(t1=True))
    np.testing.assert_allclose(sol.ys[0], path("deeponet", 1.0), rtol=0, atol=1e-8)
    tenth = unchecked(flow_map(max_step=0.1))
    assert solve(tenth, t1=10.0, dt0=0.1).result == dfx.RESULTS.successful


test_arguments_that_are_refused = refused(
    (lambda: unchecked(lambda y0, h: y0), TypeError, None),
    (lambda: dfc.PINNSolver(network("deeponet")), TypeError, None),
    (lambda: FLOW(corrections=-1), ValueError, "`corrections` is -1"),
    (
        lambda: problems.solve(lambda t, y, args: y, FOLLOW(), (LORENZ.y0, LORENZ.y0)),
        ValueError,
        "but the state has",
    ),
)


def test_a_pinn_has_no_error_estimate_for_adaptive_steps(errors_raise):
    controller = dfx.PIDController(rtol=1e-3, atol=1e-3)
    with pytest.raises(RuntimeError, match="error"):
        solve(of("pinn"), stepsize_controller=controller)
