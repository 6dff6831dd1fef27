"""The first call of a solve of ten systems, and what an option of XLA's compiler does to it.

Each system is solved by adaptive Tsit5 alone, projected, and projected with XLA's older emitters
for CPUs, `jax.jit(solve, compiler_options={"xla_cpu_use_fusion_emitters": False})`, which JAX takes
for the outermost `jit` alone. The first call is the time to trace, to lower and to compile, the
least of three. Run times are the best of many runs in turns.

Writes `results/compiler_option.json`.
"""

import diffrax as dfx
import jax
import measuring

import diffrax_conserve as dfc

OPTION = {"xla_cpu_use_fusion_emitters": False}
SYSTEMS = (
    *(dfc.systems.CartesianPendulum, dfc.systems.RigidBody, dfc.systems.Kepler),
    *(dfc.systems.PointVortices, dfc.systems.OuterSolarSystem, dfc.systems.HenonHeiles),
    *(dfc.systems.LotkaVolterra, dfc.systems.TodaLattice, dfc.systems.ConservativeLorenz),
    dfc.systems.DoublePendulum,
)


def program(system, solver):
    steps = dfx.PIDController(rtol=1e-6, atol=1e-8)
    term, end = dfx.ODETerm(system.vector_field), float(system.t1) / 10

    def solve(y0):
        options = dict(stepsize_controller=steps, adjoint=dfx.ForwardMode(), max_steps=None)
        return dfx.diffeqsolve(term, solver, 0.0, end, end / 1e3, y0, system.args, **options).ys

    return solve


def judged(system, repeats):
    kept = dfc.ManifoldProjection(dfx.Tsit5(), system.manifold)
    kinds = {
        "plain": (program(system, dfx.Tsit5()), {}),
        "projected": (program(system, kept), {}),
        "with the option": (program(system, kept), OPTION),
    }
    first, runs = dict.fromkeys(kinds, float("inf")), {}
    for _ in range(repeats):
        for kind, (solve, option) in kinds.items():
            jax.clear_caches()  # so that each traces what they share
            jitted = jax.jit(solve, compiler_options=option)
            done = measuring.timed(lambda x=jitted: x.lower(system.y0).compile())
            first[kind] = min(first[kind], done.seconds)
            runs[kind] = lambda x=done.answer: x(system.y0)
    again = measuring.take_turns(runs, rounds=3 if repeats == 1 else 20)
    return {kind: dict(first=first[kind], seconds=again[kind].seconds) for kind in kinds}


def main(argv=None):
    options = measuring.parser(__doc__, "compiler_option").parse_args(argv)
    about, found = measuring.machine(), {}
    measuring.print_machine(about)
    for kind in SYSTEMS[:1] if options.smoke else SYSTEMS:
        system = kind()
        if options.only not in system.name:
            continue
        row = found[system.name] = judged(system, 1 if options.smoke else 3)
        print(system.name, {k: {n: f"{x:.3g}" for n, x in v.items()} for k, v in row.items()})
    measuring.write(options, about, systems=found)


if __name__ == "__main__":
    main()
