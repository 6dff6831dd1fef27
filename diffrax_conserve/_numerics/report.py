"""The report on a projection."""

import equinox as eqx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from .._printing import is_traced, names_at, printed

# What `print` says of a projection that has not reached the manifold.
_MISSED = """the manifold was not reached. What is asked for may contradict itself: entries that
exclude each other, bounds, or a `value` that no state has. If `residual_after` is small, redundant
entries agree only to that: leave one out, or pass a larger `rtol` to the projection. From a state
where a gradient is zero no direction leads to the manifold: start beside it."""


class ProjectionInfo(eqx.Module):
    """The report on a projection.

    **Attributes:**

    - `ok`: whether the projection succeeded: every residual is within its tolerance at the state
        that is returned, and what else the projection asks of it holds.
    - `result`: an `optimistix.RESULTS`, successful if and only if `ok`; `nonfinite` if a
        residual of the candidate is not finite, divergence if only one of the result is not.
    - `num_iterations`: the number of iterations.
    - `residual_before`, `residual_after`: the largest residual of the candidate and of the
        projected state, relative to the scale of its constraint at the latter,
        $|I_0| + \\sum_k |y_k \\partial g/\\partial y_k|$ plus the terms that cancel inside `fn`.
    - `correction`: the length of the projected state minus the candidate in the metric of the
        projection.
    - `roundoff`: the largest share of a scale that the gradient does not show: near one where `fn`
        is less accurate than its gradient tells, as `1 - cos(q)` near zero.
    - `worst`: the position in `names` of the entry whose relative residual is large both before and
        after, which tells the cause of a failure. `print` shows the name.
    - `names`: the names of the entries of the manifold, such as `manifold['energy']`.
    """

    ok: Bool[Array, ""]
    result: optx.RESULTS
    num_iterations: Int[Array, ""]
    residual_before: Float[Array, ""]
    residual_after: Float[Array, ""]
    correction: Float[Array, ""]
    roundoff: Float[Array, ""]
    worst: Int[Array, ""]
    names: tuple[str, ...] = eqx.field(static=True)

    @property
    def num_steps(self) -> Int[Array, ""]:
        """The former name of `num_iterations`."""
        return self.num_iterations

    def __str__(self) -> str:
        if is_traced(self):
            return repr(self)
        ok = np.asarray(self.ok)
        if ok.ndim > 0:
            title = f"{ok.sum()} of {ok.size} projections succeeded"
        else:
            missed = self.result == optx.RESULTS.nonlinear_max_steps_reached
            reason = _MISSED if missed else optx.RESULTS[self.result]
            title = "projected" if ok else f"NOT PROJECTED: {reason}"
        numbers = ("num_iterations", "residual_before", "residual_after", "correction", "roundoff")
        rows = {name: getattr(self, name) for name in numbers}
        worst = {} if ok.all() else {"worst": names_at(self.worst, self.names)}
        return printed(title, rows | worst)
