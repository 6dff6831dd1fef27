"""E: heyoka's page on projection: the outer solar system over 100,000 years at tolerance 1e-6.

The set-up is that of the notebook `doc/notebooks/projection.ipynb` of heyoka.py (version 7): Sun,
Jupiter to Neptune and Pluto, in astronomical units and years, a Taylor method at tolerance 1e-6,
and after each step whose energy is off by more than 1e-6 a projection by SLSQP of scipy.
Published: 3,765 projections in 108,881 steps, the energy within 1e-6. Ours keep the energy, or all
seven integrals, at roundoff. The states are judged at 1,000 times by heyoka at tolerance 1e-20,
which is below roundoff; how far a second such solve, at 1e-18, is from the first says how good
that is.
"""

import time

import common
import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import diffrax_conserve as dfc

SOURCE = "heyoka.py, doc/notebooks/projection.ipynb, version 7"
PUBLISHED = dict(projections=3_765, steps=108_881, energy=1e-6)
YEAR = 365.0
GRAVITY = (0.01720209895 * YEAR) ** 2
PARTS = np.array([1047.355, 3501.6, 22869.0, 19314.0])  # of the mass of the Sun
MASSES = np.array([1.00000597682, *(1 / PARTS), 7.4074074e-09])
# Places in astronomical units and velocities in those a day: Sun, Jupiter, Saturn, Uranus, Neptune
# and Pluto.
BODIES = """
-4.06428567034226e-3 -6.08813756435987e-3 -1.66162304225834e-6
+6.69048890636161e-6 -6.33922479583593e-6 -3.13202145590767e-9
+3.40546614227466e0 +3.62978190075864e0 +3.42386261766577e-2
-5.59797969310664e-3 +5.51815399480116e-3 -2.66711392865591e-6
+6.60801554403466e0 +6.38084674585064e0 -1.36145963724542e-1
-4.17354020307064e-3 +3.99723751748116e-3 +1.67206320571441e-5
+1.11636331405597e1 +1.60373479057256e1 +3.61783279369958e-1
-3.25884806151064e-3 +2.06438412905916e-3 -2.17699042180559e-5
-3.01777243405203e1 +1.91155314998064e0 -1.53887595621042e-1
-2.17471785045538e-4 -3.11361111025884e-3 +3.58344705491441e-5
-2.13858977531573e1 +3.20719104739886e1 +2.49245689556096e0
-1.76936577252484e-3 -2.06720938381724e-3 +6.58091931493844e-4
"""
START = np.array(BODIES.split(), float).reshape(6, 2, 3) * np.array([1, YEAR])[:, None]


# ---- The equations, for ours ----


def field(t, y, args):
    q, v = y
    apart = q[:, None] - q[None]
    # The distance of a body from itself is one instead of zero.
    cubes = (jnp.sum(apart**2, axis=-1) + jnp.eye(6)) ** 1.5
    return v, -GRAVITY * jnp.einsum("j,ijk->ik", MASSES, apart / cubes[:, :, None])


def energy(t, y, args):
    q, v = y
    i, j = np.triu_indices(6, 1)
    distance = jnp.linalg.norm(q[i] - q[j], axis=1)
    kinetic = jnp.sum(MASSES[:, None] * v**2) / 2
    return kinetic - GRAVITY * jnp.sum(MASSES[i] * MASSES[j] / distance)


def momentum(t, y, args):
    return MASSES @ y[1]


def angular_momentum(t, y, args):
    return MASSES @ jnp.cross(*y)


INTEGRALS = {
    "energy": dfc.FirstIntegral(energy),
    "momentum": dfc.FirstIntegral(momentum),
    "angular momentum": dfc.FirstIntegral(angular_momentum),
}


@jax.jit
@jax.vmap
def values(q, v):
    return energy(0, (q, v), None), momentum(0, (q, v), None), angular_momentum(0, (q, v), None)


def judged(states, exact):
    """The largest errors over the times: of a place, of the energy and of the momenta."""
    q, v = np.moveaxis(np.asarray(states).reshape(-1, 6, 2, 3), 2, 0)
    found = [np.asarray(x) for x in values(q, v)]
    first = [np.asarray(x)[0] for x in values(*np.moveaxis(START[None], 2, 0))]
    scales = [
        abs(first[0]),
        np.sum(MASSES * np.linalg.norm(START[:, 1], axis=1)),
        np.linalg.norm(first[2]),
    ]
    off = [float(np.max(np.abs(x - y))) / s for x, y, s in zip(found, first, scales, strict=True)]
    row = dict(zip(("energy", "momentum", "angular momentum"), off, strict=True))
    if exact is not None:
        apart = (
            np.asarray(states).reshape(-1, 6, 2, 3)[:, :, 0] - exact.reshape(-1, 6, 2, 3)[:, :, 0]
        )
        row["error"] = float(np.max(np.linalg.norm(apart, axis=-1)))
    return row


