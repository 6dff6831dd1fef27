"""jaxquantum: a driven, damped oscillator of eight levels. A solver is asked for by its name.

`SolverOptions.create(solver="Tsit5")` becomes `getattr(diffrax, "Tsit5")()`, so while another
solver has a name in `diffrax`, it can be asked for by that name.
"""

from unittest import mock

import diffrax as dfx
import jax
import jax.numpy as jnp
import jaxquantum as jqt
from client import Client

import diffrax_conserve as dfc

lower = jqt.destroy(8)
raise_ = lower.dag()
hamiltonian = (lower + raise_) * 0.5 + raise_ @ raise_ @ lower @ lower * 0.5
losses = jqt.Qarray.from_list([jnp.sqrt(0.5) * lower])
ground = jqt.basis(8, 0).to_dm()
trace = dfc.Constraint(lambda t, rho, args: jnp.trace(rho).real - 1)


def field(t, rho, args):
    """What `mesolve` passes to diffrax."""
    H, L = hamiltonian.data, losses.data[0]
    decay = L.conj().T @ L @ rho
    commutator = -1j * (H @ rho - rho @ H)
    return commutator + L @ rho @ L.conj().T - (decay + decay.conj().T) / 2


def client(smoke=False):
    ts = jnp.linspace(0.0, 2.0 if smoke else 20.0, 101)

    def run(solver, tolerance):
        options = jqt.SolverOptions.create(
            progress_meter=False, solver="Kept", rtol=tolerance, atol=tolerance / 100
        )

        @jax.jit
        def states(rho):
            with mock.patch.object(dfx, "Kept", create=True, return_value=solver):
                rho = jqt.Qarray.create(rho)
                solved = jqt.mesolve(hamiltonian, rho, ts, c_ops=losses, solver_options=options)
            return solved.data

        return lambda: states(ground.data)

    return Client(
        package="jaxquantum", problem="a density matrix of eight levels", solver=dfx.Tsit5(),
        manifold={"trace": trace}, projection=dfc.closed_forms.density_matrix(), tolerance=1e-4,
        ts=ts, run=run, field=field, y0=ground.data,
    )  # fmt: skip
