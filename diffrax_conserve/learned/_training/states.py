"""Initial states for a flow map, taken from solutions."""

from collections.abc import Callable, Sequence
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike, Bool, PRNGKeyArray, PyTree, Real

from ..._custom_types import Args, RealScalarLike, Y
from ..._tree import tree_all_finite
from .._networks.flat import as_states
from .._networks.trainable import Sampler


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

    In a solve, each step of a flow map starts at the end of the last one, so it must be trained on
    such states. Pass the result as `states` to [`diffrax_conserve.DeepONet`][], and as `sample` to
    [`diffrax_conserve.fit`][].

    **Arguments:**

    - `vector_field`: $f(t, y, args)$, which must not depend on $t$.
    - `y0s`: initial states, stacked along a leading axis.
    - `duration`: the longest time.
    - `key`: a random key, for the times.
    - `args`: passed to `vector_field`.
    - `keep`: a function of one state that tells whether to keep it. Exclude states that change too
        fast for the step that is to be learned.
    - `solver`, `dt0`: the diffrax solver. Default: [`diffrax.Dopri8`][] with adaptive steps at a
        tolerance of $10^{-6}$. With `dt0` the steps are fixed: if `vector_field` is expensive, use
        the projected solver of a partly trained flow map with its own steps.

    **Returns:**

    The states, stacked along a leading axis: as many as `y0s`, minus those whose solve failed or
    that `keep` excludes.

    **Raises:**

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
    count = jtu.tree_leaves(y0s)[0].shape[0]
    times = jr.uniform(key, (count, 1), minval=0.0, maxval=duration)
    _, ys = _solutions(vector_field, y0s, times, args, solver, dt0, 1e-6, 1e-6)
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
    - `solver`, `dt0`: any diffrax solver; for stiff equations [`diffrax.Kvaerno5`][]. Default:
        [`diffrax.Dopri8`][]. With `dt0` its steps are fixed.
    - `rtol`, `atol`: the tolerances of adaptive steps. Default of `atol`: `rtol` times the largest
        component of all `y0s`.

    **Returns:**

    Times of shape `(m, k)` and states with leading axes `(m, k)`, without solves that failed.

    **Raises:**

    `ValueError` if all solves failed.

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
    count = jtu.tree_leaves(y0s)[0].shape[0]
    times = jnp.asarray(ts, float)
    times = jnp.broadcast_to(times, (count, times.shape[-1]))
    size = max(float(jnp.max(jnp.abs(jnp.asarray(y)))) for y in jtu.tree_leaves(y0s))
    atol = rtol * size if atol is None else atol
    return _solutions(vector_field, y0s, times, args, solver, dt0, rtol, atol)


def _solutions(
    vector_field: Any,
    y0s: Any,
    ts: Array,
    args: Args,
    solver: dfx.AbstractSolver | None,
    dt0: RealScalarLike | None,
    rtol: float,
    atol: float,
) -> tuple[Array, Any]:
    """The times and states of the solves that succeeded."""

    def solution(y0: Any, ts: Array) -> tuple[Any, Array]:
        adaptive = dfx.ClipStepSizeController(dfx.PIDController(rtol=rtol, atol=atol), step_ts=ts)
        found = dfx.diffeqsolve(
            dfx.ODETerm(vector_field),
            dfx.Dopri8() if solver is None else solver,
            0.0,
            ts[-1],
            dt0,
            y0,
            args,
            saveat=dfx.SaveAt(ts=ts),
            stepsize_controller=adaptive if dt0 is None else dfx.ConstantStepSize(),
            max_steps=_MAX_STEPS,
            adjoint=dfx.ForwardMode(),
            throw=False,
        )
        return found.ys, (found.result == dfx.RESULTS.successful) & tree_all_finite(found.ys)

    ys, good = eqx.filter_jit(jax.vmap(solution))(y0s, ts)
    return _the_good((ts, ys), good)


def _the_good(ys: Any, good: Array) -> Any:
    if not bool(jnp.any(good)):
        raise ValueError(
            "No state is left: every solve failed, or `keep` is false everywhere. Shorten the "
            "time, or give another `solver`."
        )
    return jtu.tree_map(lambda x: x[good], ys)


# A limit, because a solution with a singularity at a finite time would need infinitely many steps.
_MAX_STEPS = 10_000


def as_sampler(sample: Any) -> Sampler | None:
    """A function as it is; for stacked states one that draws from them, with replacement."""
    given = sample is None or callable(sample)
    return sample if given else eqx.Partial(_one_of, as_states(sample))


def _one_of(states: Y, key: PRNGKeyArray) -> Y:
    index = jr.randint(key, (), 0, jtu.tree_leaves(states)[0].shape[0])
    return jtu.tree_map(lambda x: x[index], states)
