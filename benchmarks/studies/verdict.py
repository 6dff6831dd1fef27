"""Is what `compare` names the best? Verdicts from one start and from a few, judged on others.

    python benchmarks/studies/verdict.py                # one row for each problem, an hour
    python benchmarks/studies/verdict.py --only kepler  # the problems whose names hold this text
    python benchmarks/studies/verdict.py --smoke        # toy sizes

A row has the problem, the solver, and what is named from one start and from eight random ones. The
number behind it is the error of that choice over the least error of all that are compared, in the
geometric mean of eight other starts, over an interval that is 1.5 times as long for adaptive steps:
at most 1.5 is the target. The last columns are the error of the second choice over that without
projection, in the mean and at worst, both on the other starts.
"""

import argparse
import contextlib
import time
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_conserve as dfc

jax.config.update("jax_enable_x64", True)

SMOKE = False
LANES, LONGER = 8, 1.5


class Problem(NamedTuple):
    name: str
    field: Any
    manifold: Any
    sample: Any  # of a key
    y0: Any
    solver: Any
    t1: float
    dt0: float | None = None
    tol: float | None = None
    metric: Any = None
    projection: Any = None


def tolerances(problem):
    if problem.tol is None:
        return {"dt0": problem.dt0}
    return {"rtol": problem.tol, "atol": problem.tol * (1e-4 if stiff(problem) else 1)}


def stiff(problem):
    return isinstance(problem.solver, dfx.AbstractImplicitSolver)


# ---- The catalogue ----


def of_catalogue(name, solver, *, t1=None, dt0=None, tol=None):
    system = dfc.systems.get(name)
    projection = system.mechanism.positive_projection() if hasattr(system, "mechanism") else None
    return Problem(
        name, system.vector_field, system.manifold, system.sample, system.y0, solver,
        system.t1 if t1 is None else t1, dt0, tol, system.metric, projection,
    )  # fmt: skip


# ---- A disk that rolls without slip ----

MASS, RADIUS, GRAVITY = 2.0, 0.3, 9.81
INERTIA = jnp.array([MASS * RADIUS**2 / 4, MASS * RADIUS**2 / 4, MASS * RADIUS**2 / 2])


def turned(q, x):
    return x + 2 * jnp.cross(q[1:], jnp.cross(q[1:], x) + q[0] * x)


def lowest(q):
    """From the centre to the contact."""
    n = turned(q, jnp.array([0.0, 0.0, 1.0]))
    d = jnp.array([0.0, 0.0, -1.0]) + n[2] * n
    return RADIUS * d / jnp.linalg.norm(d)


def falling(t, y, args):
    q, w = y["q"], y["w"]
    turn = jnp.concatenate([-(q[1:] @ w)[None], q[0] * w + jnp.cross(q[1:], w)]) / 2
    force = jnp.array([0.0, 0.0, -GRAVITY])
    return {"c": y["v"], "q": turn, "v": force, "w": jnp.cross(INERTIA * w, w) / INERTIA}


def slip(t, y, args):
    return y["v"] + jnp.cross(turned(y["q"], y["w"]), lowest(y["q"]))


def disk_energy(t, y, args):
    kinetic = MASS * y["v"] @ y["v"] / 2 + jnp.sum(INERTIA * y["w"] ** 2) / 2
    return kinetic + MASS * GRAVITY * y["c"][2]


def disk():
    rolling = dfc.Constraint(slip)
    weights = {"c": jnp.inf, "q": jnp.inf, "v": MASS, "w": INERTIA}
    manifold = {
        "rolling": rolling,
        "height": dfc.Constraint(lambda t, y, args: y["c"][2] + lowest(y["q"])[2]),
        "quaternion": dfc.Constraint(lambda t, y, args: y["q"] @ y["q"] - 1),
        "energy": dfc.FirstIntegral(disk_energy),
    }

    def start(tilt, w):
        q = jnp.array([jnp.cos(tilt / 2), jnp.sin(tilt / 2), 0.0, 0.0])
        c = jnp.array([0.0, 0.0, 1.0]) * -lowest(q)[2]
        return {"c": c, "q": q, "v": -jnp.cross(turned(q, w), lowest(q)), "w": w}

    def sample(key):
        a, b = jr.split(key)
        spin = jr.uniform(b, (3,), minval=-1.0, maxval=1.0) + jnp.array([0.0, 0.0, 12.0])
        return start(jr.uniform(a, minval=1.3, maxval=1.9), spin)

    field, upright = dfc.tangent(falling, rolling, metric=weights), np.deg2rad(110)
    return Problem(
        "rolling-disk", field, manifold, sample, start(upright, jnp.array([0.0, 1.0, 12.0])),
        dfx.Tsit5(), 5.0, tol=1e-7, projection=dfc.SimplifiedNewton(atol=1e-14),
    )  # fmt: skip


