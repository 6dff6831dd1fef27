"""H: predicted concentrations made positive and balanced (T. Kircher and M. Votsmeier, 2025).

J. Phys. Chem. Lett. 16, 4715. A surrogate of a reactor predicts concentrations; a projection
restores the atoms. Orthogonal, it makes small concentrations negative. Weighted by the inverse
squares of the prediction ("positivity preserving") it rarely does, and then the result is moved
back towards the start until it is positive ("backtracking").

Their random systems, drawn anew, a shape for each seed: atoms, species with up to four of each,
concentrations of 1e-5 to 1 before and after, with the same atoms; the prediction is the true one
times 10^beta, beta uniform in [-gamma, gamma]. Their figure shows positivity and relative error
over gamma; no number is printed. So their four formulas, by us, run beside `project`: with
`lower=0`, and of the logarithms, whose constraint is that of their exponentials. The relative error
is the mean over the species, and the median over the states. Their reactor and ozone data are not
here.
"""

import functools

import common
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

import diffrax_conserve as dfc

SOURCE = "github.com/VotsmeierGroup/PositivityPreservingProjection, results and main.py (2025)"
SEEDS, GAMMAS = (0, 1, 2), (0.1, 0.3, 0.5, 1.0)
SHAPES = ((2, 6), (3, 10), (5, 15))  # atoms and species: theirs are any up to the last
SYSTEMS, CONDITIONS = 6, 300  # of each seed
LEAST = 1e-10  # where backtracking stops


def system(rng, shape, conditions):
    """Atoms of each species, and concentrations before and after a reaction."""
    atoms = rng.integers(0, 5, shape).astype(float)
    bare = np.flatnonzero(~atoms.any(axis=0))
    atoms[rng.integers(0, shape[0], bare.size), bare] = rng.integers(1, 5, bare.size)
    after = 10 ** rng.uniform(-5, 0, (conditions, shape[1]))
    # The start is anywhere on a random line of equal atoms between the extremes of the end.
    free = scipy.linalg.null_space(atoms)
    slope = rng.standard_normal((conditions, free.shape[1])) @ free.T
    ends = [(f(after, axis=1, keepdims=True) - after) / slope for f in (np.min, np.max)]
    first, last = np.max(np.minimum(*ends), axis=1), np.min(np.maximum(*ends), axis=1)
    return atoms, after + rng.uniform(first, last)[:, None] * slope, after


def along(atoms, before, predicted, weights):
    """The nearest state to the prediction that has the atoms of `before`, in weighted distance."""
    free = scipy.linalg.null_space(atoms)
    scaled = weights[:, :, None] * free
    square = np.swapaxes(scaled, 1, 2) @ scaled
    wanted = np.swapaxes(scaled, 1, 2) @ (weights * (predicted - before))[:, :, None]
    return before + (free @ np.linalg.solve(square, wanted))[:, :, 0]


def backtracked(before, found):
    """The point nearest to `found` on the way to `before` where nothing is below `LEAST`."""
    target = np.maximum(before, LEAST)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(found < 0, (LEAST - found) / (target - found), 0)
    return found + np.max(np.clip(share, 0, 1), axis=1, keepdims=True) * (target - found)


def theirs(atoms, before, predicted):
    def flat():
        return along(atoms, before, predicted, np.ones_like(predicted))

    def weighted():
        return along(atoms, before, predicted, 1 / predicted)

    return {
        "prediction": lambda: predicted,
        "orthogonal": flat,
        "positivity preserving": weighted,
        "orthogonal, backtracking": lambda: backtracked(before, flat()),
        "positivity preserving, backtracking": lambda: backtracked(before, weighted()),
    }


@functools.partial(jax.jit, static_argnums=0)
def ours(name, atoms, before, predicted):
    def one(before, predicted):
        def project(function, y, projection):
            kept = dfc.Constraint(lambda t, y, args: atoms @ function(y) - args)
            y, info = dfc.project(kept, y, args=atoms @ before, projection=projection)
            return function(y), info.ok

        if name == "ours, of the logarithms":
            return project(jnp.exp, jnp.log(predicted), dfc.Newton(max_steps=50))
        metric = predicted**-2 if "weights" in name else 1.0
        within = dfc.SimplifiedNewton(max_steps=50, lower=0.0, metric=metric)
        return project(lambda y: y, predicted, within)

    return jax.vmap(one)(before, predicted)


