"""Training from data: pairs of states along trajectories."""

from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from .._networks.flow_map import AbstractFlowMap
from .._networks.trainable import LayerSchedule


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
        end = (
            j + 1 + jnp.floor(jr.uniform(second_key, (count,)) * (self.last[i, j] - j)).astype(int)
        )
        take = lambda k: jtu.tree_map(lambda y: y[i, k], self.ys)  # noqa: E731
        return Pairs(self.ts[i, end] - self.ts[i, j], take(j), take(end))

    def mismatch(
        self, model: AbstractFlowMap, pairs: Pairs, schedule: LayerSchedule | None
    ) -> Float[Array, "points n"]:
        """The differences from the later states of the pairs, relative to `deviation`."""
        found = jax.vmap(lambda y0, h: model(y0, h, schedule=schedule))(pairs.y0s, pairs.hs)
        return model.compared(found, pairs.y1s) / self.deviation

    def sample(self, key: PRNGKeyArray) -> Any:
        """One of the states."""
        i, j = jnp.divmod(jr.randint(key, (), 0, self.ts.size), self.ts.shape[1])
        return jtu.tree_map(lambda y: y[i, j], self.ys)


def as_data(data: Any, flow_map: AbstractFlowMap) -> Data:
    """The trajectories `(ts, ys)`; raises unless they are valid."""
    if not (isinstance(data, tuple) and len(data) == 2):
        raise TypeError(f"`data` is {type(data).__name__}, but it must be a pair `(ts, ys)`.")
    ts = np.asarray(data[0], float)
    ys = jtu.tree_map(jnp.asarray, data[1])
    shapes = [jnp.shape(y)[:2] for y in jtu.tree_leaves(ys)]
    if ts.ndim != 2 or not shapes or any(shape != ts.shape for shape in shapes):
        raise ValueError(
            f"In `data` the times have shape {ts.shape} and the states leading axes {shapes}, but "
            "all must be `(n, k)`: n trajectories, with k times each. For a single one write "
            "`ts[None]` and `jax.tree.map(lambda y: y[None], ys)`."
        )
    finite = [np.all(np.isfinite(y)) for y in (ts, *jtu.tree_leaves(ys))]
    if not all(finite) or np.any(np.diff(ts, axis=1) <= 0):
        raise ValueError("The times in `data` must increase, and all its numbers be finite.")
    longest = float(flow_map.max_step) * (1 + 1e-6)
    last = np.stack([np.searchsorted(t, t + longest, side="right") - 1 for t in ts])
    places = np.argwhere(last > np.arange(ts.shape[1]))
    if not places.size:
        raise ValueError(
            f"No two times of a trajectory in `data` are within {flow_map.max_step}, the "
            "`max_step` of the flow map. Give it a longer one, or data with shorter steps."
        )
    whole = Data(jnp.asarray(ts, jnp.result_type(float)), ys, jnp.asarray(last), jnp.ones(1))
    pairs = whole.draw(_MANY, jr.key(0))
    deviation = jnp.sqrt(jnp.mean(jnp.square(flow_map.compared(pairs.y1s, pairs.y0s)), axis=0))
    return eqx.tree_at(lambda d: d.deviation, whole, jnp.where(deviation > 0, deviation, 1))


_MANY = 2000
