"""essos: the guiding centre of an ion between two coils, in SI units. `Tracing(solver=...)` takes
an instance, and stops at an event.

The magnetic moment is constant, and so is the canonical angular momentum about the axis of the
coils. The state holds metres and metres per second, and both have one absolute tolerance.
"""

import diffrax as dfx
import jax
import jax.numpy as jnp
from client import Client
from essos.coils import Coils, Curves
from essos.dynamics import GuidingCenter, Particles, Tracing
from essos.electric_field import Electric_field_zero
from essos.fields import BiotSavart

import diffrax_conserve as dfc

# The Fourier coefficients of x, y and z: a circle about the axis, at two heights.
circle = jnp.zeros((3, 3)).at[0, 2].set(1.0).at[1, 1].set(1.0)
curves = Curves(
    jnp.stack([circle.at[2, 0].set(z) for z in (-1.0, 1.0)]), n_segments=100, stellsym=False
)
coils = Coils(curves, jnp.array([1e6, 1e6]))
magnetic = BiotSavart(coils)
ions = Particles(
    initial_xyz=jnp.array([[0.2, 0.0, 0.0]]), initial_vparallel_over_v=jnp.array([0.5]),
    field=magnetic, energy=5.6e-15,
)  # fmt: skip
args = magnetic, ions, Electric_field_zero()


def moment(t, y, args):
    return (ions.energy - ions.mass * y[3] ** 2 / 2) / magnetic.AbsB(y[:3])


laws = {"moment": dfc.FirstIntegral(moment)}


def traced(solver, tolerance, seconds, times, xyz=ions.initial_xyz, **options):
    particles = Particles(
        initial_xyz=xyz, initial_vparallel_over_v=ions.initial_vparallel_over_v, field=magnetic,
        energy=ions.energy,
    )  # fmt: skip
    return Tracing(
        field=coils, model="GuidingCenterAdaptative", particles=particles, maxtime=seconds,
        times_to_trace=times, timestep=1e-8, rtol=tolerance, atol=tolerance, solver=solver,
        progress=False, **options,
    )  # fmt: skip


def client(smoke=False):
    seconds = 1e-5 if smoke else 2e-4
    ts = jnp.linspace(0.0, seconds, 101)

    def run(solver, tolerance):
        # `Tracing` compiles anew at each call, unless it is compiled itself.
        states = jax.jit(
            lambda xyz: traced(solver, tolerance, seconds, ts.size, xyz).trajectories[0]
        )
        return lambda: states(ions.initial_xyz)

    return Client(
        package="essos", problem="a guiding centre between two coils, SI", solver=dfx.Dopri8(),
        manifold=laws, tolerance=1e-7, ts=ts, run=run, args=args,
        field=lambda t, y, args: GuidingCenter(t, y, args),
        y0=jnp.append(ions.initial_xyz[0], ions.initial_vparallel[0]),
        quantities=lambda ys: (ys[:, :3], ys[:, 3:]),
    )  # fmt: skip
