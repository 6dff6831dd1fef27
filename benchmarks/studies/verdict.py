"""Is what `compare` names the best? Verdicts on twelve problems of others.

    python benchmarks/studies/verdict.py             # one row for each problem, ten minutes
    python benchmarks/studies/verdict.py --only top  # the problems whose names hold this text
    python benchmarks/studies/verdict.py --smoke     # toy sizes

A row has what `compare` names from one start and from eight random ones. Other solves judge it,
over an interval that is half as long again: the first by the same start, the second by eight
others. An error is the root mean square over the components, each in a unit that the problem gives,
and the largest over 23 times, against DOP853 of SciPy. The number behind a choice is its error over
the least of all candidates, in the geometric mean: at most 1.5 is the target. The last columns are
the errors of the second choice over those without projection, in the mean and at worst.
"""
# ruff: noqa: E731

import argparse
import contextlib
import json
from pathlib import Path
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from scipy.integrate import solve_ivp

import diffrax_conserve as dfc
from diffrax_conserve._numerics.metric import spread
from diffrax_conserve._tree import ravel, unravel

RESULTS = Path(__file__).parents[1] / "results" / "verdict.json"
STARTS, LONGER, TIMES = 8, 1.5, 23


class Problem(NamedTuple):
    """`draw(key)` is a random start, `kept` what is conserved. `scale` is the unit of an error."""

    field: Any
    kept: dict
    draw: Any
    solver: Any
    t1: float
    dt0: float | None = None
    tol: float | None = None
    scale: Any = 1.0


PROBLEMS: dict[str, Problem] = {}


def unit(key):
    x = jr.normal(key, (3,))
    return x / jnp.linalg.norm(x)


def problem(solver, t1, **more):
    """Of a function that returns the field, what is conserved and how a start is drawn."""

    def keep(fn):
        PROBLEMS[fn.__name__.replace("_", "-")] = Problem(*fn(), solver, t1, **more)

    return keep


def top(inertia, weight, centre, split, join):
    """The equations of Euler and Poisson for the velocity and the direction upwards in the body."""

    def field(y):
        w, g = split(y)
        torque = weight * jnp.cross(g, centre) + jnp.cross(inertia * w, w)
        return join(torque / inertia, jnp.cross(g, w))

    energy = lambda w, g: inertia @ w**2 / 2 + weight * g @ centre
    parts = dict(energy=energy, momentum=lambda w, g: inertia * w @ g, length=lambda w, g: g @ g)
    return field, {name: lambda y, f=f: f(*split(y)) for name, f in parts.items()}


@problem(dfx.Tsit5(), 1.0, tol=1e-6, scale=dict(w=100.0, g=1.0))
def heavy_top():
    """Not quite symmetric, in SI, in two leaves."""
    inertia, axis = jnp.array([2.6e-4, 2.8e-4, 1.5e-4]), jnp.array([0.0, 0.0, 1.0])
    split, join = (lambda y: (y["w"], y["g"])), (lambda w, g: dict(w=w, g=g))
    draw = lambda a, b: join(5 * jr.normal(a, (3,)) + 100 * axis, unit(b))
    weight = 0.2 * 9.81 * 0.04
    return *top(inertia, weight, axis, split, join), lambda key: draw(*jr.split(key))


@problem(dfc.RK4(), 15.0, dt0=0.1)
def kowalevski_top():
    """With the integral of fourth degree, in one array."""
    fourth = lambda y: (y[0] ** 2 - y[1] ** 2 - y[3]) ** 2 + (2 * y[0] * y[1] - y[4]) ** 2
    inertia, centre = jnp.array([2.0, 2.0, 1.0]), jnp.array([1.0, 0.0, 0.0])
    join = lambda w, g: jnp.concatenate([w, g])
    field, kept = top(inertia, 1.0, centre, lambda y: (y[:3], y[3:]), join)
    draw = lambda a, b: join(jr.normal(a, (3,)), unit(b))
    return field, kept | dict(fourth=fourth), lambda key: draw(*jr.split(key))


