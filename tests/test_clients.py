"""Published packages that use diffrax, with one solver exchanged through their own doors.

They are installed by `make clients`, which `make slow` calls, and are skipped elsewhere.
"""

import diffrax as dfx
import jax
import jax.numpy as jnp
import pytest

import diffrax_conserve as dfc

from .test_benchmarks import benchmark

CLIENTS = benchmark("clients")


def problem(name):
    package = pytest.importorskip(CLIENTS.PACKAGES[name], reason="installed by `make clients`")
    assert package is not None
    return benchmark(name)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of the packages
@pytest.mark.parametrize("name", CLIENTS.PACKAGES)
def test_a_published_package_keeps_what_is_declared(name):
    client = problem(name).client(smoke=True)
    reference = client.reference()
    plain, kept = (
        client.run(solver, client.tolerance)() for solver in (client.solver, client.kept())
    )
    assert client.drift(kept) < 1e-13
    assert any(jnp.any(a != b) for a, b in zip(*map(jax.tree.leaves, (plain, kept)), strict=True))
    assert client.error(kept, reference) < 2 * client.error(plain, reference) + 1e-12


@pytest.mark.slow
def test_stars_in_one_state_are_kept_between_the_steps_too():
    stars = problem("galactic_orbit")
    client = stars.client(smoke=True)
    shifts = jnp.linspace(-2.0, 2.0, 10)[:, None] * jnp.array([1.0, 0.5, 0.2])
    y0 = client.y0[0] + shifts, client.y0[1] + 0 * shifts
    door = stars.orbit_solver(client.kept(), client.tolerance)
    dense = door.solve(stars.field, y0, 0.0, 500.0, dense=True).interpolation
    for law in stars.laws.values():
        values = jax.vmap(lambda t, law=law: law.fn(t, dense.evaluate(t), None))(
            jnp.linspace(0.0, 500.0, 333)
        )
        assert jnp.max(jnp.abs(values / values[0] - 1)) < 1e-13


@pytest.mark.slow
def test_a_guiding_centre_that_stops_at_an_event_has_its_moment():
    ions = problem("guiding_centre")
    client = ions.client(smoke=True)
    stopped = ions.traced(
        client.kept(), client.tolerance, 1e-5, 101, condition=lambda t, y, args, **kwargs: y[3]
    ).trajectories[0]
    there = stopped[jnp.all(jnp.isfinite(stopped), axis=1)]
    assert 2 < len(there) < 101
    moments = jax.vmap(lambda y: ions.moment(0.0, y, None))(there)
    assert jnp.max(jnp.abs(moments / moments[0] - 1)) < 1e-13


@pytest.mark.slow
def test_the_inverse_of_a_flow_starts_and_ends_on_the_sphere():
    flows = problem("flow_on_sphere")
    client = flows.client(smoke=True)
    errors = []
    for solver in (client.solver, client.kept()):
        flow = flows.flow(solver, client.tolerance)
        there = flows.moved(flow, client.y0, inverse=False)
        back = flows.moved(flow, there, inverse=True)
        # Of the points, and of the logarithm of the density.
        errors.append([jnp.max(jnp.abs(a - b)) for a, b in zip(back, client.y0, strict=True)])
    for x, _ in (there, back):
        assert jnp.max(jnp.abs(jnp.linalg.norm(x, axis=1) - 1)) < 1e-15
    assert all(kept < plain for plain, kept in zip(*errors, strict=True))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_density_matrix_of_a_package_stays_positive():
    matrices = problem("density_matrix")
    client = matrices.client(smoke=True)
    plain, kept = (
        jnp.min(jnp.linalg.eigvalsh(client.run(solver, client.tolerance)()))
        for solver in (client.solver, client.kept())
    )
    assert plain < -1e-8
    assert kept >= 0


@pytest.mark.slow
def test_states_and_laws_are_quantities_where_diffrax_takes_them():
    units = pytest.importorskip("unxt", reason="installed by `make clients`")
    quantity = units.Quantity
    start = {"q": quantity(jnp.array([1.0, 0.0]), "m"), "v": quantity(jnp.array([0.0, 1.0]), "m/s")}

    def field(t, y, args):
        return {"q": quantity(y["v"].value, "m"), "v": quantity(-y["q"].value, "m/s")}

    def energy(t, y, args):
        return quantity(jnp.sum(y["v"].value ** 2) + jnp.sum(y["q"].value ** 2), "m2/s2")

    kept = dfc.ManifoldProjection(dfx.Tsit5(), dfc.FirstIntegral(energy))
    ends = [
        dfx.diffeqsolve(dfx.ODETerm(field), solver, 0, 10, 0.5, start).ys
        for solver in (dfx.Tsit5(), kept)
    ]
    plain, projected = (
        abs(energy(0.0, jax.tree.map(lambda x: x[-1], end), None).value - 2) for end in ends
    )
    assert projected < 1e-15 < 1e-8 < plain
    assert ends[1]["q"].unit == start["q"].unit
