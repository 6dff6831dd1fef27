"""The windows of a PINN: each starts where the one before it ends."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.tree_util as jtu
import optimistix as optx
from jaxtyping import Array

from ..._custom_types import Args, Manifold
from ..._manifold import conserved_values
from ..._projection import project
from .._networks import PINN, Window

_project = eqx.filter_jit(project)


class WindowEnds(NamedTuple):
    """The manifold that the ends of the windows are moved to."""

    manifold: Manifold
    values: Any
    args: Args

    @classmethod
    def of(cls, pinn: PINN, manifold: Manifold | None, args: Args) -> "WindowEnds | None":
        if manifold is None:
            if pinn.layer is None:
                return None
            manifold, args = pinn.layer.manifold, pinn.layer.args
        return cls(manifold, conserved_values(manifold, pinn.t0, pinn.y0, args), args)

    def __call__(self, t: Array, y: Any) -> Any:
        found, info = _project(self.manifold, y, t=t, args=self.args, value=self.values)
        # The end of a window that has not learned the solution may be too far from the manifold.
        return found if bool(info.result == optx.RESULTS.successful) else y


def with_window(pinn: PINN, index: int, window: Window, ends: WindowEnds | None) -> PINN:
    """`pinn` with this window trained and the next one starting at its end."""

    def put(i: int, stacked: Any, new: Any) -> Any:
        return jtu.tree_map(lambda x, y: x.at[i].set(y), stacked, new)

    pinn = eqx.tree_at(lambda m: m.nets, pinn, put(index, pinn.nets, window.net))
    if index + 1 == pinn.windows:
        return pinn
    t = window.start + window.length
    end = window(t)
    end = end if ends is None else ends(t, end)
    return eqx.tree_at(lambda m: m.y0s, pinn, put(index + 1, pinn.y0s, end))
