"""What it is worth to keep the balance of energy and dissipated power.

A pendulum with weak friction to t = 1,000, and one with stronger friction that is driven: the
largest errors of state and energy at tolerance 1e-6, and the steps.

Writes `results/balance.json`.
"""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import measuring

import diffrax_conserve as dfc

Y0 = (jnp.array(1.0), jnp.array(0.0))


def pendulum(t, y, args):
    (q, v), (friction, drive) = y, args
    return v, -jnp.sin(q) - friction * v + drive * jnp.cos(2 * t)


def energy(t, y, args):
    q, v = y
    return v**2 / 2 - jnp.cos(q)


def power(t, y, args):
    (_, v), (friction, drive) = y, args
    return drive * v * jnp.cos(2 * t) - friction * v**2


BALANCE = dfc.FirstIntegral(energy, rate=power)


@eqx.filter_jit
def solve(solver, args, times, tolerance, exactly=False):
    """`exactly` onto the times, or by the dense output between the steps."""
    controller = dfx.PIDController(rtol=tolerance, atol=tolerance)
    if exactly:
        controller = dfx.ClipStepSizeController(controller, step_ts=times)
    return dfx.diffeqsolve(
        dfx.ODETerm(pendulum), solver, times[0], times[-1], None, Y0, args,
        saveat=dfx.SaveAt(ts=times), stepsize_controller=controller, max_steps=10**6,
    )  # fmt: skip


def judged(solver, args, times, exact):
    solution = solve(solver, args, times, 1e-6)
    state = jnp.maximum(*jax.tree.map(lambda a, b: jnp.abs(a - b), solution.ys, exact))
    energies = jnp.abs(energy(times, solution.ys, args) - energy(times, exact, args))
    errors = dict(state=float(jnp.max(state)), energy=float(jnp.max(energies)))
    return dict(steps=int(solution.stats["num_steps"]), **errors)


def main(argv=None):
    options = measuring.parser(__doc__, "balance").parse_args(argv)
    about = measuring.machine()
    measuring.print_machine(about)
    cases = {"weak friction": (0.001, 0.0), "stronger friction, driven": (0.05, 0.5)}
    cases, found = jax.tree.map(jnp.asarray, cases), {}  # arrays, for which all is compiled once
    inners = (dfx.Tsit5(),) if options.smoke else (dfx.Bosh3(), dfx.Tsit5(), dfx.Dopri8())
    times = jnp.linspace(0.0, 20.0, 41) if options.smoke else jnp.linspace(0.0, 1000.0, 2001)
    for case, args in cases.items():
        exact = solve(dfx.Dopri8(), args, times, 1e-13, exactly=True).ys
        for inner in inners:
            kept = dfc.ManifoldProjection(inner, BALANCE)
            for kind, solver in (("plain", inner), ("kept", kept)):
                row = judged(solver, args, times, exact)
                found.setdefault(case, {})[f"{type(inner).__name__} {kind}"] = row
                print(f"{case}, {type(inner).__name__} {kind}: {row}", flush=True)
    measuring.write(options, about, pendulum=found)
    return found


if __name__ == "__main__":
    main()
