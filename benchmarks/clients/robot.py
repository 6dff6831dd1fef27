"""soromox: an arm of two links with elastic joints, without damping. `rollout_to(solver=...)`
takes an instance.

soromox passes a state to diffrax in which parts are `None`: those of a controller and of an
environment.
"""

import diffrax as dfx
import jax.numpy as jnp
from client import Client
from soromox.systems import Pendulum, PendulumParams, SystemState

import diffrax_conserve as dfc

LINKS = 2
robot = Pendulum(
    PendulumParams(
        gravity=jnp.array([0.0, -9.81]),
        mass=jnp.ones(LINKS),
        joint_stiffness=20 * jnp.eye(LINKS),
        joint_damping=jnp.zeros((LINKS, LINKS)),
        joint_rest_configuration=jnp.zeros(LINKS),
        moment_inertia=jnp.full(LINKS, 1 / 12),
        length=jnp.ones(LINKS),
        center_of_mass_length=jnp.full(LINKS, 0.5),
        radius=jnp.full(LINKS, 0.05),
    )
)
start = SystemState(t=jnp.array(0.0), y=jnp.array([0.3, 0.5, 0.0, 0.0]))


def energy(t, y, args):
    """Of a state as it is in the loop; what `rollout_to` returns is its array alone."""
    return robot.total_energy(*jnp.split(getattr(y, "y", y), 2))


def client(smoke=False):
    ts = jnp.linspace(0.0, 1.0 if smoke else 20.0, 101)

    def run(solver, tolerance):
        controller = dfx.PIDController(rtol=tolerance, atol=tolerance)
        return lambda: robot.rollout_to(
            start, t1=ts[-1], save_ts=ts, solver_dt=1e-3, solver=solver,
            stepsize_controller=controller, max_steps=1_000_000,
        ).y  # fmt: skip

    return Client(
        package="soromox", problem="an elastic arm of two links", solver=dfx.Tsit5(),
        manifold={"energy": dfc.FirstIntegral(energy)}, tolerance=1e-6, ts=ts, run=run,
        field=lambda t, y, args: robot.forward_dynamics(t, y, (jnp.zeros(LINKS),)), y0=start.y,
        quantities=lambda ys: tuple(jnp.split(ys, 2, axis=1)),
    )  # fmt: skip
