"""When to project, what to project, and what the projections did."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc

from ..problems import OMEGA0, RIGID_BODY, drift_of, rigid_body, solve

STEPS = dfx.SaveAt(t0=True, steps=True, solver_state=True, dense=True)


def run(t1=2.0, dt0=0.1, **options):
    solver = dfc.ManifoldProjection(dfc.RK4(), RIGID_BODY, **options)
    return solve(rigid_body, solver, OMEGA0, t1=t1, dt0=dt0, saveat=STEPS, max_steps=64)


def drifts(sol):
    """The largest residual at each saved time."""
    leaves = jax.tree.leaves(drift_of(sol, RIGID_BODY))
    return np.max(np.abs(np.stack(leaves)), axis=0)[: int(sol.stats["num_steps"]) + 1]


def test_every_projects_every_so_many_steps():
    drift = drifts(run(every=3))
    projected = np.arange(len(drift)) % 3 == 0
    assert np.all(drift[projected] <= 4e-16)
    assert np.all(drift[~projected] >= 1e-10)
    assert dfc.statistics(run(every=3)).num_projections == 6


def test_every_leaves_dense_output_alone_in_between():
    sol, plain = run(every=3), solve(rigid_body, dfc.RK4(), OMEGA0, t1=2.0, dt0=0.1, saveat=STEPS)
    np.testing.assert_array_equal(sol.evaluate(0.15), plain.evaluate(0.15))


@pytest.mark.slow
def test_every_continues_where_it_stopped():
    solver = dfc.ManifoldProjection(dfc.RK4(), RIGID_BODY, every=3)
    saveat = dfx.SaveAt(t1=True, solver_state=True)
    first = solve(rigid_body, solver, OMEGA0, t1=0.4, saveat=saveat)
    second = solve(
        rigid_body,
        solver,
        first.ys[-1],
        t0=0.4,
        t1=0.6,
        solver_state=first.solver_state,
        saveat=saveat,
    )
    np.testing.assert_allclose(second.ys[-1], run(every=3).ys[6], rtol=1e-14)


def test_threshold_projects_where_the_residual_is_larger():
    threshold = 1e-8
    sol = run(threshold=threshold)
    drift, statistics = drifts(sol), dfc.statistics(sol)
    assert np.all(drift <= threshold)
    assert np.max(drift) > 1e-10
    assert 0 < statistics.num_projections < sol.stats["num_steps"]
    # Dense output obeys the same rule.
    values = [f.fn(0.0, OMEGA0, None) for f in RIGID_BODY.values()]
    for t in np.linspace(0, 2, 41):
        for f, value in zip(RIGID_BODY.values(), values, strict=True):
            assert abs(f.fn(t, sol.evaluate(t), None) - value) <= 1.01 * threshold * 3 * value


@pytest.mark.parametrize("options", [{"every": 2}, {"threshold": 1e-3}])
def test_nan_is_no_success_where_nothing_is_projected(options):
    solver = dfc.ManifoldProjection(dfc.RK4(), RIGID_BODY, **options)
    sol = solve(lambda t, y, args: jnp.sqrt(-1 - t) * y, solver, OMEGA0, throw=False, t1=0.1)
    assert sol.result != dfx.RESULTS.successful


def test_options_can_be_traced_and_batched():
    @jax.jit
    def final(threshold, max_correction):
        solver = dfc.ManifoldProjection(
            dfc.RK4(), RIGID_BODY, threshold=threshold, max_correction=max_correction
        )
        return solve(rigid_body, solver, OMEGA0).ys[-1]

    thresholds = jnp.array([1e-20, 1e-3])
    batch = jax.vmap(final, (0, None))(thresholds, 0.5)
    plain = solve(rigid_body, dfc.RK4(), OMEGA0).ys[-1]
    np.testing.assert_allclose(batch[0], run(t1=1.0).ys[10], rtol=1e-14)
    np.testing.assert_allclose(batch[1], plain, rtol=1e-14)


# ---- project_error ----


def lorenz(**options):
    system = dfc.systems.get("conservative-lorenz")
    sol = solve(
        system.vector_field,
        dfc.ManifoldProjection(dfx.Tsit5(), system.manifold, **options),
        system.y0,
        t1=100.0,
        dt0=None,
        args=system.args,
        stepsize_controller=dfx.PIDController(rtol=1e-5, atol=1e-5),
        max_steps=4096,
    )
    return sol, np.linalg.norm(sol.ys[-1] - system.reference(np.array([0.0, 100.0]))[-1])


@pytest.mark.slow
def test_a_projected_error_estimate_saves_steps_and_costs_accuracy():
    (plain, error), (projected, larger_error) = lorenz(), lorenz(project_error=True)
    assert projected.stats["num_steps"] < 0.95 * plain.stats["num_steps"]
    assert error < larger_error < 1e-2


def test_the_projected_error_estimate_is_tangential():
    terms, args = dfx.ODETerm(rigid_body), None

    @jax.jit
    def estimates_and_rows(y0):
        estimates = []
        for project_error in (False, True):
            solver = dfc.ManifoldProjection(dfx.Tsit5(), RIGID_BODY, project_error=project_error)
            state = solver.init(terms, 0.0, 0.5, y0, args)
            y1, error, *_ = solver.step(terms, 0.0, 0.5, y0, args, state, False)
            estimates.append(error)
        rows = [jax.grad(lambda y, f=f: f.fn(0.0, y, args))(y1) for f in RIGID_BODY.values()]
        return estimates, rows

    (whole, tangential), rows = estimates_and_rows(OMEGA0)
    rows = np.stack(rows)
    normal = rows.T @ np.linalg.solve(rows @ rows.T, rows @ whole)
    np.testing.assert_allclose(tangential, whole - normal, rtol=1e-8, atol=1e-16)


# ---- statistics ----


def test_statistics_are_those_of_the_projections():
    sol = run()
    statistics = dfc.statistics(sol)
    steps = int(sol.stats["num_steps"])
    assert statistics.num_projections == steps
    assert 2 * steps <= statistics.num_iterations <= steps * statistics.max_iterations
    assert statistics.rank == 2
    assert statistics.residual_after <= 4e-15
    # Against a step made by hand.
    infos = []
    values = {name: f.fn(0.0, OMEGA0, None) for name, f in RIGID_BODY.items()}

    @jax.jit
    def step(y):
        candidate = solve(rigid_body, dfc.RK4(), y, t1=0.1).ys[-1]
        return dfc.project(RIGID_BODY, candidate, value=values, projection=dfc.SimplifiedNewton())

    y = OMEGA0
    for _ in range(steps):
        y, info = step(y)
        infos.append(info)
    np.testing.assert_allclose(
        statistics.residual_before, max(i.residual_before for i in infos), rtol=1e-6
    )
    np.testing.assert_allclose(statistics.correction, max(i.correction for i in infos), rtol=1e-6)
    assert statistics.num_iterations == sum(int(i.num_steps) for i in infos)


def test_statistics_of_a_duplicated_integral_show_the_rank():
    energy = RIGID_BODY["energy"]
    solver = dfc.ManifoldProjection(dfc.RK4(), [energy, energy])
    sol = solve(rigid_body, solver, OMEGA0, saveat=STEPS)
    assert dfc.statistics(sol).rank == 1


@pytest.mark.slow
def test_statistics_of_a_batch_and_of_a_nested_solver():
    def lane(scale):
        solver = dfx.HalfSolver(dfc.ManifoldProjection(dfc.RK4(), RIGID_BODY))
        saveat = dfx.SaveAt(t1=True, solver_state=True)
        return solve(rigid_body, solver, scale * OMEGA0, saveat=saveat, dt0=0.5)

    statistics = dfc.statistics(jax.vmap(lane)(jnp.array([0.5, 1.0])))
    np.testing.assert_array_equal(statistics.num_projections, [4, 4])  # the two halves
    assert statistics.correction[0] < statistics.correction[1]


def test_statistics_need_the_solver_state():
    with pytest.raises(ValueError, match="solver_state=True"):
        dfc.statistics(solve(rigid_body, dfc.ManifoldProjection(dfc.RK4(), RIGID_BODY), OMEGA0))
    saveat = dfx.SaveAt(t1=True, solver_state=True)
    with pytest.raises(ValueError, match="ManifoldProjection"):
        dfc.statistics(solve(rigid_body, dfx.Tsit5(), OMEGA0, saveat=saveat))


@pytest.mark.slow
@pytest.mark.parametrize("t1", [0.4, -0.4])
def test_rejections_because_of_projection_are_counted(t1):
    """Two iterations are too few for a long step with the first-order method."""

    def adaptive(controller):
        projection = dfc.SimplifiedNewton(max_steps=2)
        return solve(
            rigid_body,
            dfc.ManifoldProjection(dfx.HalfSolver(dfx.Euler()), RIGID_BODY, projection=projection),
            OMEGA0,
            t1=t1,
            dt0=t1 / 2,
            stepsize_controller=controller,
            saveat=dfx.SaveAt(t1=True, solver_state=True, controller_state=True),
        )

    def controller(tolerance):  # an array, for which nothing is compiled anew
        return dfx.PIDController(rtol=jnp.array(tolerance), atol=jnp.array(tolerance))

    careless = controller(1e9)  # accepts any error estimate
    plain, counted = adaptive(careless), adaptive(dfc.CountRejections(careless))
    # Two programs, which may be rounded differently.
    np.testing.assert_allclose(plain.ys, counted.ys, rtol=1e-13)
    assert dfc.statistics(plain).num_rejected is None
    assert dfc.statistics(counted).num_rejected == counted.stats["num_rejected_steps"] > 0
    # And not those because of the error.
    careful = controller(1e-6)
    sol = adaptive(dfc.CountRejections(careful))
    assert dfc.statistics(sol).num_rejected < sol.stats["num_rejected_steps"]


def test_implicit_solvers_take_the_tolerances_through_the_counting_controller():
    controller = dfc.CountRejections(dfx.PIDController(rtol=1e-6, atol=1e-6))
    solver = dfc.ManifoldProjection(dfx.Kvaerno3(), RIGID_BODY)
    sol = solve(rigid_body, solver, OMEGA0, stepsize_controller=controller)
    assert sol.result == dfx.RESULTS.successful
