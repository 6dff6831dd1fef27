"""Errors of each body of a small solar system, with three metrics.

The Sun, Mercury, the Earth and Jupiter over five years, in astronomical units and years, with all
ten integrals. Mercury makes nearly all of the error of the energy, and weighs next to nothing, so
that the default metric corrects the Earth and Jupiter instead. The metric by errors is that of
`compare`: the inverse square of the error of each component without projection. The reference is
Dopri8 in steps of a thousandth of a year.

    python benchmarks/studies/planets.py
"""

import argparse

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import diffrax_conserve as dfc
from diffrax_conserve._diagnostics.comparison import by_errors

jax.config.update("jax_enable_x64", True)
GRAVITY = 4 * np.pi**2
MASSES = jnp.array([1.0, 1.66e-7, 3.0e-6, 9.55e-4])
# The half axis, the eccentricity and the inclination of the planets, each at its perihelion.
ORBITS = [(0.387, 0.2056, 7.0), (1.0, 0.0167, 0.0), (5.203, 0.0484, 1.3)]


def start():
    q, v = np.zeros((4, 3)), np.zeros((4, 3))
    for k, (a, e, degrees) in enumerate(ORBITS):
        tilt, speed = np.deg2rad(degrees), np.sqrt(GRAVITY / a * (1 + e) / (1 - e))
        q[k + 1] = a * (1 - e) * np.array([np.cos(k), np.sin(k), 0])
        along = np.array([-np.sin(k), np.cos(k)])
        v[k + 1] = speed * np.array([*along * np.cos(tilt), np.sin(tilt)])
    return jnp.asarray(q), jnp.asarray(v)


def field(t, y, args):
    q, v = y
    away = q[:, None] - q[None]
    cubes = (jnp.sum(away**2, -1) + jnp.eye(4)) ** 1.5
    weights = GRAVITY * MASSES * (1 - jnp.eye(4)) / cubes
    return v, -jnp.sum(weights[..., None] * away, axis=1)


def energy(t, y, args):
    q, v = y
    i, j = np.triu_indices(4, 1)
    potential = -GRAVITY * jnp.sum(MASSES[i] * MASSES[j] / jnp.linalg.norm(q[i] - q[j], axis=1))
    return MASSES @ jnp.sum(v**2, axis=1) / 2 + potential


KEPT = {
    "energy": dfc.FirstIntegral(energy),
    "momentum": dfc.FirstIntegral(lambda t, y, args: MASSES @ y[1]),
    "angular momentum": dfc.FirstIntegral(lambda t, y, args: MASSES @ jnp.cross(*y)),
    "centre": dfc.FirstIntegral(lambda t, y, args: MASSES @ (y[0] - t * y[1])),
}


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--smoke", action="store_true", help="a tenth of a year")
    t1 = 0.1 if parser.parse_args().smoke else 5.0
    times = dfx.SaveAt(ts=jnp.linspace(0, t1, 51))

    def solved(solver, **steps):
        return dfx.diffeqsolve(
            dfx.ODETerm(field),
            solver,
            0.0,
            t1,
            y0=start(),
            saveat=times,
            max_steps=100_000,
            **steps,
        ).ys

    exact = solved(dfx.Dopri8(), dt0=1e-3)
    print("| solver | metric | Mercury | the Earth | Jupiter |\n|---|---|---|---|---|")
    for solver, steps in (
        (dfc.RK4(), dict(dt0=2 / 365.25)),
        (dfx.Dopri8(), dict(dt0=None, stepsize_controller=dfx.PIDController(rtol=1e-8, atol=1e-8))),
    ):
        plain = solved(solver, **steps)
        weights = by_errors(*jax.tree.map(lambda x: np.asarray(x)[None], (plain, exact)))
        found = {"no projection": plain}
        for name, metric in {
            "default": None,
            "masses": 2 * (MASSES[:, None],),
            "by errors": weights,
        }.items():
            projection = dfc.SimplifiedNewton(metric=metric)
            projected = dfc.ManifoldProjection(solver, KEPT, projection=projection)
            found[name] = solved(projected, **steps)
        for name, ys in found.items():
            off = jnp.max(jnp.linalg.norm(ys[0] - exact[0], axis=2), axis=0)[1:]
            print(f"| {type(solver).__name__} | {name} |", " | ".join(f"{x:.1e}" for x in off), "|")


if __name__ == "__main__":
    main()