OURS = ("ours, lower=0", "ours, lower=0, their weights", "ours, of the logarithms")


def results_of(rng, shape, conditions):
    """Of one system, by noise and program: what each state's projection gave, and its time."""
    atoms, before, after = system(rng, shape, conditions)
    for gamma in GAMMAS:
        predicted = after * 10 ** rng.uniform(-gamma, gamma, after.shape)
        all_ = np.ones(len(after), bool)
        runs = theirs(atoms, before, predicted)
        runs = {name: lambda f=f: (f(), all_) for name, f in runs.items()}  # noqa: B023
        three = (atoms, before, predicted)
        runs |= {name: lambda name=name, x=three: ours(name, *x) for name in OURS}
        seconds = common.timed(runs, True)
        for name, run in runs.items():
            y, ok = map(np.asarray, run())
            off = np.max(np.abs((y - before) @ atoms.T) / (before @ atoms.T), axis=1)
            error = np.mean(np.abs(y - after) / after, axis=1)
            time = np.full(len(y), seconds[name] / len(y))
            yield (gamma, name), np.stack([np.any(y < 0, axis=1), ~ok, error, off, time])


def measure(smoke):
    rows = []
    for seed, shape in list(zip(SEEDS, SHAPES, strict=True))[: 1 if smoke else None]:
        rng, found = np.random.default_rng(seed), {}
        for _ in range(1 if smoke else SYSTEMS):
            for key, states in results_of(rng, shape, 10 if smoke else CONDITIONS):
                found.setdefault(key, []).append(states)
        for (gamma, program), all_states in found.items():
            negative, failed, error, off, seconds = np.concatenate(all_states, axis=1)
            row = dict(seed=seed, shape=shape, gamma=gamma, program=program)
            row |= dict(negative=100 * np.mean(negative), failed=100 * np.mean(failed))
            row |= dict(error=np.median(error[failed == 0]), violation=np.max(off[failed == 0]))
            rows.append(row | dict(seconds=np.mean(seconds)))
            common.show(rows[-1])
    return dict(source=SOURCE, rows=rows)


# ---- The page ----


def summary(results):
    """By noise and program, over the seeds: mean shares, median error, worst balance, time."""
    found = {}
    for row in results["rows"]:
        found.setdefault((row["gamma"], row["program"]), []).append(row)
    middles = dict(negative=np.mean, failed=np.mean, error=np.median, violation=np.max)
    for key, rows in found.items():
        columns = {name: float(f([x[name] for x in rows])) for name, f in middles.items()}
        yield key, columns | dict(us=1e6 * min(x["seconds"] for x in rows))


def table(results):
    heads = ("noise", "program", "negative, %", "fails, %", "relative error", "violation", "µs")
    rows = []
    for (gamma, program), row in summary(results):
        negative, failed, *rest = row.values()
        if gamma in (0.3, 1.0):
            rows.append((gamma, program, f"{negative:.2g}", f"{failed:.2g}", *rest))
    return common.markdown(heads, rows)


def verdicts(results):
    found, row = dict(summary(results)), "Kircher and Votsmeier, random systems"
    for gamma in (0.3, 1.0):
        mine = found[gamma, OURS[2]]
        for who in ("positivity preserving", "orthogonal, backtracking"):
            error = found[gamma, who]["error"]
            yield common.Verdict(row, f"relative error, noise {gamma}", who, error, mine["error"])
    theirs = found[1.0, "positivity preserving"]["negative"]
    what = "% that are negative or fail, noise 1.0"
    yield common.Verdict(row, what, "positivity preserving", theirs, mine["failed"])


def main(argv=None):
    return common.main("positive_chemistry", __doc__, measure, argv, seed=SEEDS)


if __name__ == "__main__":
    main()