@problem(dfx.Dopri5(), 30.0, tol=1e-5)
def restricted_three_body():
    """Near the fourth point of Lagrange of Earth and Moon, in one array; Jacobi's integral."""
    mu, turn = 0.01215, jnp.array([2.0, -2.0])

    def potential(q):
        near, far = (jnp.hypot(q[0] + x, q[1]) for x in (mu, mu - 1))
        return q @ q / 2 + (1 - mu) / near + mu / far

    field = lambda y: jnp.concatenate([y[2:], jax.grad(potential)(y[:2]) + turn * y[:1:-1]])
    point = jnp.array([0.5 - mu, 0.75**0.5, 0.0, 0.0])
    jacobi = lambda y: 2 * potential(y[:2]) - y[2:] @ y[2:]
    return field, dict(jacobi=jacobi), lambda key: point + 0.03 * jr.normal(key, (4,))


@problem(dfx.Dopri5(), 15.0, tol=1e-4)
def geodesic_of_an_ellipsoid():
    """With Joachimsthal's integral, as a pair."""
    a = 1 / jnp.array([1.0, 0.7, 0.4]) ** 2
    kept = dict(surface=lambda y: y[0] @ (a * y[0]), tangent=lambda y: y[0] @ (a * y[1]))
    kept["joachimsthal"] = lambda y: (y[0] @ (a**2 * y[0])) * (y[1] @ (a * y[1]))
    kept["energy"] = lambda y: y[1] @ y[1]

    def draw(key):
        u, v = (unit(k) for k in jr.split(key))
        q = u / jnp.sqrt(u @ (a * u))
        v = v - (v @ (a * q)) / jnp.sum((a * q) ** 2) * a * q
        return q, v / jnp.linalg.norm(v)

    bend = lambda y: -(y[1] @ (a * y[1])) / jnp.sum((a * y[0]) ** 2) * a * y[0]
    return lambda y: (y[1], bend(y)), kept, draw


SIZES = dict(t=2000.0, r=20.0, phi=1.0, ut=1.0, ur=0.1, up=0.03)


@problem(dfx.Tsit5(), 2000.0, tol=1e-6, scale=SIZES)
def geodesic_of_schwarzschild():
    """A planet near a black hole, in six scalars, the last three of them the four-velocity."""
    state = lambda *parts: dict(zip(SIZES, parts, strict=True))

    def field(y):
        _, r, _, ut, ur, up = (y[name] for name in SIZES)
        pull = -(r - 2) / r**3 * ut**2 + ur**2 / (r * (r - 2)) + (r - 2) * up**2
        return state(ut, ur, up, -2 / (r * (r - 2)) * ut * ur, pull, -2 / r * ur * up)

    def draw(key):
        a, b = jr.split(key)
        p, e = jr.uniform(a, minval=10.0, maxval=20.0), jr.uniform(b, minval=0.1, maxval=0.6)
        r, share, zero = p / (1 + e), p - 3 - e**2, 0.0 * p
        ut = jnp.sqrt(((p - 2) ** 2 - 4 * e**2) / (p * share)) / (1 - 2 / r)
        return state(zero, r, zero, ut, zero, p / jnp.sqrt(share) / r**2)

    energy = lambda y: (1 - 2 / y["r"]) * y["ut"]
    momentum = lambda y: y["r"] ** 2 * y["up"]
    length = lambda y: (y["ur"] ** 2 - energy(y) ** 2) / (1 - 2 / y["r"]) + momentum(y) * y["up"]
    return field, dict(energy=energy, momentum=momentum, length=length), draw


