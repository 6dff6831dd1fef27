"""The best small networks: trains them by second-order methods, judges them, and ships them.

    python benchmarks/learned/zoo.py  # six systems, three seeds: an hour
    python benchmarks/learned/zoo.py --system rigid-body --seed 0 --ship  # and ship this network
    python benchmarks/learned/zoo.py --table  # only print the table of the results
    python benchmarks/learned/zoo.py --smoke  # toy sizes, to see that it runs

One JSON file for each system and seed goes to `benchmarks/results/zoo/`.
"""

import os

# The small factorisations of second-order training are up to a hundred times slower when OpenBLAS
# waits for threads of its own, beside those of XLA.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import dataclasses
import functools
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import trained

import diffrax_conserve as dfc

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "results" / "zoo"
SHIPPED = ROOT.parent / "diffrax_conserve" / "pretrained"
INITIAL_STATES = 100
# The step and the horizon where they are not the system's own.
TIMES = {"kepler": (0.5, 50.0)}


def times_of(system):
    """The step and the horizon."""
    return TIMES.get(system.name, (system.dt, system.t1))


def separation(y):
    """The distance of the closest vortices."""
    pairs = y[:, None] - y[None]
    return jnp.sqrt(jnp.min(jnp.sum(pairs**2, axis=-1) + jnp.eye(len(y)) * 1e9))


def apart(distance):
    """Whether all vortices are at least so far apart."""
    return lambda y: separation(y) >= distance


def with_smaller(states, distance, key):
    """The states, and each of them again, shrunk until the closest vortices are anywhere between
    their own distance and that one: what is rare along solutions is then frequent."""

    def shrink(y, power):
        centre = jnp.mean(y, axis=0)
        return centre + (y - centre) * jnp.minimum(1, distance / separation(y)) ** power

    powers = jr.uniform(key, (len(states),))
    return jnp.concatenate([states, jax.vmap(shrink)(states, powers)])


def ordinary(y):
    """Whether an orbit is about as large as the default one, and not more eccentric."""
    system = dfc.systems.Kepler()
    a = -system.mu / (2 * system.energy(0.0, y, None))
    e = jnp.linalg.norm(system.laplace_runge_lenz(0.0, y, None)) / system.mu
    return (a >= 0.8) & (a <= 1.2) & (e <= 0.6)


def orbits(count, key):
    """States of Kepler's problem up to symmetries: uniform on the disc of (e cos E, e sin E).

    All are at the distance from the centre where a step is the longest in their own time, so that
    what happens farther out is known too.
    """
    e_key, anomaly_key = jr.split(key)
    e = LARGEST * jnp.sqrt(jr.uniform(e_key, (count,)))
    anomaly = 2 * jnp.pi * jr.uniform(anomaly_key, (count,))
    c, s = e * jnp.cos(anomaly), e * jnp.sin(anomaly)
    # The rates towards the centre and around it, in units of that of a circular orbit.
    radial = s / jnp.sqrt(1 - c)
    p = jnp.stack([radial, jnp.sqrt(1 + c - radial**2)], axis=1)
    return jnp.tile(jnp.array([CLOSEST, 0.0]), (count, 1)), p / CLOSEST**0.5


def extreme_orbits():
    """A circle, and the most eccentric orbit at its perihelion: no drawn orbit is one of these."""
    e = jnp.array([0.0, LARGEST])
    p = jnp.stack([jnp.zeros(2), jnp.sqrt((1 + e) / CLOSEST)], axis=1)
    return jnp.tile(jnp.array([CLOSEST, 0.0]), (2, 1)), p


# A little beyond the `ordinary` orbits, of which the smallest has its perihelion at 0.32.
LARGEST, CLOSEST = 0.61, 0.31


@dataclasses.dataclass(frozen=True)
class Spec:
    """How the network of a system is made."""

    width: int
    depth: int
    epochs: int
    windows: int = 0  # of a PINN; none for a flow map
    core: str = "concatenated"
    order: int = 1
    points: int = 250
    duration: float = 20.0  # of the solutions along which its states are drawn
    pool: int = 20_000
    keep: Callable | None = None  # which initial states and states to train for
    draws: int = 1  # for each initial state, where most are not kept
    states: Callable | None = None  # draws those to train for; by default they are along solutions
    extremes: Callable | None = None  # states that the domain reaches to
    damping: float = 1e-2
    frame: bool = False
    smaller: float | None = None  # how close the vortices of shrunk states may be
    repeats: int = 1  # learned steps in one
    natural: bool = False  # of the double pendulum: trained in a gravity of 1, and scaled
    polish: int = 0  # updates by Levenberg-Marquardt in the end
    single: bool = False  # evaluated in float32