def ours(kept, tolerance, times):
    manifold = {name: INTEGRALS[name] for name in kept}
    solver = dfc.ManifoldProjection(dfx.Dopri8(), manifold) if kept else dfx.Dopri8()
    y0, both = tuple(jnp.moveaxis(jnp.asarray(START), 1, 0)), (jnp.array(tolerance),) * 2

    def run(times):
        saveat = dfx.SaveAt(ts=jnp.asarray(times))
        t1 = jnp.asarray(times[-1])
        found = common.solve(field, solver, y0, t1, *both, saveat, max_steps=10**7)
        return jax.block_until_ready(found)

    run(times / 1000)  # compiles
    begin = time.process_time()
    found = run(times)
    seconds = time.process_time() - begin
    states = np.stack([np.asarray(leaf) for leaf in found.ys], axis=2)
    steps = int(found.stats["num_accepted_steps"])
    return states, dict(steps=steps, seconds=seconds, tolerance=tolerance)


# ---- heyoka ----


def heyoka(tolerance, times, project=False):
    import heyoka as hy
    from scipy.optimize import minimize

    system = hy.model.nbody(6, masses=MASSES, Gconst=GRAVITY)
    unknowns = [variable for variable, _ in system]
    integrator = hy.taylor_adaptive(system, START.ravel(), tol=tolerance)
    expression = hy.model.nbody_energy(6, masses=MASSES, Gconst=GRAVITY)
    gradient = [hy.diff(expression, x) for x in unknowns]
    of_energy = hy.cfunc([expression], vars=unknowns)
    of_gradient = hy.cfunc(gradient, vars=unknowns)
    value, projections = of_energy(integrator.state)[0], 0

    def tests_left_after_step(integrator):
        """Brings the energy back if it is off by more than 1e-6."""
        nonlocal projections
        if abs(of_energy(integrator.state)[0] / value - 1) > 1e-6:
            candidate = integrator.state.copy()
            found = minimize(
                lambda y: (np.sum((y - candidate) ** 2), 2 * (y - candidate)),
                candidate,
                jac=True,
                method="SLSQP",
                tol=1e-10,
                constraints=dict(
                    type="eq", fun=lambda y: of_energy(y)[0] - value, jac=lambda y: of_gradient(y)
                ),
            )
            integrator.state[:] = found.x
            projections += 1
        return True

    begin = time.process_time()
    found = integrator.propagate_grid(times, callback=tests_left_after_step if project else None)
    seconds = time.process_time() - begin
    row = dict(steps=int(found[3]), seconds=seconds, tolerance=tolerance)
    return found[-1], row | (dict(projections=projections) if project else {})


def measure(smoke):
    times = np.linspace(0, 500.0 if smoke else 1e5, 20 if smoke else 1000)
    runs, exact, reference = {}, None, None
    try:
        exact, row = heyoka(1e-20, times)
        reference = judged(heyoka(1e-18, times)[0], exact)["error"]
        runs["heyoka"] = lambda: heyoka(1e-6, times)
        runs["heyoka, energy by SLSQP"] = lambda: heyoka(1e-6, times, project=True)
        runs["heyoka, default tolerance"] = lambda: heyoka(2.0**-52, times)
    except ImportError:
        print("heyoka is not installed")
    everything = tuple(INTEGRALS)
    if not smoke:
        runs["Dopri8, plain"] = lambda: ours((), 1e-6, times)
        runs["Dopri8, energy"] = lambda: ours(("energy",), 1e-6, times)
    for tolerance in (1e-6,) if smoke else (1e-6, 1e-9, 1e-12):
        name = f"Dopri8, all integrals, {tolerance:.0e}"
        runs[name] = lambda tolerance=tolerance: ours(everything, tolerance, times)
    rows = []
    for name, run in runs.items():
        states, row = run()
        rows.append(dict(program=name, **row, **judged(states, exact)))
        common.show(rows[-1])
    return dict(source=SOURCE, published=PUBLISHED, reference=reference, rows=rows)


# ---- The page ----


def table(results):
    heads = (
        "program",
        "tolerance",
        "steps",
        "seconds",
        "energy",
        "momentum",
        "error of a place, AU",
    )
    rows = [
        (
            x["program"].split(", 1e-")[0],
            f"{x['tolerance']:.0e}",
            x["steps"],
            x["seconds"],
            x["energy"],
            max(x["momentum"], x["angular momentum"]),
            x["error"],
        )
        for x in results["rows"]
    ]
    published = results["published"]
    first = (
        "heyoka, energy by SLSQP, published",
        "1e-06",
        published["steps"],
        None,
        "1e-6",
        None,
        None,
    )
    return common.markdown(heads, [first, *rows])


def verdicts(results):
    rows = {x["program"]: x for x in results["rows"]}
    a, b = rows["heyoka, energy by SLSQP"], rows["Dopri8, all integrals, 1e-06"]
    for what in ("energy", "error", "seconds"):
        yield common.Verdict(
            "heyoka, outer solar system", f"{what} at tolerance 1e-6", "heyoka", a[what], b[what]
        )
    for what in ("error", "seconds"):
        yield common.Verdict(
            "heyoka, outer solar system",
            f"{what} at tolerance 1e-6",
            "heyoka, no projection",
            rows["heyoka"][what],
            b[what],
        )
    tight, best = rows["heyoka, default tolerance"], rows["Dopri8, all integrals, 1e-12"]
    for what in ("error", "seconds"):
        yield common.Verdict(
            "heyoka, outer solar system", f"{what}, tight", "heyoka", tight[what], best[what]
        )


def main(argv=None):
    return common.main("heyoka_page", __doc__, measure, argv)


if __name__ == "__main__":
    main()
