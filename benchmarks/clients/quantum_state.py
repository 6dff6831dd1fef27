"""dynamiqs: an anharmonic oscillator, driven. A method is looked up by its class.

`sesolve(method=dq.method.Tsit5())` finds the solver in a table of `functools.partial`s. Their
keywords are a dictionary, in which another solver can stand. What was compiled before knows nothing
of it, so the compiled functions must be forgotten.
"""

from unittest import mock

import dynamiqs as dq
import jax
import jax.numpy as jnp
from client import Client
from dynamiqs.integrators.core import diffrax_integrator

import diffrax_conserve as dfc

dq.set_precision("double")
dq.set_progress_meter(False)

lower = dq.destroy(8)
hamiltonian = lower.dag() @ lower.dag() @ lower @ lower * 0.5 + (lower + lower.dag()) * 1.0
start = dq.coherent(8, 0.5)


def square(t, y, args):
    return jnp.sum(jnp.abs(y.to_jax()) ** 2)


def energy(t, y, args):
    y = y.to_jax()
    return jnp.vdot(y, hamiltonian.to_jax() @ y).real


def field(t, y, args):
    return -1j * hamiltonian @ y


def client(smoke=False):
    ts = jnp.linspace(0.0, 5.0 if smoke else 50.0, 101)
    keywords = diffrax_integrator.sesolve_tsit5_integrator_constructor.keywords
    current = [None]

    def run(solver, tolerance):
        method = dq.method.Tsit5(rtol=tolerance, atol=tolerance)

        def states():
            if current[0] is not solver:
                jax.clear_caches()
                current[0] = solver
            with mock.patch.dict(keywords, diffrax_solver=solver):
                return dq.sesolve(hamiltonian, start, ts, method=method).states

        return states

    def exact():
        values, vectors = jnp.linalg.eigh(hamiltonian.to_jax())
        turned = jnp.exp(-1j * ts[:, None] * values) * (vectors.conj().T @ start.to_jax())[:, 0]
        return dq.asqarray((turned @ vectors.T)[..., None])

    return Client(
        package="dynamiqs", problem="a state of eight levels", solver=keywords["diffrax_solver"],
        manifold={"norm": dfc.FirstIntegral(square), "energy": dfc.FirstIntegral(energy)},
        tolerance=1e-6, ts=ts, run=run, field=field, y0=start, exact=exact,
        quantities=lambda ys: ys.to_jax(),
    )  # fmt: skip
