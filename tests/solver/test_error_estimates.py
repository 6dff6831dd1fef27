"""The error estimate of a learned step, and adaptive steps with it."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc

from ..learned import DRIVEN0, LORENZ, SWEEPS, Still, driven, flow_map, states, unchecked

TERM = dfx.ODETerm(LORENZ.vector_field)
DRIVEN = dfx.ODETerm(driven)


@eqx.filter_jit
def step(solver, y0, h, *, term=TERM, t0=0.0, args=None):
    """The state after one step, and the error estimate."""
    t0, t1 = jnp.asarray(t0), jnp.asarray(t0 + h)
    state = solver.init(term, t0, t1, y0, args)
    y1, error, *_ = solver.step(term, t0, t1, y0, args, state, False)
    return y1, error


@eqx.filter_jit
def exact(term, y0, h, t0=0.0, args=None):
    controller = dfx.PIDController(rtol=1e-13, atol=1e-13)
    return dfx.diffeqsolve(
        term, dfx.Dopri8(), t0, t0 + h, h / 100, y0, args, stepsize_controller=controller
    ).ys


def final(tree):
    return jax.tree.map(lambda x: x[-1], tree)


# ---- Against the true error ----


@pytest.mark.parametrize(
    ("name", "kind", "factor"),
    [
        ("conservative-lorenz", "standard", 1.0),
        pytest.param("point-vortices", "conservative", 1.5, marks=pytest.mark.slow),
    ],
)
def test_the_estimate_is_the_true_error_of_the_shipped_flow_maps(name, kind, factor):
    """Of one full step; a `factor` above one takes the states out of the domain."""
    system = dfc.systems.get(name)
    network = dfc.load_pretrained(f"{name}-{kind}")
    term, h = dfx.ODETerm(system.vector_field), network.max_step
    # Among the random vortices are pairs so close that `h ‖∂f‖` is beyond the estimate.
    y0s = factor * states(100 if name == "point-vortices" else 20, system)
    y1s, estimates = jax.vmap(lambda y0: step(unchecked(network), y0, h, term=term))(y0s)
    errors = jax.vmap(lambda y0: final(exact(term, y0, h)))(y0s) - y1s
    ratios = jnp.linalg.norm(estimates, axis=1) / jnp.linalg.norm(errors, axis=1)
    low, middle, high = np.percentile(ratios, [5, 50, 95])
    assert 0.9 < low <= high < 1.1
    np.testing.assert_allclose(middle, 1, atol=0.01)


class Wrong(eqx.Module):
    """The exact flow of `y' = rate y + bend y²`, but for a multiple of `h^(order + 1)`."""

    rate: float = -1.0
    bend: float = 0.3
    order: int = 0
    size: float = 1e-3
    max_step: float = 1.0

    def __call__(self, y0, h):
        growth = jnp.exp(self.rate * h)
        y = y0 * growth / (1 + self.bend / self.rate * y0 * (1 - growth))
        return y + self.size * h ** (self.order + 1) * jnp.cos(3 * h)


def logistic(rate, bend):
    return dfx.ODETerm(lambda t, y, args: rate * y + bend * y**2)


LINEAR = dfx.ODETerm(lambda t, y, args: args * y)


@pytest.mark.parametrize("rate", [-6.0, 3.0])
def test_the_estimate_knows_how_the_vector_field_passes_an_error_on(rate):
    """Where `h ‖∂f‖` is not small the integral of the defect, a Picard sweep, is far off."""
    network, y0 = Wrong(jnp.array(rate), 0.0), jnp.array(1.0)

    def run(corrections):
        solver = unchecked(network, nodes=16, corrections=corrections)
        return step(solver, y0, 1.0, term=LINEAR, args=jnp.array(rate))

    y1, estimate = run(0)
    error = jnp.exp(rate) - y1
    np.testing.assert_allclose(estimate, error, rtol=0.05)
    integral = run(1)[0] - y1
    assert not 0.6 < integral / error < 1.6


def test_the_estimate_has_a_sign_and_sees_time_and_args():
    solver = unchecked(Still())
    y1, estimate = step(solver, DRIVEN0, 0.3, term=DRIVEN, t0=1.3, args=2.0)
    error = jax.tree.map(
        lambda a, b: a[-1] - b, exact(DRIVEN, DRIVEN0, 0.3, jnp.array(1.3), 2.0), y1
    )
    for name in error:
        np.testing.assert_allclose(estimate[name], error[name], rtol=1e-3)


def test_the_estimate_is_never_small_where_something_is_not_finite():
    """In the flow map or in the vector field."""

    class Broken(Still):
        def __call__(self, y0, h):
            return jnp.where(h > 0.1, jnp.nan, y0)

    _, estimate = step(unchecked(Broken()), LORENZ.y0, 0.2)
    assert not jnp.any(jnp.isfinite(estimate))
    term = dfx.ODETerm(lambda t, y, args: jnp.where(t > 0.1, jnp.nan, y))
    _, estimate = step(unchecked(Still()), LORENZ.y0, 0.2, term=term)
    assert jnp.all(jnp.isnan(estimate))


@pytest.mark.parametrize(
    ("order", "sweep", "corrections"),
    [(2, "picard", 0), (0, "newton", 2)],
)
def test_the_estimate_falls_with_the_step_as_claimed(order, sweep, corrections):
    network, term = Wrong(order=order, size=0.5), logistic(-1.0, 0.3)
    solver = unchecked(network, corrections=corrections, sweep=SWEEPS[sweep], nodes=8)
    steps = jnp.array([0.02, 0.04])
    small, large = jax.vmap(lambda h: step(solver, jnp.array(1.0), h, term=term)[1])(steps)
    slope = jnp.log2(jnp.abs(large / small))
    np.testing.assert_allclose(slope, solver.error_order(term), atol=0.25)


# ---- Free under fixed steps ----


def test_fixed_steps_do_not_compute_it():
    """An evaluation of this vector field takes millions of operations, all the rest thousands."""
    heavy = jnp.ones((1000, 1000))

    def field(t, y, args):
        return LORENZ.vector_field(t, y, args) + 0 * jnp.sum(jnp.tanh(heavy @ (heavy * y[0])))

    def flops(solver, **options):
        def run(y0):
            return dfx.diffeqsolve(
                dfx.ODETerm(field), solver, 0.0, 1.0, 0.25, y0, max_steps=8, **options
            ).ys

        return jax.jit(run).lower(LORENZ.y0).compile().cost_analysis()["flops"]

    one = 1e9
    solver = unchecked(flow_map())
    assert flops(solver) < 1e-3 * one
    assert flops(dfc.ManifoldProjection(solver, LORENZ.manifold)) < 1e-3 * one
    assert flops(solver, stepsize_controller=dfx.PIDController(rtol=1e-3, atol=1e-3)) > one


# ---- Adaptive steps ----


def solve(solver, *, tol=1e-4, **options):
    """Adaptive, with options of the controller or of the solve."""
    names = {"dtmax", "dtmin", "force_dtmin"} & options.keys()
    chosen = {name: options.pop(name) for name in names}
    tol = jnp.asarray(tol)  # others compile nothing new
    return compiled(solver, dfx.PIDController(rtol=tol, atol=tol, **chosen), **options)


@eqx.filter_jit
def compiled(solver, controller, y0=LORENZ.y0, t1=2.0, dt0=None, max_steps=2000, **options):
    return dfx.diffeqsolve(
        TERM,
        solver,
        0.0,
        t1,
        dt0,
        y0,
        stepsize_controller=controller,
        max_steps=max_steps,
        **options,
    )


SHIPPED = dfc.load_pretrained("conservative-lorenz-standard")


def test_tighter_tolerances_take_more_steps_and_err_less():
    solver = unchecked(SHIPPED, corrections=2)
    expected = final(exact(TERM, LORENZ.y0, 2.0))
    found = [solve(solver, tol=tol) for tol in (1e-3, 1e-6, 1e-8)]
    counts = [int(sol.stats["num_accepted_steps"]) for sol in found]
    errors = [float(jnp.linalg.norm(sol.ys[-1] - expected)) for sol in found]
    assert 8 <= counts[0] < counts[1] < counts[2]
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 1e-7


def test_steps_longer_than_the_longest_are_rejected():
    """Not an error: the controller tries a smaller one."""
    sol = solve(unchecked(SHIPPED), tol=1e-1, saveat=dfx.SaveAt(steps=True))
    assert sol.stats["num_rejected_steps"] > 0
    lengths = jnp.diff(jnp.where(jnp.isfinite(sol.ts), sol.ts, jnp.nan), prepend=0.0)
    assert jnp.nanmax(lengths) <= 0.25 + 1e-6
    assert jnp.nanmax(lengths) > 0.04
