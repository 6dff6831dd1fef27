"""What a flow map is trained on: states along solutions, and pairs of states from data."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, final

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray, PyTree, Real

from ..._custom_types import Args, RealScalarLike, Y
from ..._manifold import check_vector_field
from ..._options import check_numbers, one_of
from ..._tree import tree_all_finite
from .._networks.flat import as_states
from .._networks.flow_map import AbstractFlowMap
from .._networks.trainable import LayerSchedule, Sampler


def reachable_states(
    vector_field: Callable[[RealScalarLike, Any, Args], Any],
    y0s: PyTree[ArrayLike],
    duration: RealScalarLike,
    *,
    key: PRNGKeyArray,
    args: Args = None,
    keep: Callable[[Any], Bool[Array, ""]] | None = None,
    solver: dfx.AbstractSolver | None = None,
    dt0: RealScalarLike | None = None,
) -> PyTree[Array]:
    r"""States along the solutions through `y0s`, each at a random time up to `duration`.

    In a solve, each step of a flow map starts at the end of the last one. So pass such states as
    `states` to [`diffrax_conserve.DeepONet`][], and as `sample` to [`diffrax_conserve.fit`][],
    beside `y0s` themselves if solutions soon settle.

    **Arguments:**

    - `vector_field`: $f(t, y, args)$, which must not depend on $t$.
    - `y0s`: initial states, stacked along a leading axis.
    - `duration`: the longest time.
    - `key`: a random key, for the times.
    - `args`: passed to `vector_field`.
    - `keep`: a function that tells whether to keep a state: exclude those that change too fast.
    - `solver`, `dt0`: a diffrax solver and its fixed step, such as that of a partly trained flow
        map. Default: [`diffrax.Dopri8`][] at a tolerance of $10^{-6}$.

    **Returns:**

    The states, stacked along a leading axis, without those whose solve failed. Raises a
    `ValueError` if no state is left.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax

        system = dfc.systems.get("conservative-lorenz")
        y0s = jax.vmap(system.sample)(jax.random.split(jax.random.key(0), 200))
        key = jax.random.key(1)
        states = dfc.learned.reachable_states(system.vector_field, y0s, 5.0, key=key)
        ```
    """
    count = jtu.tree_leaves(as_states(y0s, "y0s"))[0].shape[0]
    times = jr.uniform(key, (count, 1), minval=0.0, maxval=duration)
    _, ys = trajectories(vector_field, y0s, times, args=args, solver=solver, dt0=dt0, rtol=1e-6)
    ys = jtu.tree_map(lambda x: x[:, 0], ys)
    return ys if keep is None else _the_good(ys, eqx.filter_jit(jax.vmap(keep))(ys))


def trajectories(
    vector_field: Callable[[RealScalarLike, Any, Args], Any],
    y0s: PyTree[ArrayLike],
    ts: Real[ArrayLike, "..."] | Sequence[RealScalarLike],
    *,
    args: Args = None,
    solver: dfx.AbstractSolver | None = None,
    dt0: RealScalarLike | None = None,
    rtol: float = 1e-8,
    atol: float | None = None,
) -> tuple[Array, PyTree[Array]]:
    r"""The solutions through `y0s` at the times `ts`, as `data` for [`diffrax_conserve.fit`][].

    **Arguments:**

    - `vector_field`, `args`: as for [`diffrax_conserve.learned.reachable_states`][].
    - `y0s`: states at time 0, stacked along a leading axis.
    - `ts`: increasing times of shape `(k,)`, or one row for each state, `(n, k)`.
    - `solver`, `dt0`: a diffrax solver, such as [`diffrax.Kvaerno5`][] for stiff equations, and its
        fixed step. Default: [`diffrax.Dopri8`][] with adaptive steps.
    - `rtol`, `atol`: tolerances of adaptive steps. Default of `atol`: `rtol` times the largest
        component of `y0s`.

    **Returns:**

    Times of shape `(m, k)` and states with leading axes `(m, k)`, without solves that failed.
    Raises a `ValueError` if all failed.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax
        import jax.numpy as jnp

        system = dfc.systems.get("conservative-lorenz")
        y0s = jax.vmap(system.sample)(jax.random.split(jax.random.key(0), 50))
        data = dfc.learned.trajectories(system.vector_field, y0s, jnp.linspace(0.0, 2.0, 21))
        ```
    """
    check_vector_field(vector_field)
    count = jtu.tree_leaves(as_states(y0s, "y0s"))[0].shape[0]
    times = jnp.asarray(ts, float)
    times = jnp.broadcast_to(times, (count, times.shape[-1]))
    if atol is None:
        atol = rtol * max(float(jnp.max(jnp.abs(jnp.asarray(y)))) for y in jtu.tree_leaves(y0s))

    def solution(y0: Any, ts: Array) -> tuple[Any, Array]:
        adaptive = dfx.ClipStepSizeController(dfx.PIDController(rtol=rtol, atol=atol), step_ts=ts)
        controller = adaptive if dt0 is None else dfx.ConstantStepSize()
        by = dfx.Dopri8() if solver is None else solver
        # A solution with a singularity at a finite time would need infinitely many steps.
        found = dfx.diffeqsolve(
            dfx.ODETerm(vector_field), by, 0.0, ts[-1], dt0, y0, args, saveat=dfx.SaveAt(ts=ts),
            stepsize_controller=controller, adjoint=dfx.ForwardMode(), max_steps=10_000,
            throw=False,
        )  # fmt: skip
        return found.ys, (found.result == dfx.RESULTS.successful) & tree_all_finite(found.ys)

    with one_of(y0s, args):
        ys, good = eqx.filter_jit(jax.vmap(solution))(y0s, times)
    return _the_good((times, ys), good)


def _the_good(ys: Any, good: Array) -> Any:
    if not bool(jnp.any(good)):
        raise ValueError(
            "No state is left: every solve failed, or `keep` is false everywhere. Shorten the "
            "time, or give another `solver`."
        )
    return jtu.tree_map(lambda x: x[good], ys)


def as_sampler(sample: Any) -> Sampler | None:
    """A function as it is; for stacked states one that draws from them, with replacement."""
    given = sample is None or callable(sample)
    return sample if given else eqx.Partial(_one_of, as_states(sample, "sample"))


def _one_of(states: Y, key: PRNGKeyArray) -> Y:
    index = jr.randint(key, (), 0, jtu.tree_leaves(states)[0].shape[0])
    return jtu.tree_map(lambda x: x[index], states)


class Pairs(NamedTuple):
    """States, and the states on the same trajectories some time later."""

    hs: Float[Array, " points"]
    y0s: Any
    y1s: Any


@final
class Data(eqx.Module):
    """Trajectories, and how far the flow map can step from each of their states."""

    ts: Float[Array, "trajectories times"]
    ys: Any
    last: Int[Array, "trajectories times"]  # the index of the latest state within one step
    deviation: Float[Array, " n"]  # root mean square change by a step, in the units of `compared`

    def draw(self, count: int, key: PRNGKeyArray) -> Pairs:
        """Random pairs of a state and a later one within a single step."""
        first_key, second_key = jr.split(key)
        starts = (self.last > jnp.arange(self.ts.shape[1])).reshape(-1).astype(self.ts.dtype)
        place = jr.choice(first_key, starts.size, (count,), p=starts / jnp.sum(starts))
        i, j = jnp.divmod(place, self.ts.shape[1])
        ahead = jr.uniform(second_key, (count,)) * (self.last[i, j] - j)
        end = j + 1 + jnp.floor(ahead).astype(int)
        take = lambda k: jtu.tree_map(lambda y: y[i, k], self.ys)  # noqa: E731
        return Pairs(self.ts[i, end] - self.ts[i, j], take(j), take(end))

    def mismatch(
        self, model: AbstractFlowMap, pairs: Pairs, schedule: LayerSchedule | None
    ) -> Float[Array, "points n"]:
        """The differences from the later states of the pairs, relative to `deviation`."""
        found = jax.vmap(lambda y0, h: model(y0, h, schedule=schedule))(pairs.y0s, pairs.hs)
        return model.compared(found, pairs.y1s) / self.deviation

    def sample(self, key: PRNGKeyArray) -> Any:
        i, j = jnp.divmod(jr.randint(key, (), 0, self.ts.size), self.ts.shape[1])
        return jtu.tree_map(lambda y: y[i, j], self.ys)


def as_data(data: Any, flow_map: AbstractFlowMap) -> Data:
    """The trajectories `(ts, ys)`; raises unless they are valid."""
    if not (isinstance(data, tuple) and len(data) == 2):
        raise TypeError(f"`data` is a {type(data).__name__}, but it must be a pair `(ts, ys)`.")
    check_numbers("data", data)
    ts = np.asarray(data[0], float)
    ys = jtu.tree_map(jnp.asarray, data[1])
    shapes = [jnp.shape(y)[:2] for y in jtu.tree_leaves(ys)]
    if ts.ndim != 2 or not shapes or any(shape != ts.shape for shape in shapes):
        raise ValueError(
            f"In `data` the times have shape {ts.shape} and the states leading axes {shapes}, but "
            "all must be `(n, k)`: n trajectories, with k times each."
        )
    if wrong := sum(np.sum(~np.isfinite(y)) for y in (ts, *jtu.tree_leaves(ys))):
        raise ValueError(f"{wrong} numbers in `data` are not finite. Leave these trajectories out.")
    if (wrong := np.flatnonzero(np.any(np.diff(ts, axis=1) <= 0, axis=1))).size:
        raise ValueError(
            f"The times of each trajectory in `data` must increase, but those of {wrong.size}, for "
            f"example of `ts[{wrong[0]}]`, do not."
        )
    longest = float(flow_map.max_step) * (1 + 1e-6)
    last = np.stack([np.searchsorted(t, t + longest, side="right") - 1 for t in ts])
    places = np.argwhere(last > np.arange(ts.shape[1]))
    if not places.size:
        raise ValueError(
            "No two times of a trajectory in `data` are within the `max_step` of the flow map, "
            f"{flow_map.max_step}. Give it a longer one."
        )
    whole = Data(jnp.asarray(ts, jnp.result_type(float)), ys, jnp.asarray(last), jnp.ones(1))
    pairs = whole.draw(2000, jr.key(0))
    deviation = jnp.sqrt(jnp.mean(jnp.square(flow_map.compared(pairs.y1s, pairs.y0s)), axis=0))
    if not bool(jnp.all(jnp.isfinite(deviation))):
        raise ValueError(
            "`data` holds states whose coordinates are not finite, such as the logarithm of zero. "
            "Leave them out, or take `BoxCox` with a positive exponent."
        )
    return eqx.tree_at(lambda d: d.deviation, whole, jnp.where(deviation > 0, deviation, 1))
