"""What a gradient through a projected solve costs, against that through the plain one.

The gradient of the squared final state with respect to the initial state, three point vortices,
Tsit5, reverse mode with `RecursiveCheckpointAdjoint`.
"""

from functools import partial
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import measuring

import diffrax_conserve as dfc

SYSTEM = dfc.systems.PointVortices()


def gradient(solver: dfx.AbstractSolver, adaptive: bool) -> Any:
    controller = dfx.PIDController(rtol=1e-8, atol=1e-8) if adaptive else dfx.ConstantStepSize()

    def loss(y0: Any, t1: Any) -> jax.Array:
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

    return jax.vmap(jax.grad(loss), (0, None))


def measure(adaptive: bool, batch: int, t1: float, rounds: int) -> dict[str, Any]:
    y0 = jax.tree.map(lambda y: jnp.tile(y, (batch,) + (1,) * y.ndim), SYSTEM.y0)
    solvers = {
        "plain": dfx.Tsit5(),
        "projected": dfc.ManifoldProjection(dfx.Tsit5(), SYSTEM.manifold),
    }
    runs, compile_seconds = {}, {}
    for name, solver in solvers.items():
        executable, compile_seconds[name] = measuring.compiled(gradient(solver, adaptive), y0, t1)
        runs[name] = partial(executable, y0, t1)
    best = measuring.take_turns(runs, rounds)
    if not all(jnp.all(jnp.isfinite(result.answer)) for result in best.values()):
        raise AssertionError("a gradient is not finite")
    seconds = {name: result.seconds for name, result in best.items()}
    return dict(
        adaptive=adaptive,
        batch=batch,
        seconds=seconds,
        ratio=seconds["projected"] / seconds["plain"],
        compile_seconds=compile_seconds,
    )


def main(argv: list[str] | None = None) -> list[dict[str, Any]]:
    options = measuring.parser(__doc__, "gradients").parse_args(argv)
    smoke = options.smoke
    about = measuring.machine()
    measuring.print_machine(about)
    print("gradient, s: plain, projected, ratio; compilation, s: plain, projected")
    rows = []
    for adaptive in (True,) if smoke else (False, True):
        for batch in (8,) if smoke else (1, 100):
            label = f"{'adaptive' if adaptive else 'fixed':8} steps, batch of {batch:3d}"
            if options.only not in label:
                continue
            rows.append(measure(adaptive, batch, 1.0 if smoke else 20.0, 1 if smoke else 7))
            row = rows[-1]
            cells = [f"{x:.4f}" for x in row["seconds"].values()]
            compilation = [f"{x:.1f}" for x in row["compile_seconds"].values()]
            print(f"{label}: {' '.join(cells)} {row['ratio']:.2f}; {' '.join(compilation)}")
    measuring.write(options, about, rows=rows)
    return rows


if __name__ == "__main__":
    main()
