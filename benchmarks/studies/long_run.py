"""Is the drift flat over a hundred million steps?

    python benchmarks/studies/long_run.py          # a minute and a quarter
    python benchmarks/studies/long_run.py --smoke  # 10,000 steps

A free rigid body with energy and angular momentum, by RK4 with steps of 1/64: with 10^8 steps 1.4
million turns, in float64 and in float32. The steps are solved in parts of at most 10^4, each from
time zero: in float32 diffrax jumps to the end of a solve from up to 1e-5 of its length away. The
conserved values are always those at the start of the first part. Drifts are computed from saved
states in long double, relative to these values. The table has the largest in each decade, of ten
states in each part. A projected drift of more than 16 units of roundoff, the tolerance of a
projection, is an error.
"""

import dataclasses
import os
import sys
import time

if __name__ == "__main__":
    # What the documentation recommends for single trajectories.
    flag = "xla_cpu_small_while_loop_byte_threshold=65536"
    os.environ.setdefault("XLA_FLAGS", f"--xla_backend_extra_options={flag}")

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import diffrax_conserve as dfc

jax.config.update("jax_enable_x64", True)

STEP, SAVED, PART = 1 / 64, 10, 10**4
DTYPES = {"float64": jnp.float64, "float32": jnp.float32}


def segments(count):
    """The numbers of steps that are solved one after the other, by decade."""
    found = {10**3: [10**3]}
    while max(found) < count:
        steps = max(found)
        found[10 * steps] = 9 * max(steps // PART, 1) * [min(steps, PART)]
    return found


@eqx.filter_jit
def solve(system, solver, y0, steps):
    """States along so many steps; the last is the end."""
    ts = STEP * steps * jnp.linspace(0, 1, SAVED + 1, dtype=y0.dtype)[1:]
    return dfx.diffeqsolve(
        dfx.ODETerm(system.vector_field), solver, 0.0, ts[-1], STEP, y0,
        saveat=dfx.SaveAt(ts=ts), max_steps=None, adjoint=dfx.ForwardMode(),
    ).ys  # fmt: skip


def fixed(manifold, y0):
    """The same integrals with the values at `y0`, wherever a solve starts."""
    return {
        name: dataclasses.replace(entry, value=entry.fn(0.0, y0, None))
        for name, entry in manifold.items()
    }


def drifts(system, y0, ys):
    """The larger of those of energy and angular momentum, relative, in long double."""
    ys, y0, inertia = (np.asarray(x).astype(np.longdouble) for x in (ys, y0, system.inertia))
    values = [(np.sum(y**2 / inertia, axis=-1), np.sum(y**2, axis=-1)) for y in (ys, y0)]
    return float(max(np.max(np.abs(v / v0 - 1)) for v, v0 in zip(*values, strict=True)))


def measure(count):
    rows = []
    for precision, dtype in DTYPES.items():
        system = jax.tree.map(lambda x, d=dtype: x.astype(d), dfc.systems.get("rigid-body"))
        y0 = system.y0.astype(dtype)
        projected = dfc.ManifoldProjection(dfc.RK4(), fixed(system.manifold, y0))
        for name, solver in {"RK4": dfc.RK4(), "projected": projected}.items():
            begun, y, drift = time.process_time(), y0, {}
            for end, lengths in segments(count).items():
                largest = 0.0
                for steps in lengths:
                    ys = solve(system, solver, y, jnp.asarray(steps, dtype))
                    assert ys.dtype == dtype
                    y, largest = ys[-1], max(largest, drifts(system, y0, ys))
                drift[f"{end:.0e}"] = largest
            seconds = round(time.process_time() - begun, 1)
            rows.append({"dtype": precision, "solver": name, "seconds": seconds, "drift": drift})
    return rows


def table(rows):
    lines = ["| steps | " + " | ".join(f"{r['solver']}, {r['dtype']}" for r in rows) + " |"]
    lines.append("|---" * (1 + len(rows)) + "|")
    for steps in rows[0]["drift"]:
        cells = [f"{r['drift'][steps]:.1e}" for r in rows]
        lines.append(f"| {steps.replace('e+0', 'e')} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main():
    rows = measure(10**4 if "--smoke" in sys.argv else 10**8)
    print(table(rows))
    for row in rows:
        drift = np.array([*row["drift"].values()]) / np.finfo(row["dtype"]).eps
        if not (np.all(drift < 16) if row["solver"] == "projected" else np.all(drift > 20)):
            raise SystemExit(f"{row['solver']}, {row['dtype']}: the drift is not as the page says")


if __name__ == "__main__":
    main()
