"""What `compare` returns: errors with and without projection, a sentence about them, a picture.

Each component of a state is a quantity of its own here, and counts as much as any other: an error
is a geometric mean over the components. In the ratio of two such means all units cancel, so no
verdict depends on units, nor on how a state is packed into leaves.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

# The name of the solve without projection.
NOTHING = "nothing kept"
# The reference is trusted where the two of its solves differ by at most this share of the smallest
# error. Its own error is smaller, because one of the tolerances is a hundredth of the other.
_TRUSTED = 1 / 3
# If every error is larger than this share of the state, none of the solutions tells anything.
_LOST = 0.3
# A lane that can be judged for less than this share of its interval counts as not judged.
_SHORTEST = 0.1
# A projection whose error differs by less than this share from that without one changes it little,
# if that of no component is larger by more.
_EQUAL = 0.1
# The least error decides only if it is smaller by this factor. Otherwise the first choice is taken,
# which keeps more: smaller differences depend on the interval and on what is measured, and errors
# grow faster where less is kept (`benchmarks/studies/verdict.py`).
_MARGIN = 1.5
# Where a projection is about as accurate as none in the mean, it is not taken if a lane is worse by
# this factor.
_RISK = 1.5
# A component that is less accurate by this factor is told, and is a reason not to project, unless
# the error in the mean falls by the same factor.
WORSE = 3
# An error below this is roundoff. It stands in the place of zero, which has no logarithm.
_TINY = 1e-18
# A change of a conserved combination that is larger than this is more than roundoff; so is an error
# that is a larger share of the largest value of its component.
_BROKEN = 1e-11
# An entry is kept by the solver itself only if it drifts by less than the error of the state over
# this. So one that a solve keeps because it is accurate is not taken for one.
_FROM_ERRORS = 1e3
# So much of the largest component of all may be left in others where terms cancel.
_CANCELLED = 1e-14


def distance(ys: Any, exact: Any, judged: Any) -> Float[np.ndarray, "lanes times"]:
    """The error of states with leading axes over lanes and times: the largest so far of each
    component, relative to its largest value, in the geometric mean over those that are `judged`.
    NaN where it is not known."""
    y, x = _flat(ys), _flat(exact)
    size = np.max(np.abs(x), axis=1, keepdims=True)
    with np.errstate(invalid="ignore", over="ignore"):
        error = _running(np.abs(y - x)) / np.where(size == 0, 1, size)
    return np.exp(np.mean(np.log(np.maximum(error[..., judged], _TINY)), axis=2))


def judged(plain: Any, exact: Any) -> Bool[np.ndarray, " n"]:
    """Which components are judged: those that have an error without projection, more than that of
    roundoff. Others, such as parameters, tell only if they are worsened."""
    x = _flat(exact)
    error = np.max(np.abs(_flat(plain) - x), axis=1)
    found = ~np.all(error <= _roundoff(x), axis=0)  # what is NaN is judged
    return found if found.any() else ~found


def _flat(ys: Any) -> Shaped[np.ndarray, "lanes times n"]:
    """The components of states with leading axes over lanes and times."""
    leaves = [np.asarray(y).reshape(*y.shape[:2], -1) for y in jtu.tree_leaves(ys)]
    return np.concatenate(leaves, axis=2)


def _roundoff(x: np.ndarray) -> Float[np.ndarray, "lanes n"]:
    """An error that may be roundoff, for each component."""
    size = np.max(np.abs(x), axis=1)
    return np.maximum(_BROKEN * size, _CANCELLED * np.max(size, axis=1, keepdims=True)) + _TINY


def by_errors(ys: Any, exact: Any) -> Any:
    """The weights of a metric, with a leaf for each leaf of a state: the inverse squares of the
    largest errors of the components. Relative to the largest value of its component an error counts
    as at least `√ε` of the largest of all.

    Of all states with the given values the nearest in this metric is the most likely one, if errors
    are independent, with these sizes.
    """
    sizes, errors = [], []
    for y, x in zip(jtu.tree_leaves(ys), jtu.tree_leaves(exact), strict=True):
        off, size = (np.where(np.isfinite(a), np.abs(a), 0) for a in (y - x, x))
        size = np.max(size, axis=(0, 1))
        sizes.append(np.where(size > 0, size, 1.0))
        errors.append(np.max(off, axis=(0, 1)) / sizes[-1])
    top = max(np.max(e, initial=0) for e in errors) or 1.0
    leaves, tree = jtu.tree_flatten(ys)
    least = [float(np.finfo(y.dtype).eps) ** 0.5 for y in leaves]
    parts = zip(errors, sizes, least, strict=True)
    return jtu.tree_unflatten(tree, [(size * np.maximum(e / top, a)) ** -2 for e, size, a in parts])


def worsened(
    plain: Any, exact: Any, rough: Any, last: Int[np.ndarray, " lanes"], ys: Any
) -> tuple[str, float]:
    """The component that is least accurate beside the solve without projection, and by which
    factor, in the geometric mean over the lanes. Errors are the largest up to the last time that is
    judged, and count if they are larger than roundoff and than the doubt about the reference."""
    lanes = last > 0
    if not lanes.any():
        return "", 1.0
    early = (np.arange(_flat(ys).shape[1]) <= last[:, None])[..., None]
    y, before, x, doubt = (_flat(a) for a in (ys, plain, exact, rough))
    largest = lambda a: np.max(np.abs(a), 1, where=early, initial=0)[lanes]  # noqa: E731
    least = np.maximum(3 * largest(doubt - x), _roundoff(np.where(early, x, 0))[lanes])
    now, then = (np.maximum(largest(a - x), least) for a in (y, before))
    # A lane that failed tells nothing here.
    factor = np.exp(np.mean(np.nan_to_num(np.log(now / then)), axis=0))
    most = int(np.argmax(factor))
    return (_names(ys)[most], float(factor[most])) if factor[most] > 1 else ("", 1.0)


def _names(ys: Any) -> list[str]:
    """The names of the components of a state, such as `y['q'][1, 2]`."""
    found = []
    for path, y in jtu.tree_flatten_with_path(ys)[0]:
        places = (", ".join(map(str, place)) for place in np.ndindex(y.shape[2:]))
        found += [f"y{jtu.keystr(path)}" + (f"[{place}]" if place else "") for place in places]
    return found


@dataclasses.dataclass(frozen=True)
class ComparisonRow:
    """One solver of a comparison.

    - `name`: such as `"all but energy, metric=1.0"`.
    - `kept`: the names of the entries that it keeps.
    - `solver`: itself, ready for `diffrax.diffeqsolve`.
    - `errors`: the error of the state in each lane up to each time.
    - `success`, `message`: whether each lane succeeded, and why the first of the others did not.
    - `drift`: the largest drift of each entry in each lane, kept or not.
    - `linear`: the largest change in each lane of linear invariants that nobody declared.
    - `steps`: the number of steps in each lane; `seconds`: the time of one solve.
    - `worsened`: the component that is least accurate beside the solve without projection, and by
        which factor. What is smaller than roundoff, 1e-11 of the largest value of the component and
        1e-14 of that of all components, or than the doubt about the reference, counts as that
        large.
    """

    name: str
    kept: tuple[str, ...]
    solver: dfx.AbstractSolver
    errors: Float[np.ndarray, "lanes times"]
    success: Bool[np.ndarray, " lanes"]
    message: str
    drift: dict[str, Float[np.ndarray, " lanes"]]
    linear: Float[np.ndarray, " lanes"]
    steps: Int[np.ndarray, " lanes"]
    seconds: float
    worsened: tuple[str, float] = ("", 1.0)


@dataclasses.dataclass(frozen=True)
class ComparisonReport:
    """What `compare` found, printed as a table with a sentence that says what to take.

    - `rows`: a [`diffrax_conserve.ComparisonRow`][] for each solver, without projection first.
    - `ts`: the times at which states were compared.
    - `doubt`: how far the two solves of the reference are apart, in each lane at each time.
    - `num_linear`: the number of linear invariants that no entry declares.
    - `not_conserved`: the entries that change along the reference, and by which drift.
    """

    rows: tuple[ComparisonRow, ...]
    ts: Float[np.ndarray, " times"]
    doubt: Float[np.ndarray, "lanes times"]
    num_linear: int
    not_conserved: dict[str, float] = dataclasses.field(default_factory=dict)

    # ---- What is judged ----

    @property
    def _best(self) -> Float[np.ndarray, "lanes times"]:
        """The smallest error of all rows, each the largest up to its time."""
        return np.min([_so_far(row) for row in self.rows], axis=0)

    @property
    def last(self) -> Int[np.ndarray, " lanes"]:
        """The index of the last time that is judged in each lane; 0 if none is."""
        best = self._best
        with np.errstate(invalid="ignore"):
            known = (_running(self.doubt) <= _TRUSTED * best) & (best <= _LOST)
        known[:, 0] = True
        last = known.shape[1] - 1 - np.argmax(known[:, ::-1], axis=1)
        return np.where(
            self.ts[last] - self.ts[0] >= _SHORTEST * (self.ts[-1] - self.ts[0]), last, 0
        )

    @property
    def error(self) -> Float[np.ndarray, "rows lanes"]:
        """The largest error of each row and lane up to the last time that is judged: infinite if
        the solve failed, NaN if nothing is judged."""
        last, lanes = self.last, np.arange(self.doubt.shape[0])
        found = np.stack([_so_far(row) for row in self.rows])[:, lanes, last]
        return np.where(last > 0, found, np.nan)

    @property
    def index(self) -> int | None:
        """The row to take; `None` if that cannot be said."""
        error = self.error
        worsened = np.array([row.worsened[1] for row in self.rows])
        found = _chosen(error, worsened, self._is_conserved)
        if not found or not {*self.rows[found].kept} <= {*self.kept_anyway}:
            return found
        # Only bounds can gain where all entries are kept anyway.
        gain = _mean(error[found]) < (1 - _EQUAL) * _mean(error[0])
        return found if gain else 0

    @property
    def _is_conserved(self) -> list[bool]:
        """Whether all that a row keeps is conserved."""
        return [not {*row.kept} & {*self.not_conserved} for row in self.rows]

    @property
    def kept_anyway(self) -> tuple[str, ...]:
        """The entries that the solver keeps to roundoff without projection, such as linear ones by
        a Runge-Kutta method."""
        plain = self.rows[0]
        if not plain.success.all():
            return ()
        limit = np.minimum(_BROKEN, plain.errors[:, -1] / _FROM_ERRORS)
        return tuple(name for name, drift in plain.drift.items() if np.all(drift <= limit))

    @property
    def choice(self) -> str | None:
        """The name of the row to take."""
        return None if self.index is None else self.rows[self.index].name

    @property
    def solver(self) -> dfx.AbstractSolver:
        """The solver to take; that without projection if nothing can be said."""
        return self.rows[self.index or 0].solver

    # ---- Words ----

    @property
    def verdict(self) -> str:
        """What to take, in one sentence."""
        if self.index is None:
            if not any(row.success.all() for row in self.rows) and np.isfinite(self.doubt).all():
                return f"Take shorter steps: every solve fails ({self.rows[0].message})."
            return self._unjudged()
        error = np.maximum(self.error[:, self.last > 0], _TINY)
        failures = np.sum(np.isinf(error), axis=1)
        if failures[0] > failures[self.index]:
            where = f" in {failures[0]} of {error.shape[1]} lanes" if error.shape[1] > 1 else ""
            return f"Take `{self.choice}`: without projection the solve fails{where}{self._linear}."
        ratios = error[:, np.isfinite(error[0])] / error[0, np.isfinite(error[0])]
        if self.index > 0:
            told = f"Take `{self.choice}`: "
            if _mean(ratios[self.index]) >= 1 - _EQUAL:
                told = f"Projecting changes the error little: `{self.choice}` is good for what it "
                told += "keeps, and "
            found = f"{told}{self._until}{_compared(ratios[self.index])}"
            return f"{found}{self._worse(self.index)}{self._linear}."
        rivals = [i for i in range(1, len(ratios)) if np.isfinite(ratios[i]).all()]
        if not rivals:
            where = " in some lane" if error.shape[1] > 1 else ""
            return f"Do not project: every projection fails{where}."
        best = min(rivals, key=lambda i: _mean(ratios[i]))
        name = self.rows[best].name
        lacking = [f"`{x}`" for x in self.rows[best].kept if x in self.not_conserved]
        reason = f"{' and '.join(lacking)} {'are' if lacking[1:] else 'is'} not conserved; "
        told = f"Do not project: {reason if lacking else ''}{self._until}with `{name}`, the best "
        told += "of the projections, "
        return f"{told}{_compared(ratios[best])}{self._worse(best)}."

    def _worse(self, index: int) -> str:
        name, factor = self.rows[index].worsened
        return f", but `{name}` is {factor:.2g} times less accurate" * (factor > WORSE)

    def _unjudged(self) -> str:
        if not np.isfinite(self.doubt).all():
            return (
                "Nothing can be said, because the reference failed: pass a shorter interval, or "
                "another `reference`, such as `diffrax.Kvaerno5()` for a stiff field."
            )
        best = self._best
        if np.median(best[:, 1:]) > _LOST:
            return (
                "Nothing can be said, because every error is as large as the state nearly from the "
                "start on: pass shorter steps, or a shorter interval."
            )
        return (
            "Nothing can be said, because the reference cannot be trusted: two of its solves "
            f"differ by {np.median(self.doubt[:, -1]):.0e} at the end, and the smallest error is "
            f"{np.median(best[:, -1]):.0e}; pass a shorter interval, or larger tolerances."
        )

    @property
    def notes(self) -> list[str]:
        """What else there is to know, a sentence each."""
        found = [*self._horizon(), *self._failures(), *self._broken(), *self._units()]
        found += [
            f"`{name}` is not conserved: its drift along the reference is {drift:.1g}."
            for name, drift in self.not_conserved.items()
        ]
        if self.kept_anyway:
            names = ", ".join(f"`{name}`" for name in self.kept_anyway)
            found.append(
                f"The solver keeps {names} to roundoff without projection: alone that needs none."
            )
        if self.doubt.shape[0] == 1:
            found.append("This is one start: others may differ, so try several with `batch=True`.")
        return found

    @property
    def _end(self) -> float:
        """The last time at which every judged lane is judged."""
        return float(self.ts[self.last[self.last > 0]].min())

    @property
    def _until(self) -> str:
        end = float(self.ts[-1])
        return f"up to t = {self._end:.3g} of {end:.3g} " * (self._end < end)

    def _horizon(self) -> list[str]:
        last, end = self.last, len(self.ts) - 1
        if self.index is None or np.all(last == end):
            return []
        best = self._best[:, -1]
        cause = "the reference cannot be trusted"
        if np.all(best[last < end] > _LOST):
            cause = "every error is as large as the state"
        found = f"Judged up to t = {self._end:.3g} only, because later {cause}, as in chaos."
        if np.any(last == 0):
            found += f" {np.sum(last == 0)} of {len(last)} lanes are not judged at all."
        return [found]

    def _failures(self) -> list[str]:
        lanes = self.doubt.shape[0]
        return [
            f"`{row.name}` fails"
            + (f" in {np.sum(~row.success)} of {lanes} lanes" if lanes > 1 else "")
            + f": {row.message}."
            for row in self.rows
            if not row.success.all()
        ]

    @property
    def _broken_by(self) -> float:
        """By how much the choice breaks linear invariants that nobody declared; or zero."""
        row = self.rows[self.index or 0]
        change, before = (np.max(r.linear, initial=0) for r in (row, self.rows[0]))
        return float(change) if row.kept and change > max(_BROKEN, 10 * before) else 0.0

    @property
    def _linear(self) -> str:
        return "; without `keep_linear=True` it breaks linear invariants" * (self._broken_by > 0)

    def _broken(self) -> list[str]:
        if not self._broken_by:
            return []
        return [
            f"It changes linear invariants that nobody declared, by {self._broken_by:.0e} of the "
            "sizes of the components: `ManifoldProjection(..., keep_linear=True)` keeps them, and "
            "`find_invariants(vector_field, states, basis=1)` finds them."
        ]

    def _units(self) -> list[str]:
        choice = self.choice or ""
        if "metric=1.0" in choice:
            return ["`metric=1.0` depends on the units of the state."]
        by = [name for name in ("metric by sizes", "metric by errors") if name in choice]
        return [f"`{name}` is `report.solver.projection.metric`." for name in by]

    def __str__(self) -> str:
        lanes = self.doubt.shape[0]
        head = ["error"] if lanes == 1 else ["error", "worst", "worse"]
        head += [f"drift of {name}" for name in self.rows[0].drift]
        head += ["linear"] * (self.num_linear > 0) + ["steps", "time"]
        width = max(len(row.name) for row in self.rows)
        table = ["  ".join([" " * width, *(f"{x:>10}" for x in head)])]
        for i, row in enumerate(self.rows):
            cells = [f"{x:>{max(10, len(h))}}" for x, h in zip(self._cells(i), head, strict=True)]
            table.append("  ".join([f"{row.name:{width}}", *cells]))
        return "\n".join([*table, *self.notes, self.verdict])

    def _cells(self, i: int) -> list[str]:
        row, error, first = self.rows[i], self.error, self.error[0]
        if error.shape[1] == 1:
            found = [_number(error[i, 0])]
        else:
            judged = self.last > 0
            worse = np.mean(error[i, judged] > first[judged]) if judged.any() else np.nan
            found = [_number(_of_known(of, error[i])) for of in (np.median, np.max)]
            found.append(f"{worse:.0%}" if i else "")
        largest = [*row.drift.values(), *([row.linear] if self.num_linear else [])]
        found += [_number(_of_known(np.max, x)) for x in largest]
        return [*found, f"{np.median(row.steps):.0f}", _duration(row.seconds)]

    def plot(self, ax: Any = None) -> Any:
        """Draws the error against time, in a batch its median over the lanes, and returns the axes.

        At most six curves are drawn: that without projection, and the best others. It needs
        matplotlib: `pip install '.[plots]'` in the folder of diffrax-conserve.

        **Arguments:**

        - `ax`: the axes of matplotlib to draw in. Default: those of a new figure.
        """
        import matplotlib.pyplot as plt

        if ax is None:
            _, ax = plt.subplots(layout="constrained")
        means = [_mean(np.maximum(x, _TINY)) for x in self.error]
        shown = [0, *sorted(np.argsort(means[1:], kind="stable")[:5] + 1)]
        for i in shown:
            row = self.rows[i]
            if not row.success.any():
                continue
            curve = np.median(row.errors[row.success], axis=0)
            look = dict(linewidth=2.5) if i == self.index else dict(linewidth=1)
            ax.semilogy(self.ts[1:], np.maximum(curve[1:], _TINY), label=row.name, **look)
        doubt = np.median(self.doubt, axis=0)
        ax.semilogy(self.ts[1:], np.maximum(doubt[1:], _TINY), "k:", linewidth=1, label="reference")
        ax.set(xlabel="t", ylabel="relative error of the state")
        ax.legend()
        return ax


def _so_far(row: ComparisonRow) -> np.ndarray:
    """The largest error up to each time; infinite in lanes that failed."""
    return np.where(row.success[:, None], _running(row.errors), np.inf)


def _running(errors: np.ndarray) -> np.ndarray:
    return np.maximum.accumulate(errors, axis=1)


def _of_known(function: Callable[[np.ndarray], Any], x: np.ndarray) -> float:
    """The function of the elements that are not NaN, or NaN if there is none."""
    known = x[~np.isnan(x)]
    return float(function(known)) if known.size else np.nan


def _mean(errors: np.ndarray) -> float:
    """The geometric mean, infinite if an error is."""
    return _of_known(lambda x: np.exp(np.mean(np.log(x))), errors)


def _chosen(error: np.ndarray, worsened: np.ndarray, conserved: list[bool]) -> int | None:
    """Of the rows that fail in the fewest lanes, the first with a projection of which the geometric
    mean of the errors is about the least; if none gains, the first that changes little, in every
    component, and keeps only what is conserved. What spoils a component must gain as much in the
    mean, and comes last."""
    error = np.maximum(error[:, ~np.isnan(error).any(axis=0)], _TINY)
    failures = np.sum(np.isinf(error), axis=1)
    able = np.flatnonzero(failures == failures.min())
    common = np.isfinite(error[able]).all(axis=0)
    if not common.any():
        return None
    means = {int(i): _mean(error[i, common]) for i in able}
    spoils = lambda i: worsened[i] > WORSE  # noqa: E731
    if 0 in means:
        means = {i: x for i, x in means.items() if not spoils(i) or WORSE * x < means[0]}
    near = [i for i, mean in means.items() if mean <= _MARGIN * min(means.values())]
    near.sort(key=spoils)
    if 0 not in means:
        return near[0]
    worst = {i: np.max(error[i, common] / error[0, common]) for i in means}
    gains = [i for i in near if means[i] < (1 - _EQUAL) * means[0]]
    little = [i for i in near if means[i] <= (1 + _EQUAL) * means[0]]
    equal = [i for i in little if worst[i] <= _RISK and worsened[i] <= 1 + _EQUAL and conserved[i]]
    return next((i for i in [*gains, *equal] if i > 0), 0)


def _compared(ratios: np.ndarray) -> str:
    found = f"the error is {_mean(ratios):.2g} times that without projection"
    if ratios.size == 1:
        return found
    found += f" in the geometric mean of {ratios.size} lanes"
    with np.errstate(invalid="ignore"):
        error = np.exp(np.std(np.log(ratios), ddof=1) / ratios.size**0.5)
    if error > 1 + _EQUAL:
        found += f", which other lanes would change by a factor of about {error:.2g}"
    found += f", and {np.max(ratios):.2g} times at worst"
    larger = int(np.sum(ratios > 1))
    return found + f"; in {larger} of them it is larger" if larger else found


def _number(x: float) -> str:
    return "-" if np.isnan(x) else "failed" if np.isinf(x) else f"{x:.1e}"


def _duration(seconds: float) -> str:
    return f"{1e6 * seconds:.3g} µs" if seconds < 1e-3 else f"{1e3 * seconds:.3g} ms"