@problem(dfx.Dopri5(), 2.0, tol=1e-6, scale=jnp.array([2e7] * 3 + [1.4e7] * 3))
def proton_in_the_field_of_a_dipole():
    """Of the Earth, 1 MeV, in SI, in one array; its momentum about the axis is conserved."""
    k, axis = 9.5788e7 * 3.1e-5 * 6.371e6**3, jnp.array([0.0, 0.0, 1.0])
    radius = lambda y: jnp.linalg.norm(y[:3])
    strength = lambda y: k * (3 * y[2] * y[:3] / radius(y) ** 5 - axis / radius(y) ** 3)
    field = lambda y: jnp.concatenate([y[3:], jnp.cross(y[3:], strength(y))])
    flux = lambda y: k * (y[0] ** 2 + y[1] ** 2) / radius(y) ** 3
    momentum = lambda y: y[0] * y[4] - y[1] * y[3] + flux(y)
    place = lambda key: jnp.array([1.9e7, 0.0, 0.0]) + 1e6 * jr.normal(key, (3,))
    draw = lambda a, b: jnp.concatenate([place(a), 1.38e7 * unit(b)])
    energy = lambda y: y[3:] @ y[3:] / 2
    return field, dict(energy=energy, momentum=momentum), lambda key: draw(*jr.split(key))


@problem(dfc.RK4(), 4.0, dt0=0.05)
def calogero_moser():
    """Four particles on a line; the traces of the powers of Lax's matrix are conserved."""
    apart, off = (lambda q: q[:, None] - q + jnp.eye(4)), 1 - jnp.eye(4)
    lax = lambda y: jnp.diag(y["p"]) + 1j * off / apart(y["q"])
    power = lambda n: lambda y: jnp.trace(jnp.linalg.matrix_power(lax(y), n)).real
    field = lambda y: dict(q=y["p"], p=2 * jnp.sum(off / apart(y["q"]) ** 3, axis=1))
    place = lambda key: 1.5 * jnp.arange(4.0) + jr.uniform(key, (4,), minval=-0.4, maxval=0.4)
    draw = lambda a, b: dict(q=place(a), p=jr.normal(b, (4,)))
    return field, {f"trace-{n}": power(n) for n in range(1, 5)}, lambda key: draw(*jr.split(key))


@problem(dfc.RK4(), 100.0, dt0=0.1)
def fermi_pasta_ulam_tsingou():
    """Sixteen particles between walls, of random displacements; the energy."""
    stretch = lambda y: jnp.diff(y["q"], prepend=0.0, append=0.0)
    spring = lambda x: jnp.sum(x**2 / 2 + x**3 / 12)
    field = lambda y: dict(q=y["p"], p=jnp.diff(jax.grad(spring)(stretch(y))))
    draw = lambda key: dict(q=0.3 * jr.normal(key, (16,)), p=jnp.zeros(16))
    return field, dict(energy=lambda y: jnp.sum(y["p"] ** 2) / 2 + spring(stretch(y))), draw


@problem(dfx.Heun(), 20.0, dt0=0.01)
def nose_hoover():
    """An oscillator `q, p` with a thermostat `x` and its integral `s`; the extended energy."""
    field = lambda y: jnp.stack([y[1], -y[0] - y[2] * y[1], y[1] ** 2 - 1, y[2]])
    energy = lambda y: y[:3] @ y[:3] / 2 + y[3]
    return field, dict(energy=energy), lambda key: jr.normal(key, (4,)).at[3].set(0.0)


@problem(dfx.Tsit5(), 10.0, tol=1e-5)
def ablowitz_ladik():
    """Twelve complex amplitudes on a ring."""
    field = lambda y: 1j * (jnp.roll(y, 1) + jnp.roll(y, -1)) * (1 + jnp.abs(y) ** 2)
    flow = lambda y: jnp.sum(jnp.conj(y) * jnp.roll(y, 1))
    kept = dict(norm=lambda y: jnp.sum(jnp.log1p(jnp.abs(y) ** 2)))
    kept |= dict(energy=lambda y: flow(y).real, momentum=lambda y: flow(y).imag)
    return field, kept, lambda key: 0.5 * jr.normal(key, (12,), complex)


