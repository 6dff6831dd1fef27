"""Initial states for a flow map where the solutions go."""

from collections.abc import Callable
from typing import Any, final

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike, Bool, PRNGKeyArray, PyTree

from ..._custom_types import Args, RealScalarLike, Y
from ..._tree import tree_all_finite


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

    A flow map is stepped from where its last step ended, so it must be trained there. The region
    from which initial states are drawn is rarely one that solutions stay in: of the paper's boxes
    and annuli, between 73 % and 98 % of the trajectories leave them. Pass the result as `states` to
    [`diffrax_conserve.DeepONet`][], and through [`diffrax_conserve.learned.FromStates`][] as
    `sample` to [`diffrax_conserve.fit`][].

    **Arguments:**

    - `vector_field`: $f(t, y, args)$, which must not depend on $t$.
    - `y0s`: initial states, stacked along a leading axis.
    - `duration`: the longest time.
    - `key`: a random key, for the times.
    - `args`: passed to `vector_field`.
    - `keep`: which states to keep: a function of one state. Leave out those that change too fast
        for the step that is to be learned.
    - `solver`, `dt0`: how the solutions are found. Default: [`diffrax.Dopri8`][] with adaptive
        steps at a tolerance of $10^{-6}$. With `dt0` the steps are fixed: where `vector_field` is
        expensive, take a flow map that is half trained, projected, in its own steps.

    **Returns:**

    The states, stacked along a leading axis: as many as `y0s`, less those whose solve failed or
    that `keep` leaves out.

    **Raises:**

    `ValueError` if none is left.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax

        system = dfc.systems.get("conservative-lorenz")
        y0s = jax.vmap(system.sample)(jax.random.split(jax.random.key(0), 200))
        key = jax.random.key(1)
        states = dfc.learned.reachable_states(system.vector_field, y0s, 5.0, key=key)
        deeponet = dfc.DeepONet(states, 0.25, width=8, depth=1, key=jax.random.key(2))
        ```
    """
    count = jtu.tree_leaves(y0s)[0].shape[0]
    times = jr.uniform(key, (count,), minval=0.0, maxval=duration)
    adaptive = dfx.PIDController(rtol=1e-6, atol=1e-6)
    controller = adaptive if dt0 is None else dfx.ConstantStepSize()
    method = dfx.Dopri8() if solver is None else solver

    @eqx.filter_jit
    def state(y0: Y, t: Array) -> tuple[Y, Array]:
        solution = dfx.diffeqsolve(
            dfx.ODETerm(vector_field),  # pyright: ignore[reportArgumentType]
            method,
            0.0,
            t,
            dt0,
            y0,
            args,
            stepsize_controller=controller,
            max_steps=_MAX_STEPS,
            adjoint=dfx.ForwardMode(),
            throw=False,
        )
        y = jtu.tree_map(lambda x: x[-1], solution.ys)
        good = (solution.result == dfx.RESULTS.successful) & tree_all_finite(y)
        return y, good if keep is None else good & keep(y)

    ys, good = eqx.filter_jit(jax.vmap(state))(y0s, times)
    if not bool(jnp.any(good)):
        raise ValueError(
            "No state is left: every solve failed, or `keep` is false everywhere. Shorten "
            "`duration`, or give another `solver`."
        )
    return jtu.tree_map(lambda x: x[good], ys)


# Where a solution ends in finite time, the steps towards its end would never end.
_MAX_STEPS = 10_000


@final
class FromStates(eqx.Module):
    """A sampler for [`diffrax_conserve.fit`][] that draws from given states, with replacement."""

    states: Y

    def __call__(self, key: PRNGKeyArray) -> Y:
        count = jtu.tree_leaves(self.states)[0].shape[0]
        index = jr.randint(key, (), 0, count)
        return jtu.tree_map(lambda x: x[index], self.states)


FromStates.__init__.__doc__ = """**Arguments:**

- `states`: the states, stacked along a leading axis.
"""
