"""What a learned flow map is worth: its errors against those of classical methods of equal cost.

    python benchmarks/learned/equal_cost.py  # all systems; writes results/equal_cost.json
    python benchmarks/learned/equal_cost.py --system double-pendulum
    python benchmarks/learned/equal_cost.py --system double-pendulum --network FILE  # another
    python benchmarks/learned/equal_cost.py --single  # the vector field in float32; writes nothing
    python benchmarks/learned/equal_cost.py --table  # only print the tables of the results
    python benchmarks/learned/equal_cost.py --smoke  # toy sizes, to see that it runs

Every method is solved from the same 100 initial states over the system's horizon. Its error is the
largest Euclidean distance from the reference over the system's steps; median, root mean square and
worst are over the states. A classical method takes each of these steps in several pieces of equal
length. Its cost is that of the compiled solve, in processor time of one core, for one of the
system's steps of one trajectory, in a batch of 1,000 and alone.

A classical error at the cost of a network is interpolated between whole numbers of pieces, in
logarithms, which no method can do: it is to its favour.
"""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import trained
import zoo

import diffrax_conserve as dfc

sys.path.append(str(Path(__file__).parent.parent / "cost"))
import measuring

RESULTS = Path(__file__).parent.parent / "results" / "equal-cost"
CLASSICAL = {
    "RK4": dfc.RK4(),
    "Tsit5": dfc.Unrolled(dfx.Tsit5()),
    "Dopri8": dfc.Unrolled(dfx.Dopri8()),
}
COSTS = {"batch": "in a batch", "alone": "alone"}


@dataclasses.dataclass(frozen=True)
class Size:
    """How much is measured."""

    steps: int | None = None  # of the rollouts; by default those of the system's horizon
    states: int = 100
    batch: int = 1000
    batch_steps: int = 20
    alone_steps: int = 200
    rounds: int = 7


PIECES = {
    "double-pendulum": {
        "RK4": (1, 2, 3, 4, 5, 6, 8),
        "Tsit5": (1, 2, 3, 4, 5),
        "Dopri8": (1, 2, 3),
    },
    "conservative-lorenz": {
        "RK4": (1, 2, 4, 8, 16, 32),
        "Tsit5": (1, 2, 4, 8),
        "Dopri8": (1, 2, 4),
    },
    "point-vortices": {"RK4": (1, 2, 4, 8, 16), "Tsit5": (1, 2, 4, 8), "Dopri8": (1, 2, 4)},
    "kepler": {"RK4": (1, 2, 4, 8, 16), "Tsit5": (1, 2, 4, 8), "Dopri8": (1, 2, 4)},
}
SMOKE = Size(steps=2, states=3, batch=4, batch_steps=2, alone_steps=2, rounds=1)


@dataclasses.dataclass(frozen=True)
class Contestant:
    """A solver, and in how many pieces it takes a step."""

    solver: dfx.AbstractSolver
    pieces: int = 1


class SingleField(eqx.Module):
    """A system whose vector field is evaluated in float32, for states in float64."""

    system: Any

    def vector_field(self, t, y, args):
        single, t, y32 = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (self.system, t, y))
        return jax.tree.map(lambda f, x: f.astype(x.dtype), single.vector_field(t, y32, args), y)

    def __getattr__(self, name):
        return getattr(self.system, name)


def contestants(system, networks, pieces):
    """All of them by (method, pieces, whether projected)."""
    plain = {(name, 1): dfc.DeepONetSolver(net) for name, net in networks.items()}
    for method, counts in pieces.items():
        plain |= {(method, m): CLASSICAL[method] for m in counts}
    found = {}
    for (method, m), solver in plain.items():
        found[method, m, False] = Contestant(solver, m)
        found[method, m, True] = Contestant(dfc.ManifoldProjection(solver, system.manifold), m)
    return found


# ---- Errors ----


