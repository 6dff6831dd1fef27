"""A physics-informed network: one solution, as a function of time."""

from collections.abc import Callable, Sequence
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from ..._custom_types import IntScalarLike, RealScalarLike, Y
from ..._options import check_counts
from ..._printing import is_traced
from ..._tree import tree_all_finite, unflatten
from .cores import MLP, Activation
from .flat import (
    as_state,
    check_key,
    check_one,
    check_scalars,
    check_within,
    flatten,
    largest,
    stacked_vectors,
    working_dtype,
)
from .layer import ConservativeLayer
from .trainable import AbstractTrainable, LayerSchedule, Points, Sampler, Times, checked_part


@final
class Window(AbstractTrainable):
    """A network for the solution through `y0`, from `start` to `start + length`."""

    net: MLP
    layer: ConservativeLayer | None
    y0: Y
    start: Float[Array, ""]
    length: Float[Array, ""]
    scale: Float[Array, " n"]

    def __call__(self, t: RealScalarLike, schedule: LayerSchedule | None = None) -> Y:
        candidate = self.candidate(t)
        if self.layer is None:
            return candidate
        return self.layer(candidate, t, (self.start, self.y0), self.scale, schedule)

    def candidate(self, t: RealScalarLike) -> Y:
        t = jnp.asarray(t).astype(self.scale.dtype)
        fraction = (t - self.start) / self.length
        out = self.net((2 * fraction - 1)[None])
        return unflatten(flatten(self.y0) + fraction * self.scale * out, self.y0)

    def draw(self, times: Times, sample: Sampler | None, count: int, key: PRNGKeyArray) -> Points:
        del sample
        times_key, _ = jr.split(key)
        return Points(self.start + times(times_key, count, 0.0, self.length), None)

    def states(
        self, points: Points, ts: Float[Array, " points"], schedule: LayerSchedule | None
    ) -> PyTree[Array]:
        del points
        # The schedule is not batched, so that iterations beyond it are not computed.
        return jax.vmap(self, in_axes=(0, None))(ts, schedule)

    def starts(self, points: Points) -> Points:
        del points
        return Points(self.start[None], jtu.tree_map(lambda x: x[None], self.y0))

    def measured(self, points: Points, rates: Y) -> Float[Array, "points n"]:
        del points
        # Relative to each leaf. A single leaf keeps its units.
        return stacked_vectors(rates) * (jnp.max(self.scale) / self.scale)

    def weights(self) -> MLP:
        return self.net

    def linear_weights(self) -> tuple[Any, ...]:
        # With a conservative layer the output is not linear in any weights.
        return self.net.weights[-1], self.net.biases[-1]


