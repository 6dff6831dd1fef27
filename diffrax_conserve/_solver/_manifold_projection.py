"""The wrapper that makes any diffrax solver keep its solution on a manifold."""

from typing import Any, final

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jaxtyping import PyTree

from .._custom_types import (
    VF,
    Args,
    BoolScalarLike,
    DenseInfo,
    Manifold,
    RealScalarLike,
    Values,
    Y,
)
from .._interpolation import MakeManifoldInterpolation, Target
from .._manifold import check_manifold, check_outputs, check_values, conserved_values
from .._projection import (
    AbstractProjection,
    SimplifiedNewton,
    apply,
    check_metric,
    check_state,
)
from ._initial import refuse_violated_constraints
from ._terms import is_backsolve, time_direction


@final
class ManifoldProjection(dfx.AbstractWrappedSolver[Any]):
    r"""Projects every step of another solver to a manifold.

    The wrapped solver proposes a candidate $\hat y$ at $t_{n+1}$; $y_{n+1}$ is its projection to

    $$\{y : I(t_{n+1}, y, args) = I(t_0, y_0, args), \quad g(t_{n+1}, y, args) = 0\}$$

    for the first integrals $I$ and the constraints $g$ of `manifold`. Dense output, saved times and
    events are projected in the same way. The conserved values are computed once, at the start of
    the solve, and carried in the solver state, so that the drift does not grow with the number of
    steps; a solve that continues from a `solver_state` keeps the first values.

    The projected method has the order of the wrapped one. A wrapped solver that reuses its last
    stage in the next step (Tsit5, Dopri5, Bosh3: "first same as last") reuses the one at the
    candidate. To evaluate it again at the projected state costs one evaluation more a step, and did
    not pay: on five systems the errors were the same to within 20 % at tolerance 1e-8, and to
    within a factor of 2.3 at 1e-5, some larger, some smaller (`benchmarks/first_same_as_last.py`).

    An initial state that violates a `Constraint` is refused at run time; see
    [`diffrax_conserve.project`][].

    A projection that fails (no convergence, NaN) makes an adaptive solve reject the step and try a
    smaller one; with fixed steps the solve fails, with an unsuccessful `diffrax.RESULTS`. Where it
    fails between two nodes, dense output is NaN.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        def vector_field(t, y, args):
            q, p = y
            return p, -q

        def energy(t, y, args):
            q, p = y
            return 0.5 * (q**2 + p**2)

        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(vector_field),
            dfc.ManifoldProjection(diffrax.Tsit5(), dfc.FirstIntegral(energy)),
            t0=0.0,
            t1=10.0,
            dt0=0.1,
            y0=(jnp.array(1.0), jnp.array(0.0)),
        )
        ```

    !!! warning

        To keep one integral is not always better than to keep none: see "Choosing a projection".

    ??? cite "Reference"

        E. Hairer, C. Lubich and G. Wanner, *Geometric Numerical Integration*, 2nd ed., Springer
        2006, Section IV.4.
    """

    solver: dfx.AbstractSolver[Any]
    manifold: Manifold
    projection: AbstractProjection

    def __init__(
        self,
        solver: dfx.AbstractSolver,
        manifold: Manifold,
        *,
        projection: AbstractProjection = SimplifiedNewton(),
    ):
        self.solver = solver  # pyright: ignore[reportIncompatibleVariableOverride]
        self.manifold = manifold
        self.projection = projection

    def __check_init__(self):
        if not isinstance(self.solver, dfx.AbstractSolver):
            raise TypeError(
                f"`solver` is {self.solver!r}, which is not a diffrax solver. Pass an instance, "
                "for example `ManifoldProjection(diffrax.Tsit5(), manifold)`."
            )
        _check_nested(self.solver)
        check_manifold(self.manifold)
        if not isinstance(self.projection, AbstractProjection):
            raise TypeError(
                f"`projection` is {self.projection!r}, which is not a projection. Pass an "
                "instance, for example `projection=SimplifiedNewton()`."
            )

    # diffrax forwards `isinstance` through a wrapped solver to the innermost one, then reads these
    # off the wrapper. `Any`: `equinox.tree_at` puts placeholders in the place of values.

    @property
    def term_structure(self) -> Any:  # pyright: ignore
        return self.solver.term_structure

    @property
    def term_compatible_contr_kwargs(self) -> Any:  # pyright: ignore
        return self.solver.term_compatible_contr_kwargs

    @property
    def root_finder(self) -> Any:
        return _innermost(self.solver).root_finder  # pyright: ignore

    @property
    def root_find_max_steps(self) -> Any:
        return _innermost(self.solver).root_find_max_steps  # pyright: ignore

    @property
    def scan_kind(self) -> Any:
        return _innermost(self.solver).scan_kind  # pyright: ignore

    @property
    def interpolation_cls(self) -> MakeManifoldInterpolation:  # pyright: ignore
        return MakeManifoldInterpolation(self.solver.interpolation_cls)

    def order(self, terms: PyTree[dfx.AbstractTerm]) -> int | None:
        return self.solver.order(terms)

    def strong_order(self, terms: PyTree[dfx.AbstractTerm]) -> RealScalarLike | None:
        return self.solver.strong_order(terms)

    def error_order(self, terms: PyTree[dfx.AbstractTerm]) -> RealScalarLike | None:
        return self.solver.error_order(terms)

    def func(self, terms: PyTree[dfx.AbstractTerm], t0: RealScalarLike, y0: Y, args: Args) -> VF:
        return self.solver.func(terms, t0, y0, args)

    def init(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
    ) -> tuple[Any, Values]:
        if is_backsolve(terms):
            raise ValueError(
                "`ManifoldProjection` cannot solve the adjoint equations of "
                "`diffrax.BacksolveAdjoint`: their state is not on the manifold. Name another "
                "solver for them, `BacksolveAdjoint(solver=inner)` with the wrapped solver, or use "
                "`diffrax.RecursiveCheckpointAdjoint()`."
            )
        t = t0 * time_direction(terms, t0)
        check_state(y0)
        check_metric(self.projection.metric, y0)
        check_outputs(self.manifold, t, y0, args)
        values = conserved_values(self.manifold, t, y0, args)
        check_values(self.manifold, values, t, y0, args)
        values = refuse_violated_constraints(self.manifold, values, t, y0, args)
        return self.solver.init(terms, t0, t1, y0, args), values

    def step(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: tuple[Any, Values],
        made_jump: BoolScalarLike,
    ) -> tuple[Y, Y | None, DenseInfo, tuple[Any, Values], dfx.RESULTS]:
        state, values = solver_state
        candidate, error, dense_info, state, result = self.solver.step(
            terms, t0, t1, y0, args, state, made_jump
        )
        direction = time_direction(terms, t1)
        y1, info = apply(self.projection, self.manifold, values, t1 * direction, candidate, args)
        success = info.result == optx.RESULTS.successful
        error = jtu.tree_map(lambda e: jnp.where(success, e, jnp.inf), error)
        result = dfx.RESULTS.where(
            result == dfx.RESULTS.successful, dfx.RESULTS.promote(info.result), result
        )
        target = Target(self.projection, self.manifold, values, args, direction)
        return y1, error, dict(inner=dense_info, target=target), (state, values), result


