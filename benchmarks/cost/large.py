"""Large stiff equations by `DAE` and `Radau` with sparse linear systems, beside IDA of SUNDIALS.

- The heat equation in one dimension, with algebraic values at both ends.
- The Brusselator in two dimensions, which diffuses.
- A ladder of diodes: each pair of nodes is joined by a condenser, and a diode leads to the next
  pair, so that half of the equations are algebraic, as sums of two. Each pair has its own source.

IDA has the better of its band and its sparse solver. It calls the same compiled functions from
Python, once for an evaluation, and for the Jacobian of the sparse solver; that of the band solver
are differences. Errors are the largest of a component at the end, from `Radau` with a tolerance of
1e-7, which is a thousand times as accurate. Times are those of an error of 1e-5, between the two
tolerances that enclose it, and the first call is that of `consistent` and of a solve, with the
search for places and compilation. Each problem has a process of its own; its memory is the largest
of that, before IDA begins.

Writes `results/large.json`. `--only` takes a name with its size, such as `heat, 1000 unknowns`.
"""

import concurrent.futures
import functools as ft
import itertools
import multiprocessing
import resource
import sys

import diffrax as dfx
import jax
import jax.numpy as jnp
import measuring
import numpy as np
import scipy.sparse as sp

import diffrax_conserve as dfc
from diffrax_conserve._large.klu import Places, sparse_jacobian

try:
    from sksundae.ida import IDA
except ImportError:
    IDA = None

ERROR = 1e-5
TOLERANCES = {"radau": [1e-3, 1e-4, 1e-5], "ida": [1e-4, 1e-5, 1e-6, 1e-7, 1e-8]}


# ---- The problems: `f`, the mass matrix, a guess, the end, and the width of a narrow band ----


def heat(n):
    def f(t, y, args):
        inner = 0.1 * (n - 1) ** 2 * (y[:-2] - 2 * y[1:-1] + y[2:])
        return jnp.concatenate([(y[0] - jnp.sin(t))[None], inner, (y[-1] - jnp.sin(2 * t))[None]])

    x = np.linspace(0, 1, n)
    mass = sp.diags_array(np.where((x == 0) | (x == 1), 0.0, 1.0))
    return f, mass, np.sin(np.pi * x) + 0.3 * np.sin(5 * np.pi * x), 1.0, 1


def brusselator(n):
    m = round((n / 2) ** 0.5)

    def f(t, y, args):
        u, v = y.reshape(2, m, m)

        def diffused(u):
            wide = jnp.pad(u, 1, mode="edge")
            beside = wide[2:, 1:-1] + wide[:-2, 1:-1] + wide[1:-1, 2:] + wide[1:-1, :-2]
            return 0.02 * m**2 * (beside - 4 * u)

        rate = u**2 * v
        return jnp.stack([1 + rate - 4.4 * u + diffused(u), 3.4 * u - rate + diffused(v)]).ravel()

    x, y = np.meshgrid(*[(np.arange(m) + 0.5) / m] * 2)
    guess = np.stack([0.5 + y, 1 + 5 * x]).ravel()
    return f, sp.eye_array(2 * m * m), guess, 10.0, None