SPECS = {
    "harmonic-oscillator": Spec(width=30, depth=1, epochs=20, windows=10),
    "rigid-body": Spec(width=30, depth=1, epochs=30, windows=16),
    "conservative-lorenz": Spec(width=32, depth=2, epochs=1700, order=3, polish=8),
    "double-pendulum": Spec(
        width=40,
        depth=3,
        epochs=1200,
        core="gated",
        points=200,
        duration=10.0,
        repeats=4,
        natural=True,
        single=True,
    ),
    "point-vortices": Spec(
        width=32,
        depth=2,
        epochs=800,
        order=2,
        points=200,
        keep=apart(0.2),
        damping=0.1,
        frame=True,
        smaller=0.19,
        repeats=4,
        polish=8,
    ),
    "kepler": Spec(
        width=24,
        depth=2,
        epochs=1400,
        order=2,
        points=200,
        keep=ordinary,
        draws=5,
        states=orbits,
        extremes=extreme_orbits,
        frame=True,
        repeats=4,
        single=True,
    ),
}
SMOKE = {
    name: dataclasses.replace(
        spec,
        width=8,
        depth=1,
        epochs=10,
        points=20,
        pool=40,
        windows=min(spec.windows, 2),
        polish=min(spec.polish, 1),
    )
    for name, spec in SPECS.items()
}


def initial_states(system, spec, count, seed):
    y0s = jax.jit(jax.vmap(system.sample))(jr.split(jr.key(seed), spec.draws * count))
    if spec.keep is None:
        return y0s
    kept = jax.vmap(spec.keep)(y0s)
    return jax.tree.map(lambda x: x[kept][:count], y0s)


def train(system, spec, seed):
    """The network, and the seconds of everything that made it: of the clock, of the processors."""
    started = np.array([time.perf_counter(), time.process_time()])
    key = jr.key(seed)
    if spec.windows:
        network = dfc.PINN(
            system.y0, 0.0, system.t1,
            windows=spec.windows, width=spec.width, depth=spec.depth, slope=2.0, key=key,
        )  # fmt: skip
        recipe = dfc.learned.second_order(network, epochs=spec.epochs)
        network, log = dfc.fit(
            network, system.vector_field,
            key=key, manifold=system.manifold, recipe=recipe, progress=True,
        )  # fmt: skip
    else:
        network, log = train_flow_map(system, spec, seed, key)
    took = np.array([time.perf_counter(), time.process_time()]) - started
    return network, log, took


def train_flow_map(system, spec, seed, key):
    """SPRING on fresh points, then perhaps Levenberg-Marquardt on many that stay the same."""
    own, system = system, dfc.systems.DoublePendulum(gravity=1.0) if spec.natural else system
    dt, _ = times_of(system)
    longest = dt if spec.natural else dt / spec.repeats
    if spec.states is None:
        pool = reachable(system, spec, spec.pool, seed)
    else:
        pool = spec.states(spec.pool, jr.key(seed + 100))
    if spec.smaller is not None:
        pool = with_smaller(pool, spec.smaller, jr.key(seed + 300))
    network = dfc.DeepONet(
        pool, longest,
        width=spec.width, depth=spec.depth, core=spec.core,
        taylor=dfc.learned.Taylor(system.vector_field, spec.order) if spec.order else None,
        frame=system.frame if spec.frame else None, key=key,
    )  # fmt: skip

    def fit(network, **changes):
        recipe = dataclasses.replace(
            dfc.learned.second_order(network, epochs=spec.epochs), **changes
        )
        return dfc.fit(
            network, system.vector_field,
            key=key, sample=pool, recipe=recipe, progress=True,
        )  # fmt: skip

    network, log = fit(network, points=spec.points, optimiser="spring", damping=spec.damping)
    if spec.polish:
        network, log = fit(
            network, epochs=spec.polish, points=spec.pool // 8, refresh=None, check_every=1,
            optimiser="levenberg-marquardt", damping=5e-5,
        )  # fmt: skip
    network = scaled(network, own) if spec.natural else network
    if spec.extremes is not None:
        network = reaching(network, spec.extremes())
    if spec.single:
        single = jax.tree.map(lambda x: x.astype(jnp.float32), network.core)
        network = eqx.tree_at(lambda m: m.core, network, single)
    return network if spec.repeats == 1 else dfc.learned.Repeated(network, spec.repeats), log