@eqx.filter_jit
def rollout(system, solver, y0s, ts, dt, max_steps):
    def one(y0):
        solution = dfx.diffeqsolve(
            dfx.ODETerm(system.vector_field), solver, 0.0, ts[-1], dt, y0,
            saveat=dfx.SaveAt(ts=ts), max_steps=max_steps, throw=False,
        )  # fmt: skip
        drift = jax.tree.leaves(dfc.drift(solution, system.manifold))
        largest = jnp.max(jnp.stack([jnp.max(jnp.abs(d)) for d in drift]))
        return solution.ys, largest, solution.result == dfx.RESULTS.successful

    return jax.vmap(one)(y0s)


def initial_states(system, count):
    """As in the training of the zoo."""
    y0s = zoo.initial_states(system, zoo.SPECS[system.name], 4 * count, 2000)
    return jax.tree.map(lambda x: x[:count], y0s)


def errors(system, contestant, y0s, ts, reference, most):
    """Of the largest errors over the horizon: median, root mean square and worst.

    With the same bound on the steps for all numbers of pieces up to `most`, these share a
    compilation.
    """
    max_steps = len(ts) * most + 2
    dt = ts[1] / contestant.pieces
    ys, drift, ok = rollout(system, contestant.solver, y0s, ts, dt, max_steps)
    largest = np.max(zoo.distances(ys, reference, 2), axis=1)
    largest = np.where(np.asarray(ok), largest, np.inf)
    largest = np.where(np.isfinite(largest), largest, np.inf)
    return {
        "median": trained.number(np.median(largest)),
        "rms": trained.number(np.sqrt(np.mean(largest**2))),
        "worst": trained.number(np.max(largest)),
        "drift": trained.number(np.max(np.asarray(drift))),
        "failed": int(np.sum(~np.isfinite(largest))),
    }


# ---- Costs ----


def compiled_solve(system, solver, y0s, max_steps):
    def solve(solver, y0s, span, dt):
        def one(y0):
            return dfx.diffeqsolve(
                dfx.ODETerm(system.vector_field), solver, 0.0, span, dt, y0,
                max_steps=max_steps, throw=False,
            ).ys  # fmt: skip

        return jax.vmap(one)(y0s)

    one = jnp.asarray(1.0)
    return eqx.filter_jit(solve).lower(solver, y0s, one, one).compile()


def costs(system, found, y0s, steps, rounds):
    """Nanoseconds for a step of one trajectory, of every contestant: they take turns."""
    (dt, _), lanes = zoo.times_of(system), len(jax.tree.leaves(y0s)[0])
    compiled = {}
    calls = {}
    most = {key[::2]: 0 for key in found}
    for method, m, projected in found:
        most[method, projected] = max(most[method, projected], m)
    for (method, m, projected), contestant in found.items():
        if (method, projected) not in compiled:
            max_steps = steps * most[method, projected] + 1
            compiled[method, projected] = compiled_solve(system, contestant.solver, y0s, max_steps)
        span, dt = jnp.asarray(steps * dt), jnp.asarray(dt / m)
        run = compiled[method, projected]
        calls[method, m, projected] = lambda run=run, s=contestant.solver, a=span, b=dt: run(
            s, y0s, a, b
        )
    best = measuring.take_turns(calls, rounds)
    return {key: 1e9 * t.seconds / steps / lanes for key, t in best.items()}


def measure(name, networks, size=None, pieces=None, single=False):
    system = dfc.systems.get(name)
    size = Size() if size is None else size
    dt, t1 = zoo.times_of(system)
    steps = round(t1 / dt) if size.steps is None else size.steps
    ts = jnp.arange(steps + 1) * dt
    y0s = initial_states(system, size.states)
    reference = jax.vmap(lambda y0: system.reference(ts, y0))(y0s)
    found = contestants(system, networks, PIECES[name] if pieces is None else pieces)
    solved = SingleField(system) if single else system
    many = initial_states(system, size.batch)
    first = jax.tree.map(lambda x: x[:1], y0s)
    ns = {
        "batch": costs(solved, found, many, size.batch_steps, size.rounds),
        "alone": costs(solved, found, first, size.alone_steps, size.rounds),
    }
    rows = []
    for key, contestant in found.items():
        row = dict(zip(("method", "pieces", "projected"), key, strict=True))
        most = max(k[1] for k in found if k[::2] == key[::2])
        row |= errors(solved, contestant, y0s, ts, reference, most)
        rows.append(row | {f"ns_{place}": round(ns[place][key], 1) for place in COSTS})
    return {"system": name, "steps": steps, "dt": dt, "states": size.states, "rows": rows}


