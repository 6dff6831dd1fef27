"""A learned flow map as a diffrax solver."""

from collections.abc import Callable
from typing import Any, ClassVar, final

import diffrax as dfx
import equinox as eqx
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from .._custom_types import VF, Args, BoolScalarLike, DenseInfo, RealScalarLike, Y
from ._chebyshev import ChebyshevInterpolation, series
from ._learned import check_learned_terms, check_nodes, check_output
from ._refusal import refuse_if
from ._terms import time_direction

# `(y0, h) ↦ y` with an attribute `max_step`: a `DeepONet`, or a Module of the user's own.
FlowMap = Any


@final
class DeepONetSolver(dfx.AbstractSolver[None]):
    r"""Steps a learned flow map: $y_{n+1} = \Phi(y_n, h)$.

    The vector field in the term is not evaluated: it is what the flow map was trained for. Steps
    may have any length up to `flow_map.max_step`; a longer one, or a solve backwards in time, is
    refused at run time. There is no error estimate, so use fixed steps
    ([`diffrax.ConstantStepSize`][], [`diffrax.StepTo`][]).

    Dense output follows the flow map inside the step: it is the polynomial through its states at
    `nodes` Chebyshev points, which are computed only where dense output, saved times or an event
    ask for them. The weights are not copied.

    Derivatives with respect to the initial state and the weights are those of the flow map. The
    `args` of the solve are not seen by the flow map; inside
    [`diffrax_conserve.ManifoldProjection`][] they are seen by the manifold.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc

        system = dfc.systems.get("conservative-lorenz")
        solver = dfc.DeepONetSolver(dfc.load_pretrained("conservative-lorenz-standard"))
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(system.vector_field),
            dfc.ManifoldProjection(solver, system.manifold, projection=dfc.Newton()),
            t0=0.0,
            t1=5.0,
            dt0=0.25,
            y0=system.y0,
        )
        ```

    ??? cite "Reference"

        S. Wang and P. Perdikaris, "Long-time integration of parametric evolution equations with
        physics-informed DeepONets", J. Comput. Phys. 475 (2023).
    """

    flow_map: FlowMap
    nodes: int = eqx.field(static=True)

    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., ChebyshevInterpolation]] = ChebyshevInterpolation

    def __init__(self, flow_map: FlowMap, *, nodes: int = 12):
        self.flow_map = flow_map
        self.nodes = nodes

    def __check_init__(self):
        check_nodes(self.nodes)
        if not (callable(self.flow_map) and hasattr(self.flow_map, "max_step")):
            raise TypeError(
                f"`flow_map` is {self.flow_map!r}, which is no flow map. Pass a `DeepONet`, or a "
                "Module that is called as `(y0, h) -> y` and has an attribute `max_step`, the "
                "longest step that it was trained for."
            )

    def order(self, terms: dfx.AbstractTerm) -> None:
        del terms

    def init(
        self,
        terms: dfx.AbstractTerm,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
    ) -> None:
        del args
        check_learned_terms(terms, "DeepONetSolver")
        check_output(self.flow_map, (y0, t1 - t0), y0, "flow_map")

    def step(
        self,
        terms: dfx.AbstractTerm,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: None,
        made_jump: BoolScalarLike,
    ) -> tuple[Y, None, DenseInfo, None, dfx.RESULTS]:
        del args, solver_state, made_jump
        h = _checked_step(jnp.asarray(t1 - t0), t1, terms, self.flow_map.max_step)
        y1 = self.flow_map(y0, h)
        y1 = jtu.tree_map(lambda a, b: a.astype(jnp.result_type(b)), y1, y0)
        coefficients = series(lambda c: self.flow_map(y0, c * h), self.nodes, h.dtype)
        return y1, None, dict(coefficients=coefficients), None, dfx.RESULTS.successful

    def func(self, terms: dfx.AbstractTerm, t0: RealScalarLike, y0: Y, args: Args) -> VF:
        return terms.vf(t0, y0, args)


DeepONetSolver.__init__.__doc__ = r"""**Arguments:**

- `flow_map`: a [`diffrax_conserve.DeepONet`][], or any Module that is called as `(y0, h) -> y` and
    has an attribute `max_step`.
- `nodes`: how many states of a step dense output goes through.

**Raises:**

`TypeError` or `ValueError` if the flow map cannot be called so, or returns another structure than
the state's; at run time an error that names the length of a step that is too long or negative.
"""


def _checked_step(h: Array, t1: RealScalarLike, terms: Any, max_step: Any) -> Array:
    known = not isinstance(max_step, jax.core.Tracer)
    longest = f"{float(max_step):.6g}" if known else "its `max_step`"
    signed = h * time_direction(terms, h)
    # The difference of two large times carries their roundoff.
    slack = 1e-6 * max_step + 8 * jnp.finfo(h.dtype).eps * jnp.abs(t1)
    template = (
        "A step of {:.6g} was asked of a flow map that was trained for steps from 0 to "
        + longest
        + ". Take a shorter `dt0`, and solve forwards in time."
    )
    return refuse_if(h, ~((signed >= 0) & (signed <= max_step + slack)), signed, template)