def reaching(network, states):
    """The same network, with these states in its domain."""
    seen = jax.vmap(lambda y: network.domain.frame(y).inputs)(states)
    corners = lambda m: (m.domain.box.lower[0], m.domain.box.upper[0])  # noqa: E731
    lower, upper = corners(network)
    wider = jnp.minimum(lower, seen.min(axis=0)), jnp.maximum(upper, seen.max(axis=0))
    return eqx.tree_at(corners, network, wider)


def scaled(network, system):
    r"""The flow map of a double pendulum in its own gravity, from one that is for a gravity of 1.

    With times in units of $1/\sqrt g$ and momenta in units of $\sqrt g$ its equations have no $g$:
    it is the same network, with other scales and a longest step that is $\sqrt g$ times shorter.
    """
    root = jnp.sqrt(system.gravity)
    units = jnp.stack([jnp.ones(()), jnp.ones(()), root, root])
    corners = jnp.stack([network.domain.lower, network.domain.upper]) * units
    layers = network.core.hidden
    found = dfc.DeepONet(
        corners, network.max_step / root,
        width=layers[0].weights[0].shape[1], depth=len(layers), core="gated",
        taylor=dfc.learned.Taylor(system.vector_field, network.order), key=jr.key(0),
    )  # fmt: skip
    parts = network.core, network.shift * units, network.scale * units
    return eqx.tree_at(lambda m: (m.core, m.shift, m.scale), found, parts)


def reachable(system, spec, count, seed):
    y0s = initial_states(system, spec, count, seed + 100)
    return dfc.learned.reachable_states(
        system.vector_field, y0s, spec.duration, key=jr.key(seed + 200), keep=spec.keep
    )


# ---- Judging ----


def judge_pinn(system, network):
    ts = jnp.linspace(0.0, system.t1, 501)
    reference = system.reference(ts, system.y0)
    steps = system.t1 / 100
    found = {}
    for label, solver in {
        "plain": dfc.PINNSolver(network),
        "projected": dfc.ManifoldProjection(dfc.PINNSolver(network), system.manifold),
    }.items():
        solution = dfx.diffeqsolve(
            dfx.ODETerm(system.vector_field), solver, 0.0, system.t1, steps, system.y0,
            saveat=dfx.SaveAt(ts=ts),
        )  # fmt: skip
        error = solution.ys - reference
        found[label] = {
            "relative_l2_error": float(jnp.linalg.norm(error) / jnp.linalg.norm(reference)),
            "largest_state_error": float(jnp.max(jnp.linalg.norm(error, axis=-1))),
        }
    return found


def exact_step(system, y0):
    controller = dfx.PIDController(rtol=1e-13, atol=1e-13)
    solution = dfx.diffeqsolve(
        dfx.ODETerm(system.vector_field), dfx.Dopri8(), 0.0, times_of(system)[0], None, y0,
        stepsize_controller=controller, max_steps=None, adjoint=dfx.ForwardMode(),
    )  # fmt: skip
    return jax.tree.map(lambda x: x[-1], solution.ys)


@functools.cache
def judged_on(name, spec, steps, states):
    """States with the exact ends of their steps, and initial states with their exact solutions."""
    system = dfc.systems.get(name)
    fresh = reachable(system, spec, states, seed=1000)
    exact = jax.jit(jax.vmap(lambda y: exact_step(system, y)))(fresh)
    y0s = initial_states(system, spec, 4 * INITIAL_STATES, seed=2000)
    y0s = jax.tree.map(lambda x: x[:INITIAL_STATES], y0s)
    ts = jnp.arange(steps + 1) * times_of(system)[0]
    reference = jax.vmap(lambda y0: system.reference(ts, y0))(y0s)
    return fresh, exact, y0s, ts, reference


