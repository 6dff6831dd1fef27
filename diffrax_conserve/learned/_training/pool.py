"""Initial states that follow the flow map while it is trained."""

from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import optimistix as optx
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from ..._balance import refuse_rates
from ..._custom_types import Args, Manifold, RealScalarLike, Y
from ..._manifold import check_manifold, conserved_values
from ..._options import check_number
from ..._projection.project import project
from ..._tree import tree_all_finite
from .._networks.domain import FramedBox
from .._networks.flow_map import AbstractFlowMap
from .._networks.trainable import Points
from .data import as_sampler

# A function from steps, each given by an initial state and a length, to the squared norms of the
# defects at their ends.
Squares = Callable[[Points], Float[Array, " points"]]


@final
class Pool(eqx.Module):
    r"""Initial states that are drawn from `sample` and moved by the network in training.

    Pass it as `sample` to [`diffrax_conserve.fit`][]. In a solve, each step of a flow map starts at
    the end of the last one, so it must be trained on such states, and it can generate them itself.
    Whenever the recipe draws new points, the network moves each state by a step of random length,
    if its defect at the end is small, and the result is projected to the manifold through the
    state.

    Construct the network with `states` that cover about the region of the solutions: they normalise
    its inputs. The `domain` of the trained network covers them and the states of the pool in the
    second half of the epochs. (With a frame the largest clock is unchanged, because the network
    scales time by it; faster states are replaced by new ones.)

    !!! example

        ```python
        import dataclasses
        import diffrax_conserve as dfc
        import jax

        system = dfc.systems.get("conservative-lorenz")
        starts = jax.vmap(system.sample)(jax.random.split(jax.random.key(0), 200))
        network = dfc.DeepONet(starts, 0.25, width=8, depth=1, key=jax.random.key(1))
        recipe = dataclasses.replace(dfc.learned.second_order(network, epochs=50), points=50)
        pool = dfc.learned.Pool(system.sample, manifold=system.manifold)
        trained, log = dfc.fit(
            network, system.vector_field, sample=pool, recipe=recipe, key=jax.random.key(2)
        )
        assert trained.domain.upper[0] > network.domain.upper[0]
        ```
    """

    sample: Any = eqx.field(converter=as_sampler)
    manifold: Manifold | None = eqx.field(kw_only=True, default=None)
    mean_steps: RealScalarLike = eqx.field(kw_only=True, default=20)
    max_defect: RealScalarLike = eqx.field(kw_only=True, default=1.0)
    keep: Callable[[Any], Bool[Array, ""]] | None = eqx.field(kw_only=True, default=None)

    def __check_init__(self):
        if self.manifold is not None:
            check_manifold(self.manifold)
            refuse_rates(self.manifold, "a `Pool`")
        check_number("mean_steps", self.mean_steps, least=1.0, optional=False)
        check_number("max_defect", self.max_defect, above=0.0, optional=False)

    def __call__(self, key: PRNGKeyArray) -> Y:
        """A new initial state."""
        return self.sample(key)


Pool.__init__.__doc__ = r"""**Arguments:**

- `sample`: a function from a random key to an initial state of a solve, or such states, stacked
    along a leading axis.
- `manifold`: the manifold to which states are projected; each keeps its initial values of the
    integrals. Default: no projection.
- `mean_steps`: the mean number of steps before a state is replaced by a new one. Steps have random
    lengths up to the longest, so solutions are followed for about half as many longest steps.
- `max_defect`: the largest accepted defect at the end of a step, relative to the median of $|f|$
    over the first states. For a network with constant output it is about 1.
- `keep`: a function of one state that tells whether to continue from it. Others are replaced by new
    ones.

**Raises:**

`TypeError` or `ValueError` if an argument is invalid.
"""


def moved(
    pool: Pool,
    model: AbstractFlowMap,
    args: Args,
    squares: Squares,
    typical: Float[Array, ""],
    y0s: Y,
    fresh: Y,
    key: PRNGKeyArray,
) -> Y:
    """The states of a pool after one step each, with some replaced by `fresh` ones."""
    lengths_key, restarts_key = jr.split(key)
    count = jtu.tree_leaves(y0s)[0].shape[0]
    lengths = jr.uniform(lengths_key, (count,), maxval=float(model.max_step))
    small = squares(Points(lengths, y0s)) <= pool.max_defect**2 * typical
    goes_on = small & ~jr.bernoulli(restarts_key, 1 / pool.mean_steps, (count,))

    def state(y0: Y, h: Array, fresh: Y, good: Array) -> Y:
        end = jtu.tree_map(lambda a, b: jnp.asarray(a, b.dtype), model(y0, h), y0)
        if pool.manifold is not None:
            values = conserved_values(pool.manifold, 0.0, y0, args)
            end, info = project(pool.manifold, end, args=args, value=values)
            good = good & (info.result == optx.RESULTS.successful)
        good = good & tree_all_finite(end)
        if pool.keep is not None:
            good = good & pool.keep(end)
        if isinstance(model.domain, FramedBox):
            good = good & (model.domain.frame(end).clock <= model.domain.fastest)
        return jtu.tree_map(lambda a, b: jnp.where(good, a, b), end, fresh)

    return jax.vmap(state)(y0s, lengths, fresh, goes_on)
