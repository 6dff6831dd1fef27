"""What the paper says of its figures, measured on the networks of its recipe.

    python benchmarks/studies/claims.py  # the shipped networks; prints a few numbers for each claim

Its claims are about one solution of each system: here that from the catalogue's initial state.
"""

import argparse
import json

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import diffrax_conserve as dfc
from diffrax_conserve import reproduce as _reproduce

jax.config.update("jax_enable_x64", True)


def networks(name):
    return {kind: dfc.load_pretrained(f"{name}-{kind}") for kind in ("standard", "conservative")}


def rollout(system, solver, y0):
    """The states after each of the system's steps."""
    steps = round(system.t1 / system.dt)
    solution = dfx.diffeqsolve(
        dfx.ODETerm(system.vector_field), solver, 0.0, system.t1, system.dt, y0,
        saveat=dfx.SaveAt(t0=True, steps=True), max_steps=steps + 2, throw=False,
    )  # fmt: skip
    return solution.ts[: steps + 1], solution.ys[: steps + 1]


def rollouts(system, y0=None):
    y0 = system.y0 if y0 is None else y0
    solvers = _reproduce.learned_solvers(system, networks(system.name)) | {"rk4": dfc.RK4()}
    return {name: rollout(system, solver, y0) for name, solver in solvers.items()}


def integral(system, name, ys):
    return jax.vmap(lambda y: system.manifold[name].fn(0.0, y, None))(ys)


def oscillator():
    """Energy against time, in units of that at the start."""
    system = dfc.systems.get("harmonic-oscillator")
    found = {}
    for name, (ts, ys) in rollouts(system).items():
        energy = integral(system, "energy", ys)
        found[name] = {
            f"t = {float(ts[i]):g}": float(energy[i] / energy[0]) for i in range(0, len(ts), 24)
        }
    return found


def rigid_body():
    """How far the state after one period is from the initial one."""
    system = dfc.systems.get("rigid-body")
    period = system.period()
    found = {}
    for name, network in networks(system.name).items():
        ts = jnp.linspace(0.0, system.t1, 701)
        ys = jax.vmap(network)(ts)
        late = jax.vmap(network)(jnp.linspace(period, system.t1, 300))
        gap = jnp.min(jnp.linalg.norm(late[:, None] - ys[None, :400], axis=-1), axis=1)
        found[name] = {
            "after one period, from the start": float(jnp.linalg.norm(network(period) - ys[0])),
            "from its own first turn, largest": float(jnp.max(gap)),
            "largest relative change of H": change(system, "energy", ys),
            "and of L": change(system, "squared angular momentum", ys),
        }
    return found


def change(system, name, ys):
    values = integral(system, name, ys)
    return float(jnp.max(jnp.abs(values / values[0] - 1)))


def pendulum():
    """The energy of 20 solutions, less that at the start, after 5, 10, 15 and 20 steps."""
    system = dfc.systems.get("double-pendulum")
    solver = dfc.DeepONetSolver(networks(system.name)["standard"])
    y0s = _reproduce.initial_states(system)
    _, ys = jax.vmap(lambda y0: rollout(system, solver, y0))(y0s)
    energy = jax.vmap(lambda path: integral(system, "energy", path))(ys)
    drift = np.asarray(energy - energy[:, :1])
    ends = drift[:, [5, 10, 15, 20]]
    return {
        "median": np.median(ends, axis=0).tolist(),
        "median size": np.median(np.abs(ends), axis=0).tolist(),
        "share that lose energy": np.mean(ends < 0, axis=0).tolist(),
        "lowest energy of all, less that at rest": float(np.min(energy[:, 0]) + 3 * 9.81),
    }


def lorenz():
    """How large the orbit is in each fifth of the time, and how nearly it closes in the last."""
    system = dfc.systems.get("conservative-lorenz")
    found = {}
    for name, (_, ys) in rollouts(system).items():
        size = np.asarray(jnp.linalg.norm(ys[:, :2], axis=1))
        last = np.asarray(ys[400:])
        distances = np.linalg.norm(last[:, None] - last[None], axis=-1)
        returns = [np.min(row[i + 20 :]) for i, row in enumerate(distances[:50])]
        found[name] = {
            "largest |(x, y)| in each fifth": [float(s.max()) for s in np.split(size[1:], 5)],
            "median distance at the closest return": float(np.median(returns)),
            "largest relative change of H": change(system, "Casimir", ys),
            "and of L": change(system, "energy", ys),
        }
    return found


def vortices():
    """Until when a solution is within 0.1, 0.5 and 1 of that of RK4, and of the reference."""
    system = dfc.systems.get("point-vortices")
    found = {}
    runs = rollouts(system)
    ts, rk4 = runs["rk4"]
    for name, (_, ys) in runs.items():
        found[name] = {
            label: [until(ts, ys, other, bound) for bound in (0.1, 0.5, 1.0)]
            for label, other in (("RK4", rk4), ("reference", system.reference(ts)))
        }
    return found


def until(ts, ys, other, bound):
    distance = np.asarray(jnp.linalg.norm((ys - other).reshape(len(ts), -1), axis=1))
    return float(ts[np.argmax(distance > bound)] if np.any(distance > bound) else ts[-1])


CLAIMS = {
    "oscillator: damped by the standard network": oscillator,
    "rigid body: orbit of the standard network not closed": rigid_body,
    "pendulum: systematic drift of the standard network": pendulum,
    "Lorenz: the standard network moves outward to an almost closed orbit": lorenz,
    "vortices: the conservative network follows RK4": vortices,
}


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="claims that hold this text")
    parser.add_argument("--smoke", action="store_true", help="one claim")
    options = parser.parse_args(argv)
    only = "oscillator" if options.smoke else options.only
    found = {name: measure() for name, measure in CLAIMS.items() if only in name}
    print(json.dumps(found, indent=1))
    return found


if __name__ == "__main__":
    main()
