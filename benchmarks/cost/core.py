"""What a projection costs beside the same solve without one, with one to seven integrals: time to
trace and compile, time of a step, and kernels, alone and in a batch of 64.

`XLA_FLAGS= python benchmarks/cost/core.py` for the default flags of XLA.
"""

import measuring  # isort: skip  (it sets XLA's options)

import re
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_conserve as dfc

BATCH = 64


class Program(NamedTuple):
    """A solve: of what, by which method, with how many steps, and what is saved."""

    vector_field: Callable[..., Any]
    manifold: Any
    y0: Any
    solver: Any
    t1: float
    dt: float | None
    saveat: Callable[[], dfx.SaveAt]


def _end() -> dfx.SaveAt:
    return dfx.SaveAt(t1=True)


def _pendulum() -> Program:
    energy = dfc.FirstIntegral(lambda t, y, args: 0.5 * y[1] ** 2 - jnp.cos(y[0]))
    field = lambda t, y, args: jnp.stack([y[1], -jnp.sin(y[0])])  # noqa: E731
    return Program(field, energy, jnp.array([1.5, 0.0]), dfc.RK4(), 200.0, 0.02, _end)


def _system(
    system: Any, solver: Any, t1: float, dt: float | None, saveat: Callable = _end
) -> Program:
    return Program(system.vector_field, system.manifold, system.y0, solver, t1, dt, saveat)


def programs(smoke: bool) -> dict[str, Program]:
    share = 0.02 if smoke else 1.0
    at = jnp.linspace(0.0, 20.0 * share, 11)
    kepler = partial(_system, dfc.systems.Kepler(), dfx.Tsit5(), 20.0 * share, None)
    vortices = _system(
        dfc.systems.PointVortices(),
        dfx.Tsit5(),
        10.0 * share,
        None,
        lambda: dfx.SaveAt(t1=True, dense=True),
    )
    found = {
        "pendulum": _pendulum()._replace(t1=200.0 * share),
        "rigid body": _system(dfc.systems.RigidBody(), dfc.RK4(), 200.0 * share, 0.02),
        "kepler, ts": kepler(lambda: dfx.SaveAt(ts=at)),
        "kepler, t1": kepler(),
        "vortices, dense": vortices,
        "solar system": _system(
            dfc.systems.OuterSolarSystem(), dfc.RK4(), 200_000.0 * share, 100.0
        ),
    }
    return found


def solve(program: Program, projected: bool, y0: Any) -> Any:
    solver = program.solver
    if projected:
        solver = dfc.ManifoldProjection(solver, program.manifold)
    adaptive = program.dt is None
    solution = dfx.diffeqsolve(
        dfx.ODETerm(program.vector_field),
        solver,
        t0=0.0,
        t1=program.t1,
        dt0=program.dt,
        y0=y0,
        saveat=program.saveat(),
        stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6)
        if adaptive
        else dfx.ConstantStepSize(),
        max_steps=4096 if program.saveat().dense else None,
        adjoint=dfx.RecursiveCheckpointAdjoint() if program.saveat().dense else dfx.ForwardMode(),
        throw=False,
    )
    dense = jnp.zeros(())
    if solution.interpolation is not None:
        dense = solution.evaluate(0.37 * program.t1)
    return (
        solution.ys,
        dense,
        solution.stats["num_steps"],
        solution.result == dfx.RESULTS.successful,
    )


def states(program: Program, batch: int | None) -> Any:
    if batch is None:
        return program.y0
    return jax.tree.map(
        lambda x: x * (1 + 0.02 * jr.normal(jr.key(0), (batch, *x.shape))), program.y0
    )


def measure(program: Program, batch: int | None, rounds: int) -> dict[str, Any]:
    y0 = states(program, batch)
    compiled, seconds, kernels = {}, {}, {}
    for projected in (False, True):
        fn = partial(solve, program, projected)
        fn = fn if batch is None else jax.vmap(fn)
        best = np.inf
        for _ in range(min(rounds, 3)):
            jax.clear_caches()
            executable, took = measuring.compiled(lambda y, fn=fn: fn(y), y0)
            best = min(best, took)
        compiled[projected], seconds[projected] = executable, best
        kernels[projected] = _kernels(executable.as_text())
    runs = {projected: partial(program, y0) for projected, program in compiled.items()}
    repeated = {k: partial(_repeat, run, run()) for k, run in runs.items()}
    times = measuring.take_turns(repeated, rounds)
    ns, steps = {}, {}
    for projected, found in times.items():
        (_, _, made, ok), repeats = found.answer
        if not bool(jnp.all(ok)):
            raise AssertionError("a solve failed")
        steps[projected] = int(jnp.sum(made))
        ns[projected] = found.seconds / repeats * 1e9
    return dict(
        compile_plain=seconds[False],
        compile=seconds[True],
        compile_ratio=seconds[True] / seconds[False],
        us_plain=ns[False] / 1e3,
        us=ns[True] / 1e3,
        step_plain=ns[False] / steps[False],
        step=ns[True] / steps[True],
        step_ratio=(ns[True] / steps[True]) / (ns[False] / steps[False]),
        run_ratio=ns[True] / ns[False],
        kernels_plain=kernels[False],
        kernels=kernels[True],
    )


def _repeat(run: Callable[[], Any], first: Any) -> Any:
    """Short solves are repeated; what is timed has the call in it, as a user has."""
    repeats = max(1, 20_000 // max(1, int(np.sum(first[2]))))
    for _ in range(repeats - 1):
        run()
    return run(), repeats


def _kernels(text: str) -> int:
    """Fusions, calls and loops over elements outside of them, in the whole program."""
    bodies = re.sub(r"(?ms)^%?(fused_computation|region)\S* .*?^}", "", text)
    return len(re.findall(r"= \S+ (?:fusion|custom-call|call|dot|reduce|sort)\(", bodies))


def main() -> None:
    options = measuring.parser(__doc__ or "", "core").parse_args()
    about = measuring.machine()
    measuring.print_machine(about)
    jax.jit(lambda x: x + 1).lower(1.0).compile()
    rows = []
    print(f"{'':24} {'compile (s)':>17} {'ratio':>6} {'ns a step':>19} {'ratio':>6} {'kernels':>9}")
    chosen = list(programs(options.smoke).items())[: 2 if options.smoke else None]
    for number, (name, program) in enumerate(chosen):
        batches = (None, BATCH)
        for batch in [batches[number % 2]] if options.smoke else batches:
            label = f"{name}, {'alone' if batch is None else batch}"
            if not re.search(options.only, label):
                continue
            row = measure(program, batch, 1 if options.smoke else 5)
            rows.append(dict(name=name, batch=batch or 1, **row))
            print(
                f"{label:24} {row['compile_plain']:8.2f} {row['compile']:8.2f} "
                f"{row['compile_ratio']:6.2f} {row['step_plain']:9,.0f} {row['step']:9,.0f} "
                f"{row['step_ratio']:6.2f} {row['kernels_plain']:4d} {row['kernels']:4d}"
                f"   run {row['run_ratio']:.2f}",
                flush=True,
            )
    ratios = [row["compile_ratio"] for row in rows]
    if ratios:
        print(f"compilation, median {np.median(ratios):.2f}, worst {max(ratios):.2f}")
    measuring.write(options, about, rows=rows)


if __name__ == "__main__":
    main()
