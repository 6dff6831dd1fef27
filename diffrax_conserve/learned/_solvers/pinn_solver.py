"""A trained PINN as a diffrax solver."""

import math
from collections.abc import Callable
from typing import ClassVar, final

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from ..._custom_types import VF, Args, BoolScalarLike, DenseInfo, RealScalarLike, Y
from ..._projection.base import option
from ..._solver.terms import time_direction
from ..._tree import tree_max, tree_sub, working_dtype
from .._networks.pinn import PINN
from .chebyshev import ChebyshevInterpolation, series
from .checks import check_learned_terms, check_nodes, check_output


@final
class PINNSolver(dfx.AbstractSolver[Float[Array, "2"]]):
    r"""Follows a trained PINN: $y_{n+1} = u(t_{n+1})$.

    The vector field of the term is not evaluated, because the network was trained for it. Steps may
    have any length; they determine where states are saved, projected or tested for events. The
    solve must start on the network's solution, $y(t_0) = u(t_0)$, and stay inside its interval:
    another initial state or a time outside is an error at run time. There is no error estimate, so
    use fixed steps ([`diffrax.ConstantStepSize`][], [`diffrax.StepTo`][]).

    Dense output follows the network inside the step: it is the polynomial through its states at
    `nodes` Chebyshev points, which are computed only if dense output, saved times or an event need
    them. The weights are not copied.

    The result does not depend on `y0`, which must be the trained one: the derivative with respect
    to `y0` is zero.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc

        system = dfc.systems.get("rigid-body")
        solver = dfc.PINNSolver(dfc.load_pretrained("rigid-body-standard"))
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(system.vector_field),
            dfc.ManifoldProjection(solver, system.manifold, projection=dfc.Newton()),
            t0=0.0,
            t1=1.75,
            dt0=0.05,
            y0=system.y0,
        )
        ```

    ??? cite "Reference"

        M. Raissi, P. Perdikaris and G. E. Karniadakis, J. Comput. Phys. 378 (2019).
    """

    pinn: PINN
    nodes: int = option(12, static=True)

    evaluates_vector_field: ClassVar[bool] = False
    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., ChebyshevInterpolation]] = ChebyshevInterpolation

    def __check_init__(self):
        check_nodes(self.nodes)
        if not isinstance(self.pinn, PINN):
            raise TypeError(
                f"`pinn` is {self.pinn!r}, which is not a `PINN`. A flow map `(y0, h) -> y` goes "
                "into a `DeepONetSolver`."
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
    ) -> Float[Array, "2"]:
        """The interval of the network, after a check that the solve starts on its solution."""
        del t1, args
        check_learned_terms(terms, "PINNSolver")
        check_output(self.pinn, (t0,), y0, "pinn")
        time = _refuse_outside(jnp.asarray(t0), terms, (self.pinn.t0, self.pinn.t1), self.pinn)
        state = self.pinn(time)
        tolerance = math.sqrt(jnp.finfo(working_dtype(y0)).eps)
        interval = jnp.array([self.pinn.t0, self.pinn.t1], time.dtype)
        return eqx.error_if(
            interval,
            ~(tree_max(tree_sub(y0, state)) <= tolerance * tree_max(state)),
            "`y0` is not the state that the PINN has at the initial time: they differ by more than "
            f"{tolerance:.1g} of their largest component. A PINN is one solution: start with "
            "`y0=pinn.y0` at `t0=pinn.t0`, train one for this `y0`, or use a `DeepONet`.",
        )

    def step(
        self,
        terms: dfx.AbstractTerm,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: Float[Array, "2"],
        made_jump: BoolScalarLike,
    ) -> tuple[Y, None, DenseInfo, Float[Array, "2"], dfx.RESULTS]:
        del args, made_jump
        interval = (solver_state[0], solver_state[1])
        end = _refuse_outside(jnp.asarray(t1), terms, interval, self.pinn)
        start = jnp.asarray(t0 * time_direction(terms, t0), end.dtype)

        def state(t: RealScalarLike) -> Y:
            return jtu.tree_map(lambda a, b: a.astype(jnp.result_type(b)), self.pinn(t), y0)

        coefficients = series(lambda c: state(start + c * (end - start)), self.nodes, end.dtype)
        dense_info = dict(coefficients=coefficients)
        return state(end), None, dense_info, solver_state, dfx.RESULTS.successful

    def func(self, terms: dfx.AbstractTerm, t0: RealScalarLike, y0: Y, args: Args) -> VF:
        return terms.vf(t0, y0, args)


PINNSolver.__init__.__doc__ = r"""**Arguments:**

- `pinn`: a [`diffrax_conserve.PINN`][].
- `nodes`: the number of states in a step that dense output interpolates.

**Raises:**

`TypeError` or `ValueError` if `pinn` is not a PINN, or has another structure than the state; at run
time an error if a time is outside the interval, or `y0` is not the state of the network at the
initial time.
"""


def _refuse_outside(
    t: Array, terms: dfx.AbstractTerm, interval: tuple[RealScalarLike, RealScalarLike], pinn: PINN
) -> Array:
    """The time of the vector field for the solver's `t`; a run-time error unless it is in the
    interval up to roundoff."""
    time = t * time_direction(terms, t)
    first, last = interval
    slack = 1e-6 * (last - first) + 8 * jnp.finfo(time.dtype).eps * jnp.abs(time)
    return eqx.error_if(
        time,
        ~((time >= first - slack) & (time <= last + slack)),
        f"A step ends, or the solve starts, outside the interval from {pinn.t0:.6g} to "
        f"{pinn.t1:.6g} that the PINN was trained for. Solve within it, or train one for a longer "
        "interval.",
    )
