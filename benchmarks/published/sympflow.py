"""I: SympFlow, a symplectic network that learns a flow map from the equations (arXiv:2412.16787).

Hénon-Heiles in steps of 1: trained on states of [-1, 1]^4 and times in [-0.1, 1], followed from
(0.3, -0.3), (0.3, 0.15) to t = 100, and its energy to t = 1,000. The paper shows figures, and no
error as a number. So their network is trained here, by us after their description: three pairs of
shears by the gradients of potentials with two layers of 10 tanh, 700 new points in each of 5,000
epochs, Adam at 5e-3 with clipped gradients, the loss of the equations and that of the Hamiltonian
of the network (their "hamReg"), in float32. They keep the best network of the last epochs, we the
last.

Ours is a `DeepONet`, trained by default on 1,000 states of the same box, in a `ManifoldProjection`
on the energy. Beside both RK4 and Dopri8 without a network. The reference is Dopri8 at 1e-13.
"""

import functools
import time

import common
import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
from julia_energy import henon_heiles, henon_heiles_force

import diffrax_conserve as dfc

SOURCE = "P. Canizares et al., arXiv:2412.16787; github.com/davidemurari/sympflow, commit 58019f4"
SEEDS, EPOCHS, POINTS = (0, 1, 2), 5000, 700
Y0 = jnp.array([0.3, -0.3, 0.3, 0.15])


def hamiltonian(y):
    return jnp.sum(y[2:] ** 2) / 2 + henon_heiles(y[0], y[1])


def field(t, y, args):
    return jnp.stack([y[2], y[3], *henon_heiles_force(y[0], y[1])])


ENERGY = dfc.FirstIntegral(lambda t, y, args: hamiltonian(y))


class SympFlow(eqx.Module):
    """Shears of the momenta by potentials of place and time, and of the places by others."""

    of_q: list
    of_p: list
    max_step: float = 1.0

    def __init__(self, key):
        nets = [eqx.nn.MLP(3, "scalar", 10, 2, jnp.tanh, key=k) for k in jr.split(key, 6)]
        self.of_q, self.of_p = nets[:3], nets[3:]

    def __call__(self, y, t):
        q, p = y[:2], y[2:]
        for of_q, of_p in zip(self.of_q, self.of_p, strict=True):
            p = p - shear(of_q, q, t)
            q = q + shear(of_p, p, t)
        return jnp.concatenate([q, p])

    def energy(self, y, t):
        """The Hamiltonian whose flow this is: the rates of all potentials, pulled back."""
        q, p, total = y[:2], y[2:], 0.0
        for of_q, of_p in zip(self.of_q[::-1], self.of_p[::-1], strict=True):
            total += jax.grad(potential, 2)(of_p, p, t)
            q = q - shear(of_p, p, t)
            total += jax.grad(potential, 2)(of_q, q, t)
            p = p + shear(of_q, q, t)
        return total


def potential(net, x, t):
    return net(jnp.append(x, t))


def shear(net, x, t):
    slope = jax.grad(potential, 1)
    return slope(net, x, t) - slope(net, x, jnp.zeros_like(t))


def trained(seed, epochs):
    """A SympFlow after so many epochs."""
    single = jnp.float32
    model = jax.tree.map(
        lambda x: x.astype(single) if eqx.is_inexact_array(x) else x, SympFlow(jr.key(seed))
    )
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(5e-3))

    def loss(model, key):
        def one(y, t):
            end, slope = jax.jvp(lambda t: model(y, t), (t,), (jnp.ones_like(t),))
            off = model.energy(y, t) - hamiltonian(y)
            return jnp.sum((slope - field(t, end, None)) ** 2) + off**2

        ys = jr.uniform(key, (POINTS, 4), single, minval=-1.0)
        ts = jr.uniform(jr.fold_in(key, 1), (POINTS,), single, minval=-0.1, maxval=1.0)
        return jnp.mean(jax.vmap(one)(ys, ts))

    @eqx.filter_jit
    def train(arrays, static):
        def epoch(carry, key):
            arrays, state = carry
            slope = eqx.filter_grad(loss)(eqx.combine(arrays, static), key)
            update, state = optimiser.update(slope, state)
            return (eqx.apply_updates(arrays, update), state), None

        keys = jr.split(jr.key(seed + 100), epochs)
        return jax.lax.scan(epoch, (arrays, optimiser.init(arrays)), keys)[0][0]

    arrays, static = eqx.partition(model, eqx.is_inexact_array)
    return eqx.combine(train(arrays, static), static)


