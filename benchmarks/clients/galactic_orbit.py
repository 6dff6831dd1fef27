"""galax: a star in the Milky Way for 10 Gyr. `OrbitSolver` takes an instance of a solver.

galax strips its quantities of their units before it calls diffrax, so the functions that are kept
see a tuple of arrays, in kpc and kpc / Myr. A batch of stars is one state.
"""

import diffrax as dfx
import galax.coordinates as gc
import galax.dynamics as gd
import galax.potential as gp
import jax.numpy as jnp
import unxt as u
from client import Client

import diffrax_conserve as dfc

galaxy = gp.MilkyWayPotential()
field = gd.fields.HamiltonianField(galaxy)


def energy(t, y, args):
    q, p = y
    return jnp.sum(p**2, axis=-1) / 2 + galaxy._potential(q, t)


def about_the_axis(t, y, args):
    q, p = y
    return q[..., 0] * p[..., 1] - q[..., 1] * p[..., 0]


laws = {"energy": dfc.FirstIntegral(energy), "L_z": dfc.FirstIntegral(about_the_axis)}
star = gc.PhaseSpaceCoordinate(
    q=u.Q([8.0, 0.0, 1.0], "kpc"), p=u.Q([30.0, 180.0, 60.0], "km/s"), t=u.Q(0.0, "Myr")
)


def orbit_solver(solver, tolerance):
    controller = dfx.PIDController(rtol=tolerance, atol=tolerance)
    return gd.OrbitSolver(solver, stepsize_controller=controller)


def client(smoke=False):
    ts = jnp.linspace(0.0, 1_000.0 if smoke else 10_000.0, 101)
    times = u.Q(ts, "Myr")

    def run(solver, tolerance):
        door = orbit_solver(solver, tolerance)
        return lambda: door.solve(field, star, times[-1], saveat=times).ys

    return Client(
        package="galax", problem="a star in the Milky Way, 10 Gyr", solver=dfx.Dopri8(),
        manifold=laws, tolerance=1e-8, ts=ts, run=run, field=field,
        y0=orbit_solver(dfx.Dopri8(), 1e-8).init(field, star, None).y,
    )  # fmt: skip
