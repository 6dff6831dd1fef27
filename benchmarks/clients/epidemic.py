"""stochastix: susceptible, infected and recovered people. `MeanFieldModel(network, solver)` takes
an instance, and fixes the relative tolerance at 1e-3.

The sum of the people is linear, so Runge-Kutta methods keep it by themselves. What they do not keep
is the relation of the final size, I + S - (recovery / infection) log S.
"""

import diffrax as dfx
import jax.numpy as jnp
import stochastix as stx
from client import Client

import diffrax_conserve as dfc

PEOPLE, INFECTION, RECOVERY = 1e6, 0.3, 0.1
network = stx.ReactionNetwork(
    [
        stx.Reaction("S + I -> 2 I", stx.kinetics.MassAction(INFECTION / PEOPLE)),
        stx.Reaction("I -> R", stx.kinetics.MassAction(RECOVERY)),
    ]
)
at = {name: network.species.index(name) for name in "SIR"}
start = jnp.zeros(3).at[at["S"]].set(PEOPLE - 10).at[at["I"]].set(10.0)


def final_size(t, y, args):
    susceptible, infected = y[at["S"]], y[at["I"]]
    return infected + susceptible - RECOVERY / INFECTION * PEOPLE * jnp.log(susceptible / PEOPLE)


laws = {
    "people": dfc.FirstIntegral(lambda t, y, args: jnp.sum(y)),
    "final size": dfc.FirstIntegral(final_size),
}


def client(smoke=False):
    ts = jnp.linspace(0.0, 50.0 if smoke else 200.0, 101)

    def run(solver, tolerance):
        del tolerance  # which the package fixes
        model = stx.MeanFieldModel(network, solver, T=ts[-1], saveat_steps=ts)
        return lambda: model(None, start).x

    def exact():
        controller = dfx.PIDController(rtol=1e-13, atol=1e-10)
        return dfx.diffeqsolve(
            dfx.ODETerm(network.vector_field), dfx.Dopri8(), 0.0, ts[-1], None, start,
            saveat=dfx.SaveAt(ts=ts), stepsize_controller=controller,
        ).ys  # fmt: skip

    return Client(
        package="stochastix", problem="an epidemic, its sum and its final size",
        solver=dfx.Dopri5(), manifold=laws, tolerance=1e-3, ts=ts, run=run,
        field=network.vector_field, y0=start, exact=exact,
    )  # fmt: skip