@eqx.filter_jit
def solve(solver, dt, t1):
    return dfx.diffeqsolve(
        dfx.ODETerm(field), solver, 0.0, t1, dt, Y0,
        saveat=dfx.SaveAt(ts=jnp.arange(0, t1 + 1)), max_steps=100_000, throw=False,
    )  # fmt: skip


def measure(smoke):
    rows, t1 = [], 100 if smoke else 1000
    tight = dfx.PIDController(rtol=1e-13, atol=1e-13)
    saveat = dfx.SaveAt(ts=jnp.arange(0, 101.0))
    exact = dfx.diffeqsolve(
        dfx.ODETerm(field), dfx.Dopri8(), 0, 100, None, Y0, stepsize_controller=tight, saveat=saveat
    ).ys

    def row(program, solver, dt=1.0, training=None, seed=None):
        ys = solve(solver, dt, t1).ys
        error = float(jnp.max(jnp.linalg.norm(ys[:101] - exact, axis=1)))
        off = float(jnp.max(jnp.abs(jax.vmap(hamiltonian)(ys) - hamiltonian(Y0))))
        seconds = common.timed({0: lambda: solve(solver, dt, t1).ys}, smoke)[0]
        found = dict(program=program, seed=seed, training=training, error=error, energy=off)
        rows.append(found | dict(seconds=seconds))
        common.show(rows[-1])

    keep = functools.partial(dfc.ManifoldProjection, manifold=ENERGY)
    for seed in SEEDS[: 1 if smoke else None]:
        begin = time.process_time()
        model = trained(seed, 20 if smoke else EPOCHS)
        spent = time.process_time() - begin
        row("SympFlow", dfc.DeepONetSolver(model, check_field=False), training=spent, seed=seed)
        begin = time.process_time()
        states = jr.uniform(jr.key(seed), (1000, 4), minval=-1.0)
        ours = dfc.DeepONet(states, 1.0, key=jr.key(seed + 10))
        recipe = dfc.learned.second_order(ours, epochs=4 if smoke else None)
        ours, _ = dfc.fit(ours, field, sample=states, key=jr.key(seed + 100), recipe=recipe)
        spent = time.process_time() - begin
        row("ours, plain", dfc.DeepONetSolver(ours), training=spent, seed=seed)
        row("ours, projected", keep(dfc.DeepONetSolver(ours)), training=spent, seed=seed)
    row("RK4, 4 steps, projected", keep(dfc.RK4()), 0.25)
    row("Dopri8, 1 step", dfx.Dopri8())
    row("Dopri8, 1 step, projected", keep(dfx.Dopri8()))
    return dict(source=SOURCE, rows=rows)


# ---- The page ----


def medians(results):
    """Over the seeds, by program."""
    groups = {}
    for row in results["rows"]:
        groups.setdefault(row["program"], []).append(row)
    columns = ("error", "energy", "seconds", "training")
    for program, rows in groups.items():
        known = {c: [x[c] for x in rows if x[c] is not None] for c in columns}
        yield program, {c: float(np.median(x)) if x else None for c, x in known.items()}


def table(results):
    heads = (
        "program",
        "error to t = 100",
        "energy to t = 1,000",
        "s for 1,000 steps",
        "training, s",
    )
    return common.markdown(heads, ((name, *row.values()) for name, row in medians(results)))


def verdicts(results):
    found, row = dict(medians(results)), "SympFlow, henon-heiles"
    ours, theirs = found["ours, projected"], found["SympFlow"]
    for what in ("error", "energy", "training", "seconds"):
        yield common.Verdict(row, what, "SympFlow", theirs[what], ours[what])
    for what in ("error", "seconds"):
        plain = found["Dopri8, 1 step, projected"]
        yield common.Verdict(row, what, "Dopri8, projected, no network", plain[what], ours[what])


def main(argv=None):
    return common.main("sympflow", __doc__, measure, argv, seed=SEEDS)


if __name__ == "__main__":
    main()