def judge_flow_map(system, spec, network, steps, states):
    """One-step errors over fresh reachable states; rollouts from `INITIAL_STATES`."""
    fresh, exact, y0s, ts, reference = judged_on(system.name, spec, steps, states)
    solvers = {"plain": dfc.DeepONetSolver(network), "RK4": dfc.RK4()}
    found = {}
    for label, solver in solvers.items():
        rms, median = one_step(system, solver, fresh, exact)
        found[label] = {"one_step_rms": rms, "one_step_median": median}
    solvers["projected"] = dfc.ManifoldProjection(solvers["plain"], system.manifold)
    solvers["projected RK4"] = dfc.ManifoldProjection(dfc.RK4(), system.manifold)
    for label, solver in solvers.items():
        record = found.setdefault(label, {})
        record |= rollout(system, solver, y0s, ts, reference)
        record["ns_per_step"] = cost(system, solver, fresh)
    return found


def step(system, solver, y0):
    term, (dt, _) = dfx.ODETerm(system.vector_field), times_of(system)
    ys = dfx.diffeqsolve(term, solver, 0.0, dt, dt, y0, throw=False).ys
    return jax.tree.map(lambda x: x[-1], ys)


def distances(ys, others, leading=1):
    """The Euclidean distances of states with so many leading axes."""
    differences = jax.tree.leaves(jax.tree.map(lambda a, b: np.asarray(a - b), ys, others))
    flat = [x.reshape(*x.shape[:leading], -1) for x in differences]
    return np.linalg.norm(np.concatenate(flat, axis=-1), axis=-1)


def one_step(system, solver, states, exact):
    ys = jax.jit(jax.vmap(lambda y: step(system, solver, y)))(states)
    error = distances(ys, exact)
    return float(np.sqrt(np.mean(error**2))), float(np.median(error))


def rollout(system, solver, y0s, ts, reference):
    @jax.jit
    @jax.vmap
    def solve(y0):
        solution = dfx.diffeqsolve(
            dfx.ODETerm(system.vector_field), solver, 0.0, ts[-1], times_of(system)[0], y0,
            saveat=dfx.SaveAt(ts=ts), max_steps=len(ts) + 2, throw=False,
        )  # fmt: skip
        drift = jax.tree.leaves(dfc.drift(solution, system.manifold))
        largest = jnp.max(jnp.stack([jnp.max(jnp.abs(d)) for d in drift]))
        return solution.ys, largest, solution.result == dfx.RESULTS.successful

    ys, drift, ok = solve(y0s)
    error = distances(ys, reference, 2)
    error = np.where(np.asarray(ok)[:, None], error, np.inf)
    largest = np.max(error, axis=1)
    return {
        "state_error": trained.number(np.median(error[:, -1])),
        "largest_state_error": trained.number(np.median(largest)),
        "rms_largest_state_error": trained.number(np.sqrt(np.mean(largest**2))),
        "worst_state_error": trained.number(np.max(largest)),
        "drift": trained.number(np.max(np.asarray(drift))),
        "failed": int(np.sum(~np.asarray(ok))),
    }


def cost(system, solver, states, steps=20, repeats=5):
    """Nanoseconds for a step of one trajectory in a batch."""
    dt, _ = times_of(system)

    @jax.jit
    @jax.vmap
    def solve(y0):
        return dfx.diffeqsolve(
            dfx.ODETerm(system.vector_field), solver, 0.0, steps * dt, dt, y0,
            throw=False, max_steps=None, adjoint=dfx.ForwardMode(),
        ).ys  # fmt: skip

    jax.block_until_ready(solve(states))
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        jax.block_until_ready(solve(states))
        times.append(time.perf_counter() - started)
    count = len(jax.tree.leaves(states)[0])
    return round(min(times) / steps / count * 1e9, 1)


# ---- Records ----


def measure(name, seed, *, specs=SPECS, steps=None, states=1000):
    system, spec = dfc.systems.get(name), specs[name]
    network, log, (seconds, cpu_seconds) = train(system, spec, seed)
    record = {
        "system": name,
        "seed": seed,
        "weights": sum(x.size for x in jax.tree.leaves(weights_of(network))),
        "epochs": len(log.losses) + (spec.epochs if spec.polish else 0),
        "best_loss": trained.number(log.criteria.min()),
        "skipped_updates": log.skipped,
        "seconds": round(seconds, 1),
        "cpu_seconds": round(cpu_seconds, 1),
        "compile_seconds": round(log.compile_seconds, 1),
    }
    if spec.windows:
        record["errors"] = judge_pinn(system, network)
    else:
        dt, t1 = times_of(system)
        steps = round(t1 / dt) if steps is None else steps
        record["errors"] = judge_flow_map(system, spec, network, steps, states)
    return network, record


