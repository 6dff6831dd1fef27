"""The message of a failed assertion: which constraint, where, by how much, and likely causes."""

import dataclasses
from typing import Any

import diffrax as dfx
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Bool, Real

# The largest number of constraints that are shown; further ones are only counted.
_SHOWN = 5
# Residuals up to this many units of roundoff can come from roundoff alone.
_ROUNDOFF_LIKE = 1e4


@dataclasses.dataclass(frozen=True)
class Sample:
    """One scalar constraint at all times of all lanes."""

    name: str
    is_constraint: bool
    kind: str  # "saved", "dense" or "given"
    lanes: tuple[int, ...]
    ts: Real[np.ndarray, "lanes times"]
    ys: Any
    finite: Bool[np.ndarray, "lanes times"]
    residual: Real[np.ndarray, "lanes times"]
    scale: Real[np.ndarray, "lanes times"]
    found: Real[np.ndarray, "lanes times"]
    limit: Real[np.ndarray, "lanes times"]
    target: Real[np.ndarray, " lanes"]
    eps: float

    def violations(self) -> Bool[np.ndarray, "lanes times"]:
        """Where the constraint is not satisfied. NaN never satisfies it."""
        good = np.isfinite(self.limit) & (np.abs(self.residual) <= self.limit) & self.finite
        return ~good

    def place(self, lane: int, k: int) -> str:
        """Where row `k` of a lane is, in words."""
        if self.kind == "given":
            return f"at time {self.ts[lane, k]:.6g}"
        rows = np.sum(~np.isinf(self.ts[lane]))
        words = "saved state" if self.kind == "saved" else "dense output"
        out = f"at time {self.ts[lane, k]:.9g} ({words}, row {k} of {int(rows)}"
        if self.lanes:
            out += f", lane {tuple(int(i) for i in np.unravel_index(lane, self.lanes))}"
        return out + ")"


def report_constraints(samples: list[Sample]) -> None:
    """Raises an `AssertionError` unless every sample satisfies its constraint."""
    failed = [sample for sample in samples if np.any(sample.violations())]
    if not failed:
        return
    _report_nonfinite(samples)
    lines = ["The state leaves the manifold."]
    for sample in failed[:_SHOWN]:
        lines += _describe(sample)
    if len(failed) > _SHOWN:
        lines.append(f"... and {len(failed) - _SHOWN} more scalar constraints.")
    lines.append("To look at: " + _advice(samples, failed))
    raise AssertionError("\n".join(lines))


def unsuccessful(result: dfx.RESULTS, lane: tuple[int, ...], failed: int, total: int) -> str:
    """The message about a solve that reports a failure."""
    which = f" in {failed} of {total} lanes, first in lane {lane}" if lane else ""
    message = dfx.RESULTS[result].strip()
    return (
        f"The solve did not succeed{which}, so there is nothing to check:\n  {message}\n"
        "To look at: `solution.result`, the step size and `max_steps`; where the failure is meant, "
        "assert that `solution.result` is what it should be."
    )


def _report_nonfinite(samples: list[Sample]) -> None:
    for sample in samples:
        if not np.all(sample.finite):
            lane, k = map(int, np.argwhere(~sample.finite)[0])
            raise AssertionError(
                f"The state is not finite {sample.place(lane, k)}: {_state(sample, lane, k)}.\n"
                "To look at: a failed projection gives NaN in dense output; in saved states it "
                "comes from the vector field or from the solver."
            )


def _describe(sample: Sample) -> list[str]:
    bad = sample.violations()
    with np.errstate(invalid="ignore", divide="ignore"):
        units = np.abs(sample.residual) / (sample.eps * np.where(sample.scale > 0, sample.scale, 1))
    # NaN counts as the largest.
    ranking = np.where(bad, np.where(np.isnan(units), np.inf, units), -1)
    first = tuple(map(int, np.argwhere(bad)[0]))
    worst = tuple(map(int, np.unravel_index(np.argmax(ranking), ranking.shape)))
    precision = "float64" if sample.eps < 1e-10 else f"a unit of roundoff of {sample.eps:.1e}"
    lines = [f"`{sample.name}` first {sample.place(*first)}:"]
    verb = "must be 0" if sample.is_constraint else f"must stay {float(sample.target[first[0]])!r}"
    lines.append(f"    it is {float(sample.found[first])!r}, but {verb}")
    lines.append(
        f"    residual {sample.residual[first]:.3e} = {units[first]:.3g} units of roundoff "
        f"({precision}) of its scale {sample.scale[first]:.3g}; "
        f"tolerance {sample.limit[first]:.3e}"
    )
    lines.append(f"    state {_state(sample, *first)}")
    if worst != first:
        lines.append(
            f"    largest {sample.place(*worst)}: residual {sample.residual[worst]:.3e}, "
            f"{units[worst]:.3g} units of roundoff"
        )
    if bad.size > 1:
        rows = np.sum(~np.isinf(sample.ts))
        lines.append(f"    violated in {int(np.sum(bad))} of {int(rows)} rows")
    return lines


def _advice(samples: list[Sample], failed: list[Sample]) -> str:
    if failed[0].kind == "given":
        return "was the state projected (`diffrax_conserve.project`), and with this `t` and `args`?"
    if all(s.kind == "dense" for s in failed) and any(s.kind == "saved" for s in samples):
        return (
            "saved states hold and dense output does not: the solver's interpolation is not "
            "projected. `SaveAt(ts=...)` and events use it too."
        )
    if all(s.is_constraint and s.violations()[:, 0].any() for s in failed):
        return (
            "the first state violates the constraint. Project it: "
            "`y0, info = diffrax_conserve.project(manifold, y0)`."
        )
    largest = max(
        float(np.nanmax(np.abs(s.residual) / (s.eps * np.where(s.scale > 0, s.scale, 1))))
        for s in failed
    )
    if largest < _ROUNDOFF_LIKE:
        return (
            "as little as this can be roundoff that adds up, or an iteration that ends early. Is "
            "the conserved value that of the start of the solve? Is anything in a lower precision?"
        )
    return (
        "is the solver wrapped, `ManifoldProjection(solver, manifold)`, with this manifold? Are "
        "`args` those of the solve? Does the equation conserve it "
        "(`diffrax_conserve.check_invariance`)?"
    )


def _state(sample: Sample, lane: int, k: int) -> str:
    with np.printoptions(precision=9, threshold=20):
        state = jtu.tree_map(lambda y: np.asarray(y)[lane, k], sample.ys)
        return " ".join(str(state).split())