@problem(dfx.Bosh3(), 20.0, tol=1e-5)
def maxwell_bloch():
    """A laser field, the polarisation and the inversion, in three leaves."""
    field = lambda y: dict(e=y["p"], p=y["e"] * y["d"], d=-jnp.sum(y["e"] * y["p"], keepdims=True))
    kept = dict(length=lambda y: y["p"] @ y["p"] + jnp.sum(y["d"] ** 2))
    kept["energy"] = lambda y: y["e"] @ y["e"] / 2 + jnp.sum(y["d"])
    kept["phase"] = lambda y: y["e"][0] * y["p"][1] - y["e"][1] * y["p"][0]
    draw = lambda a, b, c: dict(e=jr.normal(a, (2,)), p=jr.normal(b, (2,)), d=jr.normal(c, (1,)))
    return field, kept, lambda key: draw(*jr.split(key, 3))


@problem(dfx.Kvaerno3(), 5.0, tol=1e-5)
def glycolysis():
    """Of yeast, after Wolf and Heinrich (2000); ATP and ADP, NADH and NAD have constant sums."""
    highest = jnp.array([1.6, 2.2, 0.2, 0.35, 0.3, 2.7, 0.1])

    def field(y):
        s1, s2, s3, s4, nadh, atp, out, adp, nad = y
        v1, v2, v6 = 100 * s1 * atp / (1 + (atp / 0.52) ** 4), 6 * s2 * nad, 12 * s2 * nadh
        v3, v4, through = 16 * s3 * adp, 100 * s4 * nadh, 13 * (s4 - out)
        charge, reduced = 2 * v3 - 2 * v1 - 1.28 * atp, v2 - v4 - v6
        slopes = [2.5 - v1, 2 * v1 - v2 - v6, v2 - v3, v3 - v4 - through, reduced, charge]
        return jnp.stack([*slopes, 0.1 * through - 1.8 * out, -charge, -reduced])

    def draw(key):
        y = highest * jr.uniform(key, (7,), minval=0.1, maxval=1.0)
        return jnp.append(y, jnp.stack([4.0 - y[5], 1.0 - y[4]]))

    return field, dict(adenine=lambda y: y[5] + y[7], nicotinamide=lambda y: y[4] + y[8]), draw


def coordinates(made, y0):
    """The maps from a state to a vector of real numbers in units of the scale, and back."""
    scale = spread("scale", made.scale, jax.eval_shape(lambda: y0))
    return lambda y: ravel(y) / scale, lambda x: unravel(x * scale, y0)


def exact(made, y0s, ts, tol):
    """The coordinates of all starts at the times, by SciPy in one solve."""
    start, state = coordinates(made, jax.tree.map(lambda x: x[0], y0s))
    x0s, fields = jax.vmap(start)(y0s), jax.vmap(lambda x: start(made.field(state(x))))
    jitted = jax.jit(lambda x: fields(x.reshape(x0s.shape)).ravel())
    field = lambda t, x: np.asarray(jitted(x))
    sol = solve_ivp(field, (0, ts[-1]), np.ravel(x0s), "DOP853", ts, rtol=tol, atol=tol)
    return sol.y.T.reshape(len(ts), *x0s.shape).swapaxes(0, 1)