# ---- A rigid molecule that turns freely ----

ATOMS = jnp.asarray(np.repeat([[12.011], [1.008], [1.008], [1.008], [1.008]], 3, 1))
CORNERS = [[0, 0, 0], [1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]
SHAPE = 0.109 / 3**0.5 * jnp.array(CORNERS, float)


def molecule():
    i, j = (x[:9] for x in np.tril_indices(5, -1))  # nine distances fix the shape
    squares = jnp.sum((SHAPE[i] - SHAPE[j]) ** 2, axis=1)
    free = lambda t, y, args: (y[1], jnp.zeros_like(y[1]))  # noqa: E731
    lengths = dfc.Constraint(lambda t, y, args: jnp.sum((y[0][i] - y[0][j]) ** 2, axis=1) - squares)
    velocities = lengths.derivative(free)
    energy = dfc.FirstIntegral(lambda t, y, args: jnp.sum(ATOMS * y[1] ** 2) / 2)
    manifold = {"lengths": lengths, "velocities": velocities, "energy": energy}

    def start(w, drift):
        return SHAPE, jnp.cross(jnp.broadcast_to(w, SHAPE.shape), SHAPE) + drift

    def sample(key):
        a, b = jr.split(key)
        return start(5 * jr.normal(a, (3,)), 0.2 * jr.normal(b, (3,)))

    return Problem(
        "rigid-molecule", dfc.tangent(free, velocities, metric=(jnp.inf, ATOMS)), manifold, sample,
        start(jnp.array([3.0, -7.0, 5.0]), jnp.array([0.2, -0.1, 0.3])), dfx.Tsit5(), 10.0,
        tol=1e-7, projection=dfc.SimplifiedNewton(atol=1e-15),
    )  # fmt: skip


# ---- Solitons of the cubic Schroedinger equation ----

POINTS, LENGTH = 128, 40.0
DX = LENGTH / POINTS
X = jnp.arange(POINTS) * DX - LENGTH / 2
WAVES = 2 * jnp.pi * jnp.fft.fftfreq(POINTS, DX)


def slope(psi):
    return jnp.fft.ifft(1j * WAVES * jnp.fft.fft(psi))


def schroedinger(t, y, args):
    psi = y[0] + 1j * y[1]
    bent = jnp.fft.ifft(-(WAVES**2) * jnp.fft.fft(psi))
    d = 1j * (bent / 2 + jnp.abs(psi) ** 2 * psi)
    return jnp.stack([d.real, d.imag])


def soliton(*, two=False):
    def energy(t, y, args):
        density = jnp.abs(slope(y[0] + 1j * y[1])) ** 2 - jnp.sum(y**2, axis=0) ** 2
        return DX * jnp.sum(density) / 2

    def momentum(t, y, args):
        psi = y[0] + 1j * y[1]
        return DX * jnp.sum(jnp.imag(jnp.conj(psi) * slope(psi)))

    manifold = {
        "mass": dfc.FirstIntegral(lambda t, y, args: DX * jnp.sum(y**2)),
        "energy": dfc.FirstIntegral(energy),
        "momentum": dfc.FirstIntegral(momentum),
    }

    def start(height, wave, shift=0.0):
        x = X - shift
        psi = height / jnp.cosh(height * x) * jnp.exp(2j * jnp.pi * wave / LENGTH * X)
        return jnp.stack([psi.real, psi.imag])

    def sample(key):
        a, b, c = jr.split(key, 3)
        one = start(jr.uniform(a, minval=0.8, maxval=1.3), jr.randint(b, (), -6, 7))
        other = start(jr.uniform(c, minval=0.8, maxval=1.3), 0, 12.0)
        return one + other if two else one

    first = start(1.2, 6) + (start(1.0, 0, 12.0) if two else 0.0)
    name = "two-solitons" if two else "one-soliton"
    return Problem(name, schroedinger, manifold, sample, first, dfc.RK4(), 8.0, dt0=0.04)


# ---- A spinning top, in SI units and with a balance of its energy ----


def damped(t, y, args):
    return {"q": y["v"], "v": -9.81 / 0.5 * jnp.sin(y["q"]) - 0.01 * y["v"]}


def damped_pendulum():
    def energy(t, y, args):
        return 0.5 * (0.5 * y["v"]) ** 2 - 9.81 * 0.5 * jnp.cos(y["q"])

    def power(t, y, args):
        return -0.01 * 0.25 * y["v"] ** 2

    def sample(key):
        q = jr.uniform(key, minval=0.5, maxval=2.8)
        return {"q": q, "v": jnp.zeros(())}

    return Problem(
        "damped-pendulum", damped, {"energy": dfc.FirstIntegral(energy, rate=power)}, sample,
        {"q": jnp.array(2.0), "v": jnp.array(0.0)}, dfx.Tsit5(), 30.0, tol=1e-5,
    )  # fmt: skip


def satellite():
    """Metres and seconds in one array."""
    mu = 3.986004418e14

    def field(t, y, args):
        return jnp.concatenate([y[3:], -mu * y[:3] / jnp.sum(y[:3] ** 2) ** 1.5])

    manifold = {
        "energy": dfc.FirstIntegral(
            lambda t, y, args: jnp.sum(y[3:] ** 2) / 2 - mu / jnp.sqrt(jnp.sum(y[:3] ** 2))
        ),
        "momentum": dfc.FirstIntegral(lambda t, y, args: jnp.cross(y[:3], y[3:])),
    }

    def start(e, tilt):
        r = 7e6
        v = jnp.sqrt(mu / r * (1 + e))
        return jnp.array([r, 0, 0, 0, v * jnp.cos(tilt), v * jnp.sin(tilt)])

    def sample(key):
        a, b = jr.split(key)
        return start(jr.uniform(a, minval=0.05, maxval=0.7), jr.uniform(b, minval=0.0, maxval=1.5))

    return Problem(
        "satellite-si", field, manifold, sample, start(0.3, 0.9), dfx.Dopri5(), 6e4, tol=1e-7,
    )  # fmt: skip


def problems():
    yield of_catalogue("kepler", dfx.Tsit5(), tol=1e-6)
    if SMOKE:
        return
    yield of_catalogue("rigid-body", dfx.Tsit5(), t1=20.0, tol=1e-6)
    yield of_catalogue("double-pendulum", dfx.Tsit5(), t1=10.0, tol=1e-6)
    yield of_catalogue("conservative-lorenz", dfc.RK4(), t1=20.0, dt0=0.1)
    yield of_catalogue("point-vortices", dfx.Dopri5(), t1=20.0, tol=1e-5)
    yield of_catalogue("henon-heiles", dfx.Bosh3(), t1=30.0, tol=1e-5)
    yield of_catalogue("lotka-volterra", dfc.RK4(), t1=30.0, dt0=0.2)
    yield of_catalogue("toda-lattice", dfc.RK4(), t1=20.0, dt0=0.1)
    yield of_catalogue("cartesian-pendulum", dfx.Tsit5(), t1=20.0, tol=1e-5)
    yield of_catalogue("rigid-body-attitude", dfx.Tsit5(), t1=20.0, tol=1e-6)
    yield of_catalogue("robertson", dfx.Kvaerno5(), tol=1e-5)
    yield of_catalogue("pollu", dfx.Kvaerno5(), tol=1e-4)
    yield disk()
    yield molecule()
    yield soliton()
    yield soliton(two=True)
    yield damped_pendulum()
    yield satellite()


def compared(problem, y0s, t1):
    with contextlib.redirect_stdout(None):
        return dfc.compare(
            problem.field, problem.solver, problem.manifold, y0s, t1=t1, batch=True,
            metric=problem.metric, projection=problem.projection, **tolerances(problem),
        )  # fmt: skip


def starts(problem, seed):
    return jax.vmap(problem.sample)(jr.split(jr.key(seed), LANES))


def means(report):
    """The geometric mean of the errors of each row over the lanes that are judged."""
    error = report.error[:, report.last > 0]
    with np.errstate(all="ignore"):
        return np.exp(np.mean(np.log(error), axis=1)), error


def row(problem):
    begun = time.time()
    copies = jax.tree.map(lambda x: jnp.stack([x] * LANES), problem.y0)
    one = compared(problem, copies, problem.t1)
    seconds = time.time() - begun
    few = compared(problem, starts(problem, 1), problem.t1)
    longer = LONGER if problem.tol else 1.0
    others = compared(problem, starts(problem, 2), longer * problem.t1)
    error, lanes = means(others)
    cells = [problem.name, type(problem.solver).__name__]
    for report in (one, few):
        ratio = np.nan if report.index is None else error[report.index] / np.min(error)
        cells += [str(report.choice), f"{ratio:.2f}"]
    with np.errstate(all="ignore"):
        over = lanes[few.index or 0] / lanes[0]
        cells += [others.rows[int(np.argmin(error))].name]
        cells += [f"{np.exp(np.mean(np.log(over))):.2g}", f"{np.max(over, initial=0):.2g}"]
        cells += [f"{lanes.shape[1]}", f"{seconds:.0f} s"]
    return cells


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", default="")
    parser.add_argument("--smoke", action="store_true")
    options = parser.parse_args()
    globals()["SMOKE"] = options.smoke
    globals()["LANES"] = 2 if options.smoke else LANES
    head = ("problem", "solver", "from one", "/best", "from eight", "/best", "best")
    print(*head, "/plain", "worst", "judged", "time", sep=" | ", flush=True)
    for problem in problems():
        if options.only in problem.name:
            print(*row(problem), sep=" | ", flush=True)


if __name__ == "__main__":
    main()
