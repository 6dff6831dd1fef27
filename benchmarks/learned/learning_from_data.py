"""Vector fields and integrals that are learned from trajectories, projected and not.

    python benchmarks/learned/learning_from_data.py  # writes results/learning_from_data.json
    python benchmarks/learned/learning_from_data.py --smoke  # toy sizes; a minute of compilation

Known integrals, the rigid body: a neural vector field is fitted to short pieces of trajectories,
exact or with noise, through plain solves and through projected ones. Unknown integral, the
Lotka-Volterra model: a network that hardly varies along each trajectory is fitted too, and solves
with the learned and with the true vector field are projected on it.

The judges are 20 other initial states from the same domain. The error is the Euclidean norm, the
drift that of the true integrals, the largest over the solve; medians over the states, then over
the seeds.
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax

import diffrax_conserve as dfc

OUT = Path(__file__).parent.parent / "results" / "learning_from_data.json"
# With moments five times the paper's, so that it turns by less than one radian between two data.
BODY = dfc.systems.RigidBody(inertia=(0.5, 1.0, 1.5))
PREY = dfc.systems.get("lotka-volterra")
SPACING = 0.1  # of the data, and the step of the solves in the training
PIECE = 5  # intervals
WRAPS = {"plain": lambda solver: solver, "projected": lambda s: projected(s, BODY.manifold)}


@dataclasses.dataclass(frozen=True)
class Size:
    seeds: tuple[int, ...] = (0, 1, 2)
    noises: tuple[float, ...] = (0.0, 0.01)
    trajectories: int = 50
    body_iterations: int = 200
    integral_iterations: int = 500
    prey_iterations: int = 200
    judges: int = 20
    marks: tuple[int, ...] = (5, 20, 50)
    trainings: tuple[str, ...] = ("plain", "projected")
    solves: tuple[str, ...] = ("learned field", "Euler, 0.02", "Heun, 0.1", "RK4, 0.1")


SMOKE = Size(
    seeds=(0,),
    noises=(0.01,),
    trajectories=4,
    body_iterations=2,
    integral_iterations=2,
    prey_iterations=2,
    judges=2,
    marks=(1, 2),
    trainings=("plain",),
    solves=("learned field",),
)


class Network(eqx.Module):
    """A function of `(t, y, args)` that is a network of `y`."""

    net: eqx.nn.MLP

    def __init__(self, outputs, inputs, key):
        self.net = eqx.nn.MLP(inputs, outputs, 32, 2, jnp.tanh, key=key)

    def __call__(self, t, y, args):
        return self.net(y)


def projected(solver, manifold):
    return dfc.ManifoldProjection(solver, manifold, projection=dfc.Newton())


def solve(field, solver, y0, times, step=SPACING):
    return dfx.diffeqsolve(
        dfx.ODETerm(field),
        solver,
        t0=0.0,
        t1=times[-1],
        dt0=step,
        y0=y0,
        saveat=dfx.SaveAt(ts=times),
        throw=False,
    )


def grid(t1):
    return SPACING * jnp.arange(round(t1 / SPACING) + 1)


def prey_state(key):
    return jr.uniform(key, (2,), minval=jnp.array([0.5, 1.0]), maxval=jnp.array([2.0, 3.0]))


def observe(system, sample, key, count, t1, noise=0.0):
    state_key, noise_key = jr.split(key)
    y0s = jax.vmap(sample)(jr.split(state_key, count))
    ys = jax.vmap(lambda y0: system.reference(grid(t1), y0))(y0s)
    return ys + noise * jr.normal(noise_key, ys.shape)


def pieces(ys):
    starts = range(0, ys.shape[1] - PIECE, PIECE)
    return jnp.concatenate([ys[:, i : i + PIECE + 1] for i in starts])


def misfit(field, solver, data):
    times = grid(PIECE * SPACING)
    ys = jax.vmap(lambda piece: solve(field, solver, piece[0], times).ys)(data)
    return jnp.mean((ys - data) ** 2)


def plain_misfit(field, data):
    return misfit(field, WRAPS["plain"](dfc.RK4()), data)


def projected_misfit(field, data):
    return misfit(field, WRAPS["projected"](dfc.RK4()), data)


def variation(integral, data):
    """The variance along trajectories over that of all the data."""
    values = jax.vmap(jax.vmap(lambda y: integral(0.0, y, None)))(data)
    return jnp.mean(jnp.var(values, axis=1)) / jnp.var(values)


@eqx.filter_jit
def minimise(loss, model, data, iterations):
    weights, static = eqx.partition(model, eqx.is_inexact_array)
    optimiser = optax.lbfgs(memory_size=20)

    def value(weights):
        return loss(eqx.combine(weights, static), data)

    def iteration(carry, _):
        weights, state = carry
        found, gradient = optax.value_and_grad_from_state(value)(weights, state=state)
        updates, state = optimiser.update(
            gradient, state, weights, value=found, grad=gradient, value_fn=value
        )
        return (optax.apply_updates(weights, updates), state), found

    start = weights, optimiser.init(weights)
    (weights, _), losses = jax.lax.scan(iteration, start, length=iterations)
    return eqx.combine(weights, static), losses[-1]


def trained(loss, model, data, iterations):
    start = time.process_time()
    model, last = jax.block_until_ready(minimise(loss, model, data, iterations))
    return model, {"loss": float(last), "seconds": time.process_time() - start}


@eqx.filter_jit
def judge(system, field, solver, step, exact):
    times = SPACING * jnp.arange(exact.shape[1])
    solutions = jax.vmap(lambda y0: solve(field, solver, y0, times, step))(exact[:, 0])
    errors = jnp.linalg.norm(solutions.ys - exact, axis=-1)
    drifts = jax.vmap(lambda sol: dfc.drift(sol, system.manifold))(solutions)
    largest = jnp.max(jnp.stack([jnp.abs(d) for d in drifts.values()]), axis=(0, 2))
    return errors, largest, solutions.result == dfx.RESULTS.successful


def row(system, field, solver, step, exact, marks):
    errors, drifts, okay = map(np.asarray, judge(system, field, solver, step, exact))
    errors = np.where(np.isfinite(errors), errors, np.inf)
    at = [round(t / SPACING) for t in marks]
    return {
        "error": dict(zip(map(str, marks), np.median(errors[:, at], axis=0).tolist(), strict=True)),
        "largest error": float(errors.max()),
        "drift": float(np.median(drifts)),
        "failed": int(np.sum(~okay)),
    }


def known_integrals(seed, noise, size):
    data_key, net_key = jr.split(jr.key(seed))
    data = pieces(observe(BODY, BODY.sample, data_key, size.trajectories, 1.0, noise))
    exact = observe(BODY, BODY.sample, jr.key(100), size.judges, size.marks[-1])
    found = {}
    for training in size.trainings:
        loss = {"plain": plain_misfit, "projected": projected_misfit}[training]
        start = Network(3, 3, net_key)
        field, log = trained(loss, start, data, size.body_iterations)
        rows = {
            name: row(BODY, field, wrap(dfx.Tsit5()), SPACING, exact, size.marks)
            for name, wrap in WRAPS.items()
        }
        found[training] = {"training": log, "solved": rows}
        show(f"noise {noise}, seed {seed}, trained {training}, {log}", rows)
    return found


def unknown_integral(seed, size):
    data_key, net_key, integral_key = jr.split(jr.key(seed), 3)
    data = observe(PREY, prey_state, data_key, size.trajectories, 5.0)
    exact = observe(PREY, prey_state, jr.key(100), size.judges, size.marks[-1])
    integral, log = trained(
        variation, Network("scalar", 2, integral_key), data, size.integral_iterations
    )
    field, field_log = trained(
        plain_misfit, Network(2, 2, net_key), pieces(data), size.prey_iterations
    )
    found = {"training": {"integral": log, "field": field_log}}
    learned = {"learned": dfc.FirstIntegral(integral)}
    solves = {
        "learned field": (field, dfx.Tsit5(), 0.1),
        "Euler, 0.02": (PREY.vector_field, dfx.Euler(), 0.02),
        "Heun, 0.1": (PREY.vector_field, dfx.Heun(), 0.1),
        "RK4, 0.1": (PREY.vector_field, dfc.RK4(), 0.1),
    }
    for name in size.solves:
        f, solver, step = solves[name]
        wraps = {
            "plain": solver,
            "learned integral": projected(solver, learned),
            "true integral": projected(solver, PREY.manifold),
        }
        found[name] = {
            kind: row(PREY, f, wrapped, step, exact, size.marks) for kind, wrapped in wraps.items()
        }
        show(f"seed {seed}, {name}", found[name])
    return found


def show(title, rows):
    print(title)
    for name, found in rows.items():
        errors = ", ".join(f"{e:.1e} at {t}" for t, e in found["error"].items())
        print(
            f"  {name}: {errors}, largest {found['largest error']:.1e}, "
            f"drift {found['drift']:.1e}, failed {found['failed']}",
            flush=True,
        )


def median(runs):
    """Nested dictionaries, one for each seed, as one of medians, in the same order."""
    if isinstance(runs[0], dict):
        return {key: median([run[key] for run in runs]) for key in runs[0]}
    return float(np.median(runs))


def table(found):
    """The lines of the tables that the documentation shows."""
    marks = list(next(iter(found["unknown"].values()))["plain"]["error"])
    head = " | ".join(f"error, t = {t}" for t in marks)
    yield f"| noise | trained, solved | {head} | largest | drift |"
    yield "|---|---|" + "---|" * (len(marks) + 2)
    for noise, trainings in found["known"].items():
        for training, entry in trainings.items():
            for name, row in entry["solved"].items():
                yield f"| {noise} | {training}, {name} | {cells(row)} |"
    yield ""
    yield f"| solver | projected on | {head} | largest | drift |"
    yield "|---|---|" + "---|" * (len(marks) + 2)
    for solver, rows in found["unknown"].items():
        for name, row in rows.items():
            kind = "nothing" if name == "plain" else f"the {name}"
            yield f"| {solver} | {kind} | {cells(row)} |"


def cells(row):
    numbers = (*row["error"].values(), row["largest error"], row["drift"])
    return " | ".join(f"{x:.1e}" for x in numbers)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--smoke", action="store_true", help="toy sizes, to see that it runs")
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    size = SMOKE if options.smoke else Size()
    runs = [unknown_integral(seed, size) for seed in size.seeds]
    found = {"training": median([run.pop("training") for run in runs]), "unknown": median(runs)}
    found["known"] = {
        str(noise): median([known_integrals(seed, noise, size) for seed in size.seeds])
        for noise in size.noises
    }
    print("\n".join(table(found)))
    if not options.smoke:
        options.out.write_text(json.dumps(found, indent=1) + "\n")
    return found


if __name__ == "__main__":
    main()