def judged(made, rows, y0s, steps):
    """The errors of the choices of all rows in each start, and those of the reference."""
    ts = LONGER * made.t1 * np.append(np.sort(np.random.default_rng(5).random(TIMES - 1)), 1)
    control = dfx.ConstantStepSize() if made.dt0 else dfx.PIDController(**steps)
    if made.dt0:
        ts = made.dt0 * np.unique(np.round(ts / made.dt0))  # ends of steps
    first = jax.tree.map(lambda x: x[0], y0s)
    to, _ = coordinates(made, first)
    field = dfx.ODETerm(lambda t, y, args: made.field(y))
    values = lambda t, y, args: [f(y) * k for f, k in zip(made.kept.values(), args, strict=True)]

    @eqx.filter_jit
    def solved(flags, weights):
        """With entries whose flag is one, and zero in the place of others; `None` is plain."""
        solver, kept = made.solver, dfc.FirstIntegral(values)
        if flags is not None:
            projection = dfc.SimplifiedNewton(metric=weights)
            solver = dfc.ManifoldProjection(solver, kept, projection=projection)

        def one(y0):
            sol = dfx.diffeqsolve(
                field, solver, 0.0, ts[-1], made.dt0, y0, args=flags, saveat=dfx.SaveAt(ts=ts),
                stepsize_controller=control, max_steps=100_000, throw=False,
                adjoint=dfx.ForwardMode(),
            )  # fmt: skip
            return jax.vmap(to)(sol.ys), dfx.is_okay(sol.result)

        return jax.lax.map(one, y0s)  # one after the other, which is compiled faster than a batch

    distance = lambda xs: np.max(np.sqrt(np.mean((xs - truth) ** 2, axis=2)), axis=1)
    rough, truth = (exact(made, y0s, ts, tol) for tol in (1e-12, 1e-13))
    ones, errors = jax.tree.map(lambda x: jnp.ones(x.shape), first), []
    for row in rows:
        flags = jnp.array([float(k in row.kept) for k in made.kept]) if row.kept else None
        metric = getattr(row.solver, "projection", dfc.SimplifiedNewton()).metric
        xs, okay = solved(flags, ones if isinstance(metric, float) else metric)
        errors.append(np.where(okay, distance(np.asarray(xs)), np.inf))
    return np.stack(errors), distance(rough)


def study(name, made):
    field = lambda t, y, args: made.field(y)
    kept = {k: dfc.FirstIntegral(lambda t, y, args, f=f: f(y)) for k, f in made.kept.items()}
    steps = dict(dt0=made.dt0) if made.dt0 else dict(rtol=made.tol, atol=made.tol)
    few, others = (jax.vmap(made.draw)(jr.split(jr.key(seed), STARTS)) for seed in (1, 2))
    copies = jax.tree.map(lambda x: jnp.stack([x[0]] * STARTS), others)  # as programs are of eight
    with contextlib.redirect_stdout(None):
        reports = [
            dfc.compare(field, made.solver, kept, y0s, t1=made.t1, batch=True, **steps)
            for y0s in (copies, few)
        ]
    means = lambda errors: np.exp(np.mean(np.log(errors), axis=1))  # geometric, over the starts
    errors, doubt = judged(made, reports[0].rows, others, steps)
    assert np.all(10 * doubt < np.min(errors, axis=0)), "the reference is not accurate enough"
    found = dict(problem=name, solver=type(made.solver).__name__)
    for case, report, part in zip(("one", "eight"), reports, (errors[:, :1], errors), strict=True):
        mean = means(part)
        found |= {case: report.choice, f"{case}/best": mean[report.index] / np.min(mean)}
    names, over = [row.name for row in reports[0].rows], errors[reports[1].index] / errors[0]
    found |= dict(best=names[np.argmin(means(errors))], mean=means(over[None])[0], worst=max(over))
    told = [means(report.error).tolist() for report in reports]
    return found | dict(rows=names, errors=errors.tolist(), told=told)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", default="", help="the problems whose names hold this text")
    parser.add_argument("--smoke", action="store_true", help="toy sizes")
    options = parser.parse_args()
    names, found = [name for name in PROBLEMS if options.only in name], []
    if options.smoke:
        names, globals()["STARTS"] = ["nose-hoover"], 2
    head = ("problem", "solver", "one", "one/best", "eight", "eight/best", "best", "mean", "worst")
    print(*head, sep=" | ")
    for name in names:
        found.append(study(name, PROBLEMS[name]))
        cells = [found[-1][k] for k in head]
        print(*(x if isinstance(x, str) else f"{x:.2g}" for x in cells), sep=" | ", flush=True)
    if names == list(PROBLEMS):
        RESULTS.write_text(json.dumps(found) + "\n")


if __name__ == "__main__":
    main()
