"""`RandomFeatureSolver`: how accurate and how fast, against the solvers of diffrax.

    python benchmarks/cost/random_features.py  # writes benchmarks/results/random_features.json
    python benchmarks/cost/random_features.py --smoke  # one tolerance, nothing is written

Errors are against closed forms where there are some, else against Dopri8 or, for stiff problems,
Kvaerno5 at tolerances near roundoff. Times are seconds of CPU of one compiled solve, the best of
several, so that a busy machine matters less; the load is recorded.
"""

import argparse
import functools as ft
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import measuring
import numpy as np
from jax.flatten_util import ravel_pytree

import diffrax_conserve as dfc
from diffrax_conserve.learned._solvers.feature_basis import feature_basis, tabulate
from diffrax_conserve.learned._solvers.random_features import StepEquations, solve

OUT = Path(__file__).parent.parent / "results" / "random_features.json"


class Problem(NamedTuple):
    vector_field: Callable
    y0: Any
    t1: float
    stiff: bool
    atol: float = 1.0  # relative to `rtol`


def robertson(t, y, args):
    a, b, c = y
    slow, fast, back = 0.04 * a, 3e7 * b**2, 1e4 * b * c
    return jnp.stack([back - slow, slow - back - fast, fast])


def van_der_pol(mu):
    return lambda t, y, args: jnp.stack([y[1], mu * (1 - y[0] ** 2) * y[1] - y[0]])


def problems(smoke):
    kepler, lorenz = dfc.systems.get("kepler"), dfc.systems.get("conservative-lorenz")
    vortices = dfc.systems.get("point-vortices")
    start = jnp.array([2.0, 0.0])
    found = {
        "kepler": Problem(kepler.vector_field, kepler.y0, 20.0, False),
        "conservative-lorenz": Problem(lorenz.vector_field, lorenz.y0, 25.0, False),
        "point-vortices": Problem(vortices.vector_field, vortices.y0, 10.0, False),
        "van der Pol, 100": Problem(van_der_pol(100.0), start, 200.0, True),
        "van der Pol, 1000": Problem(van_der_pol(1000.0), start, 2000.0, True),
        "Robertson": Problem(robertson, jnp.array([1.0, 0.0, 0.0]), 1e5, True, 1e-4),
    }
    return {"kepler": found["kepler"]._replace(t1=3.0)} if smoke else found


SOLVERS = {
    "Tsit5": dfx.Tsit5(),
    "Dopri8": dfx.Dopri8(),
    "Kvaerno5": dfx.Kvaerno5(),
    "8 features": dfc.RandomFeatureSolver(8),
    "12 features": dfc.RandomFeatureSolver(12),
    "16 features": dfc.RandomFeatureSolver(16),
}


def solvers(smoke):
    return {name: SOLVERS[name] for name in ("Tsit5", "8 features")} if smoke else SOLVERS


def timed(function, *arguments, rounds):
    """What the compiled function returns, its CPU seconds, and those of its compilation."""
    begin = measuring.clock()
    compiled = eqx.filter_jit(function).lower(*arguments).compile()
    compilation = measuring.clock() - begin
    best = measuring.take_turns({"": lambda: compiled(*arguments)}, rounds)[""]
    return best.answer, best.seconds, compilation


def adaptive(problem, solver, rtol, atol):
    return dfx.diffeqsolve(
        dfx.ODETerm(problem.vector_field),
        solver,
        0.0,
        problem.t1,
        None,
        problem.y0,
        stepsize_controller=dfx.PIDController(rtol=rtol, atol=atol),
        max_steps=10**6,
        throw=False,
    )


# ---- The targets of the issue ----


def targets(counts, rounds):
    """Relative L2 error of the state over the paper's horizon."""
    rows = []
    for name, step in (("harmonic-oscillator", 2.0), ("rigid-body", 0.5)):
        system = dfc.systems.get(name)
        ts = jnp.linspace(0, 30.0 if name == "harmonic-oscillator" else 1.75, 301)
        exact = np.asarray(system.solution(ts, system.y0))
        for features in counts:
            for tol in (None, 1e-12):

                def run(tol=tol, features=features, system=system, ts=ts, step=step):
                    controller = (
                        dfx.ConstantStepSize() if tol is None else dfx.PIDController(tol, tol)
                    )
                    return dfx.diffeqsolve(
                        dfx.ODETerm(system.vector_field),
                        dfc.RandomFeatureSolver(features),
                        0.0,
                        ts[-1],
                        step,
                        system.y0,
                        stepsize_controller=controller,
                        saveat=dfx.SaveAt(ts=ts),
                    )

                sol, seconds, compilation = timed(run, rounds=rounds)
                rows.append(
                    dict(
                        system=name,
                        features=features,
                        steps="fixed" if tol is None else "adaptive",
                        num_steps=int(sol.stats["num_steps"]),
                        error=float(np.linalg.norm(sol.ys - exact) / np.linalg.norm(exact)),
                        seconds=seconds,
                        compile_seconds=compilation,
                    )
                )
                print_row(rows[-1])
    return rows


# ---- Against other solvers ----


