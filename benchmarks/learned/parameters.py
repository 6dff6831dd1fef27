"""What it costs to learn a family of equations instead of one: errors after the same training time.

    python benchmarks/learned/parameters.py            # writes ../results/parameters.json
    python benchmarks/learned/parameters.py --smoke    # toy sizes, to see that it runs

A damped spring that stiffens, with both parameters in `args`. The same network is trained for the
same time by the same recipe, once for the parameters in the middle and once over all of their
domain. Errors are those of a step of 0.5 and of a solve of 40 steps, at states and parameters that
were not trained on; for the network of fixed parameters, at these. Derivatives by the parameters of
the end of the solve are compared with those of the equation.
"""

import argparse
import dataclasses
import json
from pathlib import Path

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_conserve as dfc

jax.config.update("jax_enable_x64", True)
OUT = Path(__file__).parents[1] / "results" / "parameters.json"
STEP, STEPS = 0.5, 40
DOMAIN = dfc.learned.Box((0.05, 0.3), (0.25, 0.7))
MIDDLE = (jnp.array(0.15), jnp.array(0.5))


def field(t, y, args):
    damping, stiffening = args
    return jnp.stack([y[1], -damping * y[1] - y[0] - stiffening * y[0] ** 3])


def at_middle(t, y, args):
    return field(t, y, MIDDLE)


def sample(key):
    return jr.uniform(key, (2,), minval=-1.5, maxval=1.5)


def train(vector_field, args_domain, epochs, seconds, seed):
    states = jax.vmap(sample)(jr.split(jr.key(0), 500))
    network = dfc.DeepONet(
        states, STEP, width=32, depth=2, core=dfc.learned.Gated,
        taylor=dfc.learned.Taylor(vector_field), args_domain=args_domain, key=jr.key(seed),
    )  # fmt: skip
    recipe = dfc.learned.second_order(network, epochs=epochs)
    recipe = dataclasses.replace(recipe, points=200)
    return dfc.fit(
        network, vector_field, sample=sample, recipe=recipe, seconds=seconds, key=jr.key(seed + 1)
    )


@eqx.filter_jit
def judge(network, vector_field, y0s, argss):
    """Norms of the errors of one step, of the end of the solve, and of its derivatives."""
    term = dfx.ODETerm(vector_field)

    def solve(solver, dt, t1, y0, args):
        return dfx.diffeqsolve(
            term, solver, 0.0, t1, dt, y0, args, max_steps=1000, adjoint=dfx.ForwardMode()
        ).ys[0]

    def one(y0, args):
        learned, exact = dfc.DeepONetSolver(network), dfx.Dopri8()
        found = []
        for t1 in (STEP, STEP * STEPS):
            ends = solve(learned, STEP, t1, y0, args), solve(exact, STEP / 10, t1, y0, args)
            found.append(jnp.linalg.norm(ends[0] - ends[1]))
        slopes = [
            jnp.stack(jax.jacfwd(lambda a, s=s, dt=dt: solve(s, dt, STEP * STEPS, y0, a))(args))
            for s, dt in ((learned, STEP), (exact, STEP / 10))
        ]
        return *found, jnp.linalg.norm(slopes[0] - slopes[1]), jnp.linalg.norm(slopes[1])

    return jax.vmap(one)(y0s, argss)


def figures(network, log, vector_field, argss):
    y0s = jax.vmap(sample)(jr.split(jr.key(99), len(argss[0])))
    step, end, slope, size = map(np.asarray, judge(network, vector_field, y0s, argss))
    row = {"epochs": int(log.state.done), "training_seconds": log.seconds}
    row |= {"step_rms": float(np.sqrt(np.mean(step**2))), "end_median": float(np.median(end))}
    if np.any(size):
        row |= {"derivative_median": float(np.median(slope / size))}
    return row


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--smoke", action="store_true", help="toy sizes, nothing is written")
    smoke = parser.parse_args(argv).smoke
    epochs, count, seeds = (4, 3, 1) if smoke else (1000, 200, 1)
    drawn = jax.vmap(DOMAIN.sample)(jr.split(jr.key(98), count))
    middle = jax.tree.map(lambda x: jnp.full(count, x), MIDDLE)
    rows = []
    for seed in range(seeds):
        fixed, log = train(at_middle, None, epochs, None, 10 * seed)
        row = {"fixed": figures(fixed, log, at_middle, middle)}
        # SPRING anneals over its epochs, so the family gets as many, and its time is reported.
        family, log = train(field, DOMAIN, epochs, None, 10 * seed)
        row |= {"family": figures(family, log, field, drawn)}
        for what in ("training_seconds", "step_rms", "end_median"):
            row[f"ratio_{what}"] = row["family"][what] / row["fixed"][what]
        rows.append(row)
        print(json.dumps(row, indent=1), flush=True)
    if not smoke:
        OUT.write_text(json.dumps(rows, indent=1) + "\n")
    return rows


if __name__ == "__main__":
    main()