@final
class PINN(eqx.Module):
    r"""A network for the solution through one initial state, on one interval of time.

    $$u(t) = u_0 + \frac{t - t_0}{t_1 - t_0} S N(t)$$

    with a fully connected network $N$ of time scaled to $[-1, 1]$, and the largest component $S$ of
    each leaf of $u_0$; [`diffrax_conserve.fit`][] guesses that of a leaf that is zero. With a
    `layer`, the output is projected to the manifold of the conserved values at $(t_0, u_0)$. A long
    interval is divided into `windows`, each with its own network that starts where the last one
    ends: small networks on short intervals are easier to train.

    Train it by [`diffrax_conserve.fit`][], which cuts windows that are too long, and step it by
    [`diffrax_conserve.PINNSolver`][].

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax
        import jax.numpy as jnp

        y0 = {"position": jnp.array([1.0, 0.0]), "charge": jnp.array(2.0)}
        pinn = dfc.PINN(y0, 0.0, 3.0, key=jax.random.key(0))
        pinn(1.5)  # a dictionary like y0
        ```

    ??? cite "Reference"

        M. Raissi, P. Perdikaris and G. E. Karniadakis, J. Comput. Phys. 378 (2019); the ansatz is
        that of I. E. Lagaris, A. Likas and D. I. Fotiadis, IEEE Trans. Neural Networks 9 (1998).
    """

    nets: MLP  # here and in `y0s` every array has a leading axis over the windows
    layer: ConservativeLayer | None
    y0s: Y
    edges: tuple[float, ...] = eqx.field(static=True)  # the starts of the windows, and the end
    scale: Float[Array, " n"]

    def __init__(
        self,
        y0: Y,
        t0: RealScalarLike,
        t1: RealScalarLike,
        *,
        key: PRNGKeyArray,
        windows: int = 1,
        width: int = 30,
        depth: int = 1,
        activation: str | Activation = "tanh",
        slope: float | None = 2.0,
        layer: ConservativeLayer | None = None,
    ):
        check_counts(width=width, depth=depth, windows=windows)
        check_scalars(slope=slope, above=0.0)
        check_scalars(t0=t0, t1=t1, optional=False)
        check_key(key)
        if not -jnp.inf < t0 < t1 < jnp.inf:
            raise ValueError(f"`t0` must be less than `t1`, but they are {t0} and {t1}.")
        y0, length = as_state(y0), float(t1) - float(t0)
        if not is_traced(y0) and not tree_all_finite(y0):
            raise ValueError(f"`y0` is {y0}, which is not finite.")
        self.edges = (*(float(t0) + length / windows * k for k in range(windows)), float(t1))
        dtype, n, count = working_dtype(y0), flatten(y0).size, windows

        def net(key: PRNGKeyArray) -> MLP:
            return MLP(1, n, width, depth, activation, dtype, key=key, slope=slope)

        self.nets = eqx.filter_vmap(net)(key[None] if count == 1 else jr.split(key, count))
        self.y0s = jtu.tree_map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), y0)
        self.layer = checked_part("layer", layer, ConservativeLayer)
        self.scale = flatten(jtu.tree_map(_magnitude, y0))

    def __call__(self, t: RealScalarLike) -> Y:
        """The state at time `t`. Outside the interval, which is known outside of `jit`, a
        `ValueError`."""
        check_one("t", t, "pinn")
        check_within("t", t, self.t0, self.t1)
        return self.window(self._index(t))(t)

    @property
    def y0(self) -> Y:
        """The initial state."""
        return jtu.tree_map(lambda x: x[0], self.y0s)

    @property
    def windows(self) -> int:
        """The number of windows."""
        return len(self.edges) - 1

    @property
    def t0(self) -> float:
        """The initial time."""
        return self.edges[0]

    @property
    def t1(self) -> float:
        """The end of the interval."""
        return self.edges[-1]

    def window(self, index: IntScalarLike) -> Window:
        """The window with this index."""
        net, y0 = jtu.tree_map(lambda x: x[index], (self.nets, self.y0s))
        edges = jnp.asarray(self.edges, self.scale.dtype)
        return self.window_of(net, y0, edges[index], edges[index + 1])

    def window_of(self, net: MLP, y0: Y, start: RealScalarLike, end: RealScalarLike) -> Window:
        """A window with the options of this network."""
        start, length = (jnp.asarray(t, self.scale.dtype) for t in (start, end - start))
        scale = self.scale
        return Window(net=net, layer=self.layer, y0=y0, start=start, length=length, scale=scale)

    def cut(self, edges: Sequence[float], nets: MLP, y0s: Y) -> "PINN":
        """A network with the same options and these windows."""
        nets, y0s = jtu.tree_map(jnp.asarray, (nets, y0s))
        other = object.__new__(PINN)
        for name, value in {**vars(self), "nets": nets, "y0s": y0s, "edges": tuple(edges)}.items():
            object.__setattr__(other, name, value)
        return other

    def rescaled(self, field: Callable[[Any, Y], Y]) -> "PINN":
        """With a guess of the size of leaves that are zero at first, as velocities at rest are."""
        y0, length = self.y0, self.t1 - self.t0
        rate = flatten(field(self.t0, y0))
        # A little later, because the position of what starts at rest has no rate at first.
        y = unflatten(flatten(y0) + 0.01 * length * rate, y0)
        later = flatten(field(self.t0 + 0.01 * length, y))
        guess = length * jnp.maximum(jnp.abs(rate), jnp.abs(later)).astype(self.scale.dtype)
        guess = flatten(jtu.tree_map(_magnitude, unflatten(guess, y0)))
        is_zero = flatten(jtu.tree_map(lambda x: jnp.full(x.shape, jnp.all(x == 0)), y0))
        scale = jnp.where(is_zero & jnp.isfinite(guess), guess, self.scale)
        return eqx.tree_at(lambda p: p.scale, self, scale)

    def _index(self, t: RealScalarLike) -> IntScalarLike:
        if self.windows == 1:
            return 0
        t = jnp.asarray(t)
        inner = jnp.asarray(self.edges[1:-1], jnp.result_type(t, self.scale.dtype))
        return jnp.searchsorted(inner, t, side="right")


PINN.__init__.__doc__ = r"""**Arguments:**

- `y0`: the initial state $u_0$, any PyTree of real arrays.
- `t0`, `t1`: the interval of time.
- `key`: a random key, for the initial weights.
- `windows`: the number of equal intervals, each with its own network.
- `width`, `depth`: the number of units in each hidden layer, and of hidden layers.
- `activation`: `"tanh"`, `"sin"`, `"gelu"`, `"silu"`, `"softplus"`, `"sigmoid"`, or a function
    (which [`diffrax_conserve.save`][] cannot write).
- `slope`: the standard deviation of the initial slopes of the first layer, whose units have centres
    spread over the interval; Levenberg-Marquardt needs about 2. `None` for Glorot initialisation.
- `layer`: a [`diffrax_conserve.learned.ConservativeLayer`][].

**Raises:**

`ValueError` or `TypeError` if a size or the interval is invalid.
"""


def _magnitude(leaf: Array) -> Array:
    return jnp.broadcast_to(largest(leaf), leaf.shape)