def reference(problem):
    solver = dfx.Kvaerno5() if problem.stiff else dfx.Dopri8()
    tol = 3e-12 if problem.stiff else 1e-14
    return eqx.filter_jit(adaptive)(problem, solver, tol, tol * problem.atol).ys


def comparison(name, problem, candidates, tolerances, rounds):
    """Cost, and the error at the end, weighted as the controller does: by `|y| + atol / rtol`."""
    exact = reference(problem)
    rows = []
    for tol in tolerances:
        for label, solver in candidates.items():
            if problem.t1 >= 1000 and label in ("Tsit5", "Dopri8"):
                continue  # millions of steps
            sol, seconds, compilation = timed(
                adaptive, problem, solver, tol, tol * problem.atol, rounds=rounds
            )
            errors = jax.tree.map(
                lambda a, b: float(jnp.max(jnp.abs(a - b) / (jnp.abs(b) + problem.atol))),
                sol.ys,
                exact,
            )
            rows.append(
                dict(
                    problem=name,
                    tolerance=tol,
                    solver=label,
                    error=max(jax.tree.leaves(errors)),
                    seconds=seconds,
                    compile_seconds=compilation,
                    accepted=int(sol.stats["num_accepted_steps"]),
                    rejected=int(sol.stats["num_rejected_steps"]),
                    okay=bool(sol.result == dfx.RESULTS.successful),
                )
            )
            print_row(rows[-1])
    return rows


# ---- Against polynomials in the place of the features ----


def polynomials(count, names):
    """The largest component of the error of one step, by length of the step."""
    wide = count + -(-count // 2)
    legendre = np.eye(80, wide) * np.sqrt(2 * np.arange(80) + 1)[:, None]
    bases = {
        "features": feature_basis(count),
        "polynomials": tabulate(count, legendre),
    }
    rows = []
    for name in names:
        system = dfc.systems.get(name)
        y0, unravel = ravel_pytree(system.y0)

        def end(h, basis, system=system, y0=y0, unravel=unravel):
            def increment(s, y):
                return h * ravel_pytree(system.vector_field(s * h, unravel(y), None))[0]

            return y0 + solve(StepEquations(basis, increment, y0))[0][0]

        ends = {label: jax.jit(ft.partial(end, basis=basis)) for label, basis in bases.items()}
        for step in np.geomspace(1, 16, 5) * 2 * system.dt:
            states = system.solution(jnp.array([0.0, step]), system.y0)
            exact = ravel_pytree(jax.tree.map(lambda y: y[1], states))[0]
            errors = {
                label: float(jnp.max(jnp.abs(end(step) - exact))) for label, end in ends.items()
            }
            rows.append(dict(system=name, members=count, step=float(step), **errors))
            print_row(rows[-1])
    return rows


# ---- Energy, in long fixed steps ----


def energies(names, rounds, horizon):
    """Largest drift of the energy, and of what is not kept, without projection."""
    rows = []
    for name in names:
        system = dfc.systems.get(name)
        for label in ("Dopri8", "8 features"):

            def run(system=system, solver=SOLVERS[label]):
                return dfx.diffeqsolve(
                    dfx.ODETerm(system.vector_field),
                    solver,
                    0.0,
                    horizon,
                    0.25,
                    system.y0,
                    saveat=dfx.SaveAt(steps=True),
                    max_steps=int(4 * horizon),
                )

            sol, seconds, _ = timed(run, rounds=rounds)
            drifts = dfc.drift(sol, system.manifold)
            largest = {
                key: float(jnp.max(jnp.abs(jnp.asarray(value)))) for key, value in drifts.items()
            }
            rows.append(dict(system=name, solver=label, dt=0.25, drift=largest, seconds=seconds))
            print_row(rows[-1])
    return rows


def print_row(row):
    print(
        "  ".join(f"{k} {v:.2e}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()),
        flush=True,
    )


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--smoke", action="store_true", help="toy sizes, nothing is written")
    parser.add_argument("--out", type=Path, help="where to write the figures")
    options = parser.parse_args(argv)
    rounds = 1 if options.smoke else 5
    counts = (16,) if options.smoke else (8, 12, 16)
    tolerances = (1e-6,) if options.smoke else (1e-4, 1e-6, 1e-8, 1e-10)
    horizon = 5.0 if options.smoke else 100.0
    exact = ["harmonic-oscillator", "rigid-body", "kepler"]
    hamiltonian = ["henon-heiles", "toda-lattice", "double-pendulum", "kepler"]
    found: dict[str, Any] = dict(
        device=jax.devices()[0].device_kind,
        jax=jax.__version__,
        load_before=os.getloadavg(),
        targets=targets(counts, rounds),
        comparison=[
            row
            for name, problem in problems(options.smoke).items()
            for row in comparison(name, problem, solvers(options.smoke), tolerances, rounds)
        ],
        polynomials=[
            row
            for count in counts
            for row in polynomials(count, exact[: 1 if options.smoke else 3])
        ],
        energy=energies(hamiltonian[: 1 if options.smoke else None], rounds, horizon),
        load_after=os.getloadavg(),
    )
    out = options.out or (None if options.smoke else OUT)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps(found, indent=1) + "\n")
    return found


if __name__ == "__main__":
    main()
