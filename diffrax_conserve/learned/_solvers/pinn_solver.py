"""A trained PINN as a diffrax solver."""

from collections.abc import Callable
from typing import ClassVar, final

import diffrax as dfx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from ..._custom_types import VF, Args, BoolScalarLike, DenseInfo, RealScalarLike, Y
from ..._hashable import Hashable
from ..._solver.diffrax_private import register, result_at
from ..._solver.terms import in_field_time
from ..._time import traced_once
from ..._tree import eps_of, tree_sub
from .._networks.flat import flatten, working_dtype
from .._networks.pinn import PINN
from .checks import Refused, check_learned_terms, check_output
from .collocation import ChebyshevInterpolation, series

_OUTSIDE = register(
    "a step ends, or the solve starts, outside the interval that the PINN was trained for. Solve "
    "from `pinn.t0` to `pinn.t1` at most, or train one for a longer interval."
)
_ANOTHER_START = register(
    "`y0` is not the state that the PINN has at the initial time. A PINN is one solution: start "
    "with `y0=pinn.y0` at `t0=pinn.t0`, train one for this `y0`, or use a `DeepONet`."
)
# The number of states in a step that dense output interpolates.
_NODES = 12


@final
class PINNSolver(Hashable, dfx.AbstractSolver[Refused]):
    r"""Follows a trained PINN: $y_{n+1} = u(t_{n+1})$.

    The vector field is not evaluated. Steps are fixed, of any length; they determine where states
    are saved, projected or tested for events. The solve must start on the network's solution,
    $y(t_0) = u(t_0)$, and stay inside its interval; otherwise it fails. Dense output is the
    polynomial through the states at 12 Chebyshev points of the step. The derivative with respect to
    `y0` is zero; with a projection it is that through the conserved values alone.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc

        system = dfc.systems.get("rigid-body")
        solver = dfc.PINNSolver(dfc.load_pretrained("rigid-body-standard"))
        solver = dfc.ManifoldProjection(solver, system.manifold, projection=dfc.Newton())
        term = diffrax.ODETerm(system.vector_field)
        solution = diffrax.diffeqsolve(term, solver, 0.0, 1.75, 0.05, system.y0)
        ```
    """

    pinn: PINN

    evaluates_vector_field: ClassVar[bool] = False
    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., ChebyshevInterpolation]] = ChebyshevInterpolation

    def __check_init__(self):
        if not isinstance(self.pinn, PINN):
            raise TypeError(
                f"`pinn` is {self.pinn!r}, which is not a `PINN`. A flow map `(y0, h) -> y` goes "
                "into a `DeepONetSolver`."
            )

    def order(self, terms: dfx.AbstractTerm) -> None:
        del terms

    def init(
        self, terms: dfx.AbstractTerm, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args
    ) -> Refused:
        """Zero, or why the solve cannot start: it is not on the solution of the network."""
        del t1, args
        check_learned_terms(terms, "PINNSolver")
        check_output(self.pinn, (t0,), y0, "pinn")
        _, time = in_field_time(terms, t0)
        state = self.pinn(time)
        tolerance = eps_of(working_dtype(y0)) ** 0.5
        size = jnp.maximum(self.pinn.scale, jnp.abs(flatten(state)))
        starts = jnp.all(jnp.abs(flatten(tree_sub(y0, state))) <= tolerance * size)
        return jnp.where(self._covers(time), jnp.where(starts, 0, _ANOTHER_START), _OUTSIDE)

    @traced_once  # with a traced time, one that is outside is told by the result
    def step(
        self,
        terms: dfx.AbstractTerm,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: Refused,
        made_jump: BoolScalarLike,
    ) -> tuple[Y, None, DenseInfo, Refused, dfx.RESULTS]:
        del args, made_jump
        _, start, end = in_field_time(terms, t0, t1)

        def state(t: RealScalarLike) -> Y:
            return jtu.tree_map(lambda a, b: a.astype(jnp.result_type(b)), self.pinn(t), y0)

        coefficients = series(lambda c: state(start + c * (end - start)), _NODES, end.dtype)
        failed = jnp.where(self._covers(end), 0, _OUTSIDE)
        result = result_at(jnp.where(solver_state > 0, solver_state, failed))
        return state(end), None, dict(coefficients=coefficients), solver_state, result

    def _covers(self, time: Array) -> Array:
        """Whether the network knows the solution at this time, up to roundoff."""
        first, last = self.pinn.t0, self.pinn.t1
        slack = 1e-6 * (last - first) + 8 * jnp.finfo(time.dtype).eps * jnp.abs(time)
        return (time >= first - slack) & (time <= last + slack)

    def func(self, terms: dfx.AbstractTerm, t0: RealScalarLike, y0: Y, args: Args) -> VF:
        return terms.vf(t0, y0, args)


PINNSolver.__init__.__doc__ = r"""**Arguments:**

- `pinn`: a [`diffrax_conserve.PINN`][].

**Raises:**

`TypeError` or `ValueError` if `pinn` is not a PINN, or has another structure than the state. The
[`result`][diffrax.RESULTS] is a failure if a time is outside the interval, or `y0` is not the state
of the network at the initial time, to the square root of roundoff of each leaf.
"""
