"""What the comparisons with published results share: solves that are counted, and the command line.

A comparison has a function `measure(smoke)`, which returns rows, and `table(results)` and
`verdicts(results)`, which the page is made of (`tables.py`).
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1] / "cost"))
# Factorisations are many times slower if threads of OpenBLAS wait beside those of XLA.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import measuring

import diffrax_conserve as dfc

RESULTS = measuring.RESULTS / "published"
PEERS = ("heyoka", "homproj", "scikit-sundae", "scipy")


# ---- Solves ----


@eqx.filter_jit
def solve(field, solver, y0, t1, rtol, atol, saveat, dt0=None, max_steps=100_000, args=None):
    """An adaptive solve; if `rtol` is `None`, one with fixed steps `dt0`."""
    adaptive = rtol is not None
    return dfx.diffeqsolve(
        dfx.ODETerm(field),
        solver,
        0.0,
        t1,
        dt0,
        y0,
        args,
        saveat=saveat,
        stepsize_controller=dfx.PIDController(rtol, atol) if adaptive else dfx.ConstantStepSize(),
        adjoint=dfx.ForwardMode(),
        max_steps=max_steps,
        throw=False,
    )


def evaluations(solver, stats) -> int:
    """How often an explicit solver evaluated the vector field. A plain solver with the property
    "first same as last" takes its first slope from the last step. A projected one does not: it
    evaluates the slope anew at the projected state."""
    projected = isinstance(solver, dfc.ManifoldProjection)
    tableau = (solver.solver if projected else solver).tableau
    stages = tableau.num_stages - (tableau.fsal and not projected)
    rejected_too = int(stats["num_steps"])
    return rejected_too * stages + 1


class Found(NamedTuple):
    """The state at the end, the whole solution in steps, and the row of a table."""

    end: Any
    path: dfx.Solution
    row: dict[str, Any]


def counted(field, solver, manifold, y0, t1, rtol, atol, *, max_steps, dt0=None, args=None):
    """Solves once with all steps, for the violation, and compiles the solve that is timed."""
    every = dfx.SaveAt(t0=True, steps=True)
    path = solve(field, solver, y0, t1, rtol, atol, every, dt0, max_steps, args)
    last = int(jnp.sum(jnp.isfinite(path.ts))) - 1
    end = jax.tree.map(lambda leaf: leaf[last], path.ys)
    row = dict(
        finished=bool(path.result == dfx.RESULTS.successful),
        steps=int(path.stats["num_accepted_steps"]),
        evaluations=evaluations(solver, path.stats),
        violation=largest(dfc.drift(path, manifold, args)),
    )
    return Found(end, path, row)


def timed(runs: Mapping[Any, Callable[[], Any]], smoke: bool) -> dict[Any, float]:
    """The best of five rounds in which the contestants take turns, in seconds."""
    for run in runs.values():
        jax.block_until_ready(run())
    rounds = measuring.take_turns(runs, 1 if smoke else 5, long=0.5)
    return {name: found.seconds for name, found in rounds.items()}


def largest(tree: Any) -> float:
    return max(float(jnp.max(jnp.abs(leaf))) for leaf in jax.tree.leaves(tree))


# ---- The command line ----


def main(name: str, doc: str, measure: Callable[[bool], dict[str, Any]], argv=None, seed=None):
    """Measures, unless the result is there already, and writes it."""
    parser = argparse.ArgumentParser(description=doc.split("\n\n")[0])
    parser.add_argument("--smoke", action="store_true", help="tiny sizes, nothing is written")
    parser.add_argument("--again", action="store_true", help="although the result is there")
    options = parser.parse_args(argv)
    out = RESULTS / f"{name}.json"
    if out.exists() and not (options.again or options.smoke):
        print(f"{out.name} is there: --again measures it again")
        return json.loads(out.read_text())
    about = measuring.machine(*PEERS)
    begin = time.monotonic()
    found = measure(options.smoke)
    results = dict(machine=about, seed=seed, minutes=(time.monotonic() - begin) / 60, **found)
    if not options.smoke:
        out.parent.mkdir(exist_ok=True)
        out.write_text(json.dumps(results, indent=1, default=float) + "\n")
    return results


def show(row: Mapping[str, Any]) -> None:
    print(
        ", ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()),
        flush=True,
    )


# ---- Tables ----


def cell(value: Any) -> str:
    """A number as the page shows it."""
    if value is None:
        return ""
    if isinstance(value, str):
        return value
    if isinstance(value, int | np.integer):
        return f"{value:,}"
    if not np.isfinite(value):
        return "fails"
    return f"{value:.1e}" if value < 1e-2 or value >= 1e4 else f"{value:.3g}"


def markdown(heads: tuple[str, ...], rows) -> list[str]:
    lines = [f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
    return lines + [f"| {' | '.join(cell(x) for x in row)} |" for row in rows]


class Verdict(NamedTuple):
    """`theirs` and `ours` are what is compared, the smaller the better, at equal `what`."""

    row: str
    what: str
    who: str
    theirs: float
    ours: float
