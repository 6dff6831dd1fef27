"""What a gradient through a projected solve costs, against that through the plain one.

The gradient of the squared final state with respect to the initial state, three point vortices,
Tsit5, reverse mode with `RecursiveCheckpointAdjoint`. Plain and projected take turns; each counts
with its best round. Seconds of CPU time, so that a busy machine matters less.
"""

import argparse
import time

import diffrax as dfx
import jax
import jax.numpy as jnp

import diffrax_conserve as dfc

jax.config.update("jax_enable_x64", True)

SYSTEM = dfc.systems.PointVortices()


def gradient(solver, adaptive):
    controller = dfx.PIDController(rtol=1e-8, atol=1e-8) if adaptive else dfx.ConstantStepSize()

    def loss(y0, t1):
        sol = dfx.diffeqsolve(
            dfx.ODETerm(SYSTEM.vector_field),
            solver,
            0.0,
            t1,
            None if adaptive else 0.1,
            y0,
            SYSTEM.args,
            stepsize_controller=controller,
            max_steps=1024,
        )
        return sum(jnp.sum(y**2) for y in jax.tree.leaves(sol.ys))

    return jax.grad(loss)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--smoke", action="store_true", help="one round, short solves")
    smoke = parser.parse_args().smoke
    t1 = jnp.asarray(1.0 if smoke else 20.0)
    solvers = {
        "plain": dfx.Tsit5(),
        "projected": dfc.ManifoldProjection(dfx.Tsit5(), SYSTEM.manifold),
    }
    print("gradient, s of CPU: plain, projected, ratio; compile time, s: plain, projected")
    for adaptive in (True,) if smoke else (False, True):
        for batch in (8,) if smoke else (1, 100):
            y0 = jax.tree.map(lambda y, n=batch: jnp.tile(y, (n,) + (1,) * y.ndim), SYSTEM.y0)
            compiled, compile_seconds, best = {}, {}, {}
            for name, solver in solvers.items():
                started = time.process_time()
                batched = jax.jit(jax.vmap(gradient(solver, adaptive), (0, None)))
                compiled[name] = batched.lower(y0, t1).compile()
                compile_seconds[name] = time.process_time() - started
            for _ in range(1 if smoke else 7):
                for name, run in compiled.items():
                    started = time.process_time()
                    jax.block_until_ready(run(y0, t1))
                    seconds = time.process_time() - started
                    best[name] = min(best.get(name, seconds), seconds)
            label = f"{'adaptive' if adaptive else 'fixed':8} steps, batch of {batch:3d}"
            print(
                f"{label}: {best['plain']:.4f} {best['projected']:.4f} "
                f"{best['projected'] / best['plain']:.2f}; "
                f"{compile_seconds['plain']:.1f} {compile_seconds['projected']:.1f}"
            )


if __name__ == "__main__":
    main()