ManifoldProjection.__init__.__doc__ = r"""**Arguments:**

- `solver`: the solver to wrap, any `diffrax.AbstractSolver`.
- `manifold`: a PyTree (one, a tuple, a list, a dictionary) of `FirstIntegral`s and `Constraint`s.
- `projection`: how to return to the manifold, a `SimplifiedNewton` or a `Newton`.

**Raises:**

`TypeError` or `ValueError`, before anything is compiled, if an argument is not what it must be, if
the manifold is empty or has more scalar constraints than the state has unknowns, or if the metric
or a conserved value does not fit.
"""


def _check_nested(solver: dfx.AbstractSolver) -> None:
    inner = _innermost(solver)
    if (
        inner is not solver
        and isinstance(inner, dfx.AbstractImplicitSolver)
        and not eqx.is_array_like(getattr(inner.root_finder, "rtol", 0.0))
    ):
        raise ValueError(
            f"`ManifoldProjection` is given a {type(solver).__name__} of the implicit solver "
            f"{type(inner).__name__}, whose root finder takes its tolerances from the step-size "
            "controller; diffrax hands those through one wrapper only. Give them explicitly, for "
            f"example `{type(inner).__name__}(root_finder=diffrax.VeryChord(rtol=1e-8, atol=1e-8, "
            "norm=optimistix.max_norm))`."
        )


def _innermost(solver: dfx.AbstractSolver) -> dfx.AbstractSolver:
    # `HalfSolver` does not forward these itself.
    while issubclass(type(solver), dfx.AbstractWrappedSolver):
        solver = solver.solver  # pyright: ignore
    return solver
