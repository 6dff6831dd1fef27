"""Networks that are evaluated in single precision, for states in double precision."""

from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu

from .cores import AbstractCore

_Model = TypeVar("_Model")


def single_precision(flow_map: _Model) -> _Model:
    r"""The same flow map, whose network is evaluated in float32.

    A network computes in the precision of its weights. In $u(h) = T_q(u_0, h) + (h/\Delta)^{q+1} S
    G$ only $G$ is rounded to float32, about $10^{-7} S$. The state, the step, the polynomial and
    the normalisation of the inputs stay in their own precision, and so does a projection, which
    keeps conserved values to roundoff of float64. If the network's own error is larger than this
    rounding, nothing is lost. On a CPU evaluation takes about half as long, and a file about half
    the space.

    Convert a network after training: its training needs the precision of the state.

    !!! example

        ```python
        import diffrax_conserve as dfc

        flow_map = dfc.load_pretrained("conservative-lorenz")
        faster = dfc.learned.single_precision(flow_map)
        solver = dfc.DeepONetSolver(faster)
        ```

    **Arguments:**

    - `flow_map`: a [`diffrax_conserve.DeepONet`][], or any Module that contains some, such as a
        [`diffrax_conserve.learned.Repeated`][] or a solver.

    **Raises:**

    `TypeError` if it contains no `DeepONet`.
    """
    if not any(map(_is_core, jtu.tree_leaves(flow_map, is_leaf=_is_core))):
        raise TypeError(
            f"`flow_map` is {flow_map!r}, which contains no `DeepONet`. Only the network of a "
            "`DeepONet` can be evaluated in another precision than that of the state."
        )
    return jtu.tree_map(_rounded, flow_map, is_leaf=_is_core)


def _is_core(x: object) -> bool:
    return isinstance(x, AbstractCore)


def _rounded(part: object) -> object:
    def single(x: Any) -> Any:
        return x.astype(jnp.float32) if eqx.is_array(x) and x.dtype == jnp.float64 else x

    return jtu.tree_map(single, part) if _is_core(part) else part