def ladder(n):
    phase = 0.3 * np.arange(n // 2)

    def f(t, u, args):
        a, b = u[0::2], u[1::2]
        source = 0.4 * jnp.sin(200 * np.pi * t + phase) + 0.3 * jnp.sin(2000 * np.pi * t)
        diode = 1e-6 * jnp.expm1((b[:-1] - a[1:]) / 0.026)
        none = jnp.zeros(1)
        first = (a - source) / 1e3 - jnp.concatenate([none, diode])
        second = b / 9e3 + jnp.concatenate([diode, none])
        return jnp.stack([first, second], 1).ravel()

    mass = sp.kron(sp.eye_array(n // 2), 1e-6 * np.array([[-1, 1], [1, -1]]))
    return f, mass, np.zeros(n), 0.01, 1


PROBLEMS = {"heat": heat, "Brusselator": brusselator, "ladder of diodes": ladder}
SIZES = {"heat": [10**3, 10**4, 10**5], "Brusselator": [968, 9800], "ladder of diodes": [10**4]}


# ---- The solvers ----


def start(f, mass, guess):
    """The equations, those of a `DAE` if the mass matrix is singular, and a consistent state."""
    y = jnp.asarray(guess)
    if np.all(mass.diagonal() == 1):
        return None, y
    dae = dfc.DAE(f, mass=mass).at(y)
    return dae, dae.consistent(y)


def by_radau(f, dae, end):
    """A compiled solve, from a state and a tolerance."""
    term = dfx.ODETerm(f) if dae is None else dae.term
    solver = dfc.Radau() if dae is None else dae.wrap(dfc.Radau())

    @jax.jit
    def run(y, tolerance):
        found = dfx.diffeqsolve(
            term, solver, 0.0, end, 1e-4 * end, y, max_steps=10**5,
            stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
        )  # fmt: skip
        return found.ys[-1], found.stats

    return run


def by_ida(f, mass, end, y, slopes, band, kind):
    """A solve, from a tolerance, by the band or the sparse solver."""
    n, mass = len(y), sp.csr_array(mass)
    where = sp.coo_array(mass)
    product = lambda s: jnp.zeros(n).at[where.row].add(where.data * s[where.col])  # noqa: E731
    value = jax.jit(lambda t, y, s: product(s) - f(t, y, None))

    def residual(t, y, s, out):
        out[:] = value(t, y, s)

    found = sparse_jacobian(lambda y: f(0.1, y, None), jnp.asarray(y))
    rows = np.concatenate([found.rows, where.row])
    places = Places(rows, np.concatenate([found.columns, where.col]), n)
    by_slope = np.zeros(len(places.rows))
    by_slope[places.index(where.row, where.col)] = where.data
    index = places.index(found.rows, found.columns)
    by_y = jax.jit(lambda t, y: found.values(lambda y: f(t, y, None), y))

    def jacobian(t, y, s, _, c, out):
        out[:] = c * by_slope
        out[index] -= by_y(t, y)

    options = dict(linsolver="band", lband=band, uband=band)
    if kind == "sparse":
        ones = np.ones(len(places.rows))
        pattern = sp.csc_matrix((ones, (places.rows, places.columns)), (n, n))
        options = dict(linsolver="sparse", sparsity=pattern, jacfn=jacobian)
    none = np.flatnonzero(np.bincount(where.col[where.data != 0], minlength=n) == 0)
    options |= dict(algebraic_idx=none.tolist() or None, max_num_steps=10**6)

    def run(tolerance):
        ida = IDA(residual, rtol=tolerance, atol=tolerance, first_step=1e-8 * end, **options)
        done = ida.solve(np.array([0.0, end]), y, slopes)
        return done.y[-1] if done.success else np.full(n, np.nan)

    value(0.0, y, slopes), by_y(0.0, y)
    return run


def at_error(errors, seconds, error=ERROR):
    """Seconds for an error, between the two runs that enclose it; NaN if none do."""
    pairs = sorted((e, s) for e, s in zip(errors, seconds, strict=True) if 0 < e < np.inf)
    for (e0, s0), (e1, s1) in itertools.pairwise(pairs):
        if e0 <= error <= e1:
            share = np.log(error / e0) / np.log(e1 / e0)
            return float(np.exp((1 - share) * np.log(s0) + share * np.log(s1)))
    return float("nan")


def measured(name, n, tolerances):
    """Errors and seconds of both at all tolerances, the first call, the memory, and the ratio."""
    f, mass, guess, end, band = PROBLEMS[name](n)
    begin = measuring.clock()
    dae, y = start(f, mass, guess)
    solve = by_radau(f, dae, end)
    jax.block_until_ready(solve(y, tolerances["radau"][0]))
    first = measuring.clock() - begin
    exact, start_at = np.asarray(solve(y, 1e-7)[0]), np.asarray(y)
    unit = 1 if sys.platform == "darwin" else 1024
    memory = unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    term = dfx.ODETerm(f) if dae is None else dae.term
    slopes = np.asarray(jax.jit(lambda y: term.vf(0.0, y, None))(y))
    runs = {("radau", t): ft.partial(solve, y, t) for t in tolerances["radau"]}
    kinds = [] if IDA is None else ["sparse"] if band is None else ["band", "sparse"]
    for kind in kinds:
        ida = by_ida(f, mass, end, start_at, slopes, band, kind)
        runs |= {(kind, t): ft.partial(ida, t) for t in tolerances["ida"]}
    done, out = measuring.take_turns(runs, rounds=3), {}
    for solver in ("radau", *kinds):
        found = [done[key] for key in runs if key[0] == solver]
        ends = [np.asarray(x.answer[0] if solver == "radau" else x.answer) for x in found]
        errors = [float(np.max(np.abs(x - exact))) for x in ends]
        seconds = [x.seconds for x in found]
        out[solver] = dict(errors=errors, seconds=seconds, at_error=at_error(errors, seconds))
        if solver == "radau":
            stats = [x.answer[1] for x in found]
            out[solver] |= {
                key: [int(x[f"num_{key}_steps"]) for x in stats] for key in ("accepted", "rejected")
            }
    best = np.nanmin([out[k]["at_error"] for k in kinds] or [np.nan])
    ratio = float(out["radau"]["at_error"] / best)
    shape = dict(n=len(start_at), tolerances=tolerances)
    return dict(**shape, first_call=first, memory=memory, ratio=ratio, ida=float(best), **out)


def alone(name, n, tolerances):
    """`measured` in a process of its own."""
    options = dict(mp_context=multiprocessing.get_context("spawn"))
    with concurrent.futures.ProcessPoolExecutor(1, **options) as pool:
        return pool.submit(measured, name, n, tolerances).result()


def main():
    options = measuring.parser(__doc__, "large").parse_args()
    about = measuring.machine("klujax", "scikit-sundae")
    measuring.print_machine(about)
    print(f"| problem | n | first call, s | MB | s for {ERROR:.0e} | IDA, s | ratio | steps |")
    print("|---|---|---|---|---|---|---|---|")
    results = {}
    sizes = {key: [128] for key in PROBLEMS} if options.smoke else SIZES
    for name in PROBLEMS:
        for n in sizes[name]:
            if options.only not in f"{name}, {n} unknowns":
                continue
            if options.smoke:
                found = measured(name, n, {key: [1e-4, 1e-6] for key in TOLERANCES})
            else:
                found = alone(name, n, TOLERANCES)
            results[f"{name}, {n} unknowns"] = found
            radau = found["radau"]
            row = [
                name, f"{found['n']:,}", f"{found['first_call']:.1f}",
                f"{found['memory'] / 1e6:.0f}", f"{radau['at_error']:.3f}", f"{found['ida']:.3f}",
                f"{found['ratio']:.2f}", f"{radau['accepted']} + {radau['rejected']}",
            ]  # fmt: skip
            print("|", " | ".join(row), "|", flush=True)
    measuring.write(options, about, results=results)


if __name__ == "__main__":
    main()