def weights_of(network):
    network = network.flow_map if isinstance(network, dfc.learned.Repeated) else network
    core = network.nets if isinstance(network, dfc.PINN) else network.core
    return eqx.filter(core, eqx.is_array)


def ship(network, record):
    spec = SPECS[record["system"]]
    domain = "the initial state" if spec.windows else "states along solutions"
    domain = domain if spec.states is None else " ".join(spec.states.__doc__.split())
    info = {
        **record,
        "command": f"python benchmarks/learned/zoo.py --system {record['system']} "
        f"--seed {record['seed']} --ship",
        "recipe": "second_order",
        "domain": domain,
    }
    dfc.save(SHIPPED / f"{record['system']}.network", network, info=info)


HEAD = {
    "pinn": "| system | seeds | weights | s | relative error | largest error | projected |",
    "flow map": "| system | seeds | weights | s | one step | largest error | projected |",
    "RK4": "| system | one step | largest error | projected |",
    "ns": "| system | network | projected | RK4 | projected RK4 |",
}


def tables(records):
    """Four Markdown tables, medians over the seeds: solutions; flow maps, RK4 with the same steps,
    and nanoseconds of a step."""
    text = {}
    for kind, head in HEAD.items():
        lines = [head, "|---" * (head.count("|") - 1) + "|"]
        for name, spec in SPECS.items():
            rows = [r for r in records if r["system"] == name]
            if rows and bool(spec.windows) == (kind == "pinn"):
                lines.append("| " + " | ".join([f"`{name}`", *cells(kind, rows)]) + " |")
        text[kind] = "\n".join(lines)
    return "\n\n".join(text.values())


def cells(kind, rows):
    def median(label, key):
        found = [row["errors"].get(label, {}).get(key) for row in rows]
        known = [number for number in found if number is not None]
        return trained.median(known) if known else None

    def error(label, key):
        number = median(label, key)
        return "" if number is None else trained.error(number)

    def nanoseconds(label):
        number = median(label, "ns_per_step")
        return "" if number is None else f"{number:,.0f}"

    # Of the processors; of the clock where only that was taken.
    seconds = trained.median(row.get("cpu_seconds", row["seconds"]) for row in rows)
    first = [str(len(rows)), f"{rows[0]['weights']:,}", f"{seconds:.0f}"]
    if kind == "pinn":
        return [
            *first,
            error("plain", "relative_l2_error"),
            error("plain", "largest_state_error"),
            error("projected", "largest_state_error"),
        ]
    if kind == "ns":
        return [nanoseconds(label) for label in ("plain", "projected", "RK4", "projected RK4")]
    labels, first = (
        (("RK4", "projected RK4"), []) if kind == "RK4" else (("plain", "projected"), first)
    )
    return [
        *first,
        error(labels[0], "one_step_rms"),
        *[error(label, "largest_state_error") for label in labels],
    ]


def main(argv=None):
    jax.config.update("jax_enable_x64", True)
    parser = trained.parser(__doc__, SPECS)
    parser.add_argument("--seed", type=int, action="append")
    parser.add_argument("--ship", action="store_true", help="write the networks into the package")
    options = parser.parse_args(argv)
    if options.table:
        print(tables(trained.read_results(RESULTS)))
        return []
    if options.smoke:
        smoke = options.system or ["rigid-body", "conservative-lorenz"]
        records = [measure(name, 0, specs=SMOKE, steps=2, states=10)[1] for name in smoke]
        print(json.dumps(records))
        return records
    records = []
    for name in options.system or SPECS:
        for seed in options.seed or [0, 1, 2]:
            network, record = measure(name, seed)
            RESULTS.mkdir(parents=True, exist_ok=True)
            (RESULTS / f"{name}-{seed}.json").write_text(json.dumps(record, indent=1) + "\n")
            if options.ship:
                ship(network, record)
            records.append(record)
            print(json.dumps(record))
            print(f"{name}, seed {seed}: {record['seconds']:.0f} s of training", file=sys.stderr)
    return records


if __name__ == "__main__":
    main()
