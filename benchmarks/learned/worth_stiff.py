"""A learned step of POLLU against stiff solvers: time for a step of two minutes at equal error.

    python benchmarks/learned/worth_stiff.py          # writes ../results/worth_stiff.json
    python benchmarks/learned/worth_stiff.py FILE     # a network of `chemistry.py --out FILE`
    python benchmarks/learned/worth_stiff.py --smoke  # toy sizes, to see that it runs

A batch of states from solves as in `chemistry.py`. Kvaerno3 and Kvaerno5 are those of diffrax,
adaptive, from a first step of one minute. The Rosenbrock method is written out here for a batch:
Rodas3 in equal pieces, with the Jacobian by forward mode and an elimination without pivots, whose
loops run over the batch. The learned step is projected on the balances. Errors are relative, of
species above 1e-10; the time of a classical method is that of its cheapest setting whose median
error and 99th percentile are at most those of the network.
"""

import argparse
import json
import time
from pathlib import Path

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_conserve as dfc
from diffrax_conserve.learned._pretrained import pretrained_path

jax.config.update("jax_enable_x64", True)
RESULTS = Path(__file__).parents[1] / "results" / "worth_stiff.json"
SYSTEM = dfc.systems.get("pollu")
STEP, FIRST, TRACE = 2.0, 0.05, 1e-10


def field(y):
    return SYSTEM.vector_field(0.0, y, None)


# ---- Rodas3, for states of shape (species, batch) ----

# A. Sandu et al., "Benchmarking stiff ODE solvers for atmospheric chemistry problems II: Rosenbrock
# solvers", Atmos. Environ. 31 (1997).
GAMMA = 0.5
A = ((), (0.0,), (2.0, 0.0), (2.0, 0.0, 1.0))
C = ((), (4.0,), (1.0, -1.0), (1.0, -1.0, -8 / 3))
M = (2.0, 0.0, 1.0, 1.0)


def rodas3(y, h, pieces):
    def piece(_, y):
        each = h / pieces
        fields = jax.vmap(field, 1, 1)
        jacobian = jax.vmap(jax.jacfwd(field), 1, 2)(y)
        solve = elimination(jnp.eye(len(y))[:, :, None] / (each * GAMMA) - jacobian)
        ks, at_y = [], fields(y)
        for a, c in zip(A, C, strict=True):
            start = y + sum(x * k for x, k in zip(a, ks, strict=True)) if any(a) else y
            right = fields(start) if any(a) else at_y
            ks.append(solve(right + sum(x / each * k for x, k in zip(c, ks, strict=True))))
        return y + sum(m * k for m, k in zip(M, ks, strict=True))

    return jax.lax.fori_loop(0, pieces, piece, y)


def elimination(matrix):
    """`b` to the solution `x` of `matrix x = b`; the matrix is diagonally dominant enough."""
    rows, factors = [], []
    for _ in range(len(matrix)):
        rows.append(matrix[0])
        factors.append(matrix[1:, 0] / matrix[0, 0])
        matrix = matrix[1:, 1:] - factors[-1][:, None] * matrix[0, 1:]

    def solve(b):
        left = []
        for factor in factors:
            left.append(b[0])
            b = b[1:] - factor * b[0]
        x = jnp.zeros_like(b)
        for row, c in zip(reversed(rows), reversed(left), strict=True):
            first = (c - jnp.sum(row[1:] * x, axis=0)) / row[0]
            x = jnp.concatenate([first[None], x])
        return x

    return solve


# ---- The contestants ----


def learned(network):
    projection = SYSTEM.mechanism.positive_projection()

    def step(y0):
        value = {name: b(0.0, y0, None) for name, b in SYSTEM.mechanism.balances.items()}
        y1 = network(y0, STEP)
        return dfc.project(SYSTEM.manifold, y1, value=value, projection=projection)[0]

    return jax.vmap(step)


def kvaerno(solver, rtol):
    def step(y0):
        return dfx.diffeqsolve(
            dfx.ODETerm(SYSTEM.vector_field), solver, 0.0, STEP, 1.0, y0,
            stepsize_controller=dfx.PIDController(rtol=rtol, atol=1e-9 * rtol), max_steps=1000,
            throw=False,
        ).ys[0]  # fmt: skip

    return jax.vmap(step)


def contestants(network, smoke):
    found = {("learned", 0.0): learned(network)}
    for rtol in (1e-1,) if smoke else (1.0, 1e-1, 1e-2, 1e-3):
        found["Kvaerno3", rtol] = kvaerno(dfx.Kvaerno3(), rtol)
        found["Kvaerno5", rtol] = kvaerno(dfx.Kvaerno5(), rtol)
    for pieces in (2,) if smoke else (1, 2, 4, 8, 16, 32):
        found["Rodas3", pieces] = lambda y0s, n=pieces: rodas3(y0s.T, STEP, n).T
    return found


def untrained(states):
    boxcox = dfc.learned.BoxCox(0.125)
    inner = dfc.DeepONet(boxcox(states), STEP, width=8, depth=1, core="concatenated", key=jr.key(0))
    return dfc.learned.Transformed(inner, boxcox)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    shipped = pretrained_path("pollu")
    parser.add_argument("network", type=Path, nargs="?", default=shipped)
    parser.add_argument("--smoke", action="store_true", help="toy sizes, nothing is written")
    options = parser.parse_args(argv)
    smoke = options.smoke
    count, steps, tolerance = (2, 2, 1e-4) if smoke else (50, 20, 1e-8)
    y0s = jax.vmap(SYSTEM.sample)(jr.split(jr.key(77), count))
    ts = FIRST + STEP * jnp.arange(steps + 1)
    _, ys = dfc.learned.trajectories(
        SYSTEM.vector_field, y0s, ts, solver=dfx.Kvaerno5(), rtol=tolerance, atol=1e-16
    )
    starts, exact = (np.asarray(x).reshape(-1, 20) for x in (ys[:, :-1], ys[:, 1:]))
    rows = []
    network = untrained(y0s) if smoke else dfc.load(options.network)
    for (name, setting), step in contestants(network, smoke).items():
        run = jax.jit(step).lower(starts).compile()
        found, times = np.asarray(run(starts)), []
        for _ in range(1 if smoke else 7):
            begun = time.process_time()
            run(starts).block_until_ready()
            times.append(time.process_time() - begun)
        off = np.abs(found / exact - 1)[exact > TRACE]
        row = {"method": name, "setting": setting, "us": 1e6 * min(times) / len(starts)}
        rows.append(row | {"median": float(np.median(off)), "p99": float(np.percentile(off, 99))})
        print(rows[-1], flush=True)
    own = rows[0]
    for name in ("Kvaerno3", "Kvaerno5", "Rodas3"):
        equal = [r["us"] for r in rows if r["method"] == name and as_good(r, own)]
        if equal:
            print(f"{name} takes {min(equal) / own['us']:.0f} times as long at equal error")
    if not smoke:
        RESULTS.write_text(json.dumps(rows, indent=1) + "\n")
    return rows


def as_good(row, other):
    return row["median"] <= other["median"] and row["p99"] <= other["p99"]


if __name__ == "__main__":
    main()