# ---- The comparison ----


def at_equal_cost(rows, ns, place, method, projected, what="median"):
    """The error of a classical method at the cost `ns`; `None` where one piece costs more."""
    own = [r for r in rows if r["method"] == method and r["projected"] == projected]
    cost = np.maximum.accumulate([r[f"ns_{place}"] for r in own])
    error = np.array([trained.or_infinity(r[what]) for r in own])
    if ns < cost[0]:
        return None
    last = int(np.searchsorted(cost, ns, side="right")) - 1
    if last + 1 == len(own):
        return float(error[last])
    if not np.all(np.isfinite(error[last : last + 2])):
        return float(error[last])
    at = np.interp(np.log(ns), np.log(cost), np.log(np.where(np.isfinite(error), error, 1e9)))
    return float(np.exp(at))


def best_classical(rows, row, place, what="median"):
    """The smallest error of any classical method, projected or not, at the cost of `row`."""
    found = [
        at_equal_cost(rows, row[f"ns_{place}"], place, method, projected, what)
        for method in CLASSICAL
        for projected in (False, True)
    ]
    return min((x for x in found if x is not None), default=np.inf)


def tables(record):
    rows = record["rows"]
    lines = [
        f"`{record['system']}`, {record['steps']} steps of {record['dt']:g}",
        "",
        "| method | pieces | projected | median | rms | worst | failed | drift | ns, batch "
        "| alone |",
        "|---" * 10 + "|",
    ]
    for r in rows:
        cells = [r["method"], str(r["pieces"]), "yes" if r["projected"] else ""]
        cells += [trained.error(r[x]) for x in ("median", "rms", "worst")]
        cells += [str(r["failed"]), trained.error(r["drift"])]
        cells += [f"{r[f'ns_{place}']:,.0f}" for place in COSTS]
        lines.append("| " + " | ".join(cells) + " |")
    lines += ["", "| at the cost of | where | its median | " + " | ".join(
        f"{m}{p}" for m in CLASSICAL for p in ("", ", projected")
    ) + " | best / network |", "|---" * (4 + 2 * len(CLASSICAL)) + "|"]  # fmt: skip
    for r in rows:
        if r["method"] in CLASSICAL:
            continue
        for place, where in COSTS.items():
            cells = [r["method"] + (", projected" if r["projected"] else ""), where]
            cells.append(trained.error(r["median"]))
            for method in CLASSICAL:
                for projected in (False, True):
                    x = at_equal_cost(rows, r[f"ns_{place}"], place, method, projected)
                    cells.append("-" if x is None else trained.error(x))
            ratio = best_classical(rows, r, place) / trained.or_infinity(r["median"])
            lines.append("| " + " | ".join([*cells, f"{ratio:.2g}"]) + " |")
    return "\n".join(lines)


def main(argv=None):
    parser = trained.parser(__doc__, PIECES)
    parser.add_argument("--network", type=Path, help="a file, instead of the shipped networks")
    parser.add_argument("--single", action="store_true", help="the vector field in float32")
    options = parser.parse_args(argv)
    if options.table:
        for record in trained.read_results(RESULTS):
            print(tables(record), end="\n\n")
        return []
    records = []
    for name in options.system or (["double-pendulum"] if options.smoke else PIECES):
        if options.network is not None:
            networks = {"network": dfc.load(options.network)}
        else:
            networks = {"network": dfc.load_pretrained(name)}
        if options.smoke:
            pieces = {"RK4": (1, 2)}
            records.append(measure(name, networks, SMOKE, pieces))
            continue
        record = measure(name, networks, single=options.single)
        record["machine"] = measuring.machine()
        records.append(record)
        print(tables(record), end="\n\n", flush=True)
        if options.network is None and not options.single:
            RESULTS.mkdir(parents=True, exist_ok=True)
            (RESULTS / f"{name}.json").write_text(json.dumps(record, indent=1) + "\n")
    if options.smoke:
        print(json.dumps(records), file=sys.stderr)
    return records


if __name__ == "__main__":
    main()
