"""What it is worth to keep the balance of energy and dissipated power.

1. The dissipated entropy of ARKODE, `u' = -e^u` with the entropy `e^u`, to t = 5: errors with fixed
   steps, plain and with the balance kept.
2. A pendulum with weak friction to t = 1,000, and one with stronger friction that is driven: errors
   of state and energy, steps and CPU seconds at tolerance 1e-6.

Writes `results/balance.json`.
"""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import measuring

import diffrax_conserve as dfc

EVERY_STEP = dfx.SaveAt(t0=True, steps=True, dense=True)


# ---- ARKODE's dissipated exponential entropy ----


def entropy_field(t, u, args):
    return -jnp.exp(u)


ENTROPY = dfc.FirstIntegral(lambda t, u, args: jnp.exp(u), rate=lambda t, u, args: -jnp.exp(2 * u))


@eqx.filter_jit
def entropy_error(solver, steps):
    """The error at the end, and the largest residual of the balance."""
    solution = dfx.diffeqsolve(
        dfx.ODETerm(entropy_field),
        solver,
        0.0,
        5.0,
        5.0 / steps,
        jnp.array(1.0),
        saveat=EVERY_STEP,
        max_steps=steps + 1,
    )
    end = solution.ys[steps]
    return jnp.abs(end + jnp.log(jnp.exp(-1.0) + 5)), jnp.max(jnp.abs(dfc.drift(solution, ENTROPY)))


def entropy(smoke):
    rows = []
    for solver in (dfx.Heun(),) if smoke else (dfx.Heun(), dfx.Bosh3(), dfx.Tsit5()):
        for steps in (50,) if smoke else (50, 100, 200, 400):
            plain, _ = entropy_error(solver, steps)
            kept, balance = entropy_error(dfc.ManifoldProjection(solver, ENTROPY), steps)
            rows.append(
                dict(
                    solver=type(solver).__name__,
                    steps=steps,
                    plain=float(plain),
                    kept=float(kept),
                    balance=float(balance),
                )
            )
            print(rows[-1], flush=True)
    return rows


# ---- The pendulum ----


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
Y0 = (jnp.array(1.0), jnp.array(0.0))


@eqx.filter_jit
def solve(solver, args, times, tolerance, saveat):
    return dfx.diffeqsolve(
        dfx.ODETerm(pendulum),
        solver,
        times[0],
        times[-1],
        None,
        Y0,
        args,
        saveat=saveat,
        stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
        max_steps=10**6,
    )


def reference(args, times):
    """Dopri8 at tolerance 1e-13, stepping exactly onto the times."""

    @eqx.filter_jit
    def exact(args, times):
        controller = dfx.ClipStepSizeController(
            dfx.PIDController(rtol=1e-13, atol=1e-13), step_ts=times
        )
        return dfx.diffeqsolve(
            dfx.ODETerm(pendulum),
            dfx.Dopri8(),
            times[0],
            times[-1],
            None,
            Y0,
            args,
            saveat=dfx.SaveAt(ts=times),
            stepsize_controller=controller,
            max_steps=10**6,
        ).ys

    return exact(args, times)


def pendulums(smoke):
    cases = {"weak friction": (0.001, 0.0), "stronger friction, driven": (0.05, 0.5)}
    if smoke:  # Arrays, for which all is compiled once.
        cases = jax.tree.map(jnp.asarray, cases)
    t1, count = (20.0, 41) if smoke else (1000.0, 2001)
    times, found = jnp.linspace(0.0, t1, count), {}
    solvers = {}
    for inner in (dfx.Tsit5(),) if smoke else (dfx.Bosh3(), dfx.Tsit5(), dfx.Dopri8()):
        solvers[type(inner).__name__, "plain"] = inner
        solvers[type(inner).__name__, "kept"] = dfc.ManifoldProjection(inner, BALANCE)
    for name, args in cases.items():
        exact = reference(args, times)
        rows = {key: judged(solver, args, times, exact) for key, solver in solvers.items()}
        clocks = timed(solvers, args, times)
        for key, row in rows.items():
            row["seconds"] = clocks[key].seconds
            numbers = {k: f"{v:.3g}" for k, v in row.items()}
            print(f"{name}, {' '.join(key)}: {numbers}", flush=True)
        found[name] = {" ".join(key): row for key, row in rows.items()}
    return found


def timed(solvers, args, times):
    runs = {
        key: lambda solver=solver: solve(solver, args, times, 1e-6, dfx.SaveAt(t1=True))
        for key, solver in solvers.items()
    }
    for run in runs.values():
        run()
    return measuring.take_turns(runs, rounds=5)


def judged(solver, args, times, exact):
    """The largest errors of state and energy, and the steps."""
    solution = solve(solver, args, times, 1e-6, dfx.SaveAt(ts=times))
    state = jnp.maximum(*jax.tree.map(lambda a, b: jnp.abs(a - b), solution.ys, exact))
    energies = jnp.abs(energy(times, solution.ys, args) - energy(times, exact, args))
    return dict(
        steps=int(solution.stats["num_steps"]),
        state=float(jnp.max(state)),
        energy=float(jnp.max(energies)),
    )


def main(argv=None):
    options = measuring.parser(__doc__, "balance").parse_args(argv)
    about = measuring.machine()
    measuring.print_machine(about)
    rows = entropy(options.smoke)
    cases = pendulums(options.smoke)
    measuring.write(options, about, entropy=rows, pendulum=cases)
    return dict(entropy=rows, pendulum=cases)


if __name__ == "__main__":
    main()
