"""bijx: a continuous normalizing flow on the sphere, of 200 points. `DiffraxConfig(solver=...)`
takes an instance, for the inverse too.

The state is the points and the logarithms of their densities. All points are one state, so there
are 200 constraints, each a closed form.
"""

import bijx
import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.random as jr
from client import Client
from flax import nnx

import diffrax_conserve as dfc

POINTS = 200


class Tangential(nnx.Module):
    """A network whose output is projected to the tangent plane of the sphere."""

    def __init__(self):
        first, second = jr.split(jr.key(0))
        self.first = nnx.Param(jr.normal(first, (4, 16)))
        self.second = nnx.Param(jr.normal(second, (16, 3)))

    def velocity(self, t, x):
        time = jnp.full((*x.shape[:-1], 1), t)
        v = jnp.tanh(jnp.concatenate([x, time], axis=-1) @ self.first) @ self.second
        return v - jnp.sum(v * x, axis=-1, keepdims=True) * x

    def divergence(self, t, x):
        outward = lambda x: self.velocity(t, x / jnp.linalg.norm(x))  # noqa: E731
        return jnp.trace(jax.jacfwd(outward)(x))

    def __call__(self, t, x):
        divergence = jnp.vectorize(self.divergence, signature="(),(n)->()")
        return self.velocity(t, x), -divergence(t, x)


sphere = dfc.Constraint(lambda t, y, args: jnp.sum(y[0] ** 2, axis=-1) - 1)
network = Tangential()


def start(points):
    x = jr.normal(jr.key(1), (points, 3))
    return x / jnp.linalg.norm(x, axis=1, keepdims=True), jnp.zeros(points)


@nnx.jit(static_argnames="inverse")
def moved(flow, y, inverse):
    return (flow.reverse if inverse else flow.forward)(*y)


def flow(solver, tolerance, saveat=None):
    controller = dfx.PIDController(rtol=tolerance, atol=tolerance)
    saveat = dfx.SaveAt(t1=True) if saveat is None else saveat
    config = bijx.DiffraxConfig(solver=solver, stepsize_controller=controller, saveat=saveat)
    return bijx.ContFlowDiffrax(network, config)


def client(smoke=False):
    ts, y0 = jnp.linspace(0.0, 1.0, 11), start(10 if smoke else POINTS)
    solved = nnx.jit(lambda flow, y: flow.solve_flow(*y).ys)

    def run(solver, tolerance):
        through = flow(solver, tolerance, dfx.SaveAt(ts=ts))
        return lambda: solved(through, y0)

    return Client(
        package="bijx", problem="a flow of 200 points on the sphere", solver=dfx.Tsit5(),
        manifold={"sphere": sphere}, projection=dfc.closed_forms.unit_vector(lambda y: y[0]),
        tolerance=1e-4, ts=ts, run=run, field=lambda t, y, args: network(t, y[0]), y0=y0,
    )  # fmt: skip
