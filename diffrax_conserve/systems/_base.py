"""The base classes of the systems of the catalogue, and random points for initial states."""

import abc
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray, Real

from .._custom_types import Args, RealScalarLike, Y
from .._manifold import Constraint, FirstIntegral
from .._options import check_float64

if TYPE_CHECKING:
    # Type checkers do not know that this is a class variable.
    from typing import ClassVar as AbstractClassVar
else:
    from equinox import AbstractClassVar

_System = TypeVar("_System", bound="AbstractSystem")
Curves = dict[str, Float[Array, "times coordinates"]]
# The beginnings of citations.
PAPER = "E. Cardoso-Bihlo and A. Bihlo, arXiv:2311.14131 (2023)"
HAIRER = "E. Hairer, C. Lubich and G. Wanner, Geometric Numerical Integration"


class Reduced(NamedTuple):
    """A state up to symmetries: the three parts of a `diffrax_conserve.learned.Frame`."""

    inputs: Float[Array, " k"]
    basis: Float[Array, "n m"]
    clock: Float[Array, ""]


def real(x: Any) -> Array:
    """`x` as an array of floating point numbers, in the default precision unless it has its own."""
    x = jnp.asarray(x)
    # `astype` also removes the weak type of a Python number, so that other values do not compile
    # again.
    return x.astype(x.dtype if eqx.is_inexact_array(x) else float)


class AbstractSystem(eqx.Module):
    r"""A differential equation $y' = f(t, y, args)$ with its manifold.

    The parameters of the equation are the fields of the Module, so they can be changed
    (`Kepler(mu=2.0)`) and differentiated; `args` is not used by any system of the catalogue.

    !!! example

        ```python
        import diffrax_conserve as dfc

        system = dfc.systems.get("kepler")
        system.vector_field(0.0, system.y0, system.args)
        list(system.manifold)  # ['energy', 'angular momentum']
        ```
    """

    name: AbstractClassVar[str]
    title: AbstractClassVar[str]
    citation: AbstractClassVar[str]
    # The final time and the step of the solve in `python -m diffrax_conserve reproduce`.
    t1: AbstractClassVar[float]
    dt: AbstractClassVar[float]
    # The labels of the two or three coordinates in `trajectories`.
    axes: AbstractClassVar[tuple[str, ...]]
    # The methods that are the first integrals in `manifold`.
    integrals: ClassVar[tuple[str, ...]] = ()

    @abc.abstractmethod
    def vector_field(self, t: RealScalarLike, y: Any, args: Args) -> Any:
        """The right-hand side $f(t, y, args)$; its dtype is that of `y`."""

    @property
    def manifold(self) -> dict[str, FirstIntegral | Constraint]:
        """The functionally independent integrals and constraints of the exact solution, by name."""
        return {x.replace("_", " "): FirstIntegral(getattr(self, x)) for x in self.integrals}

    @property
    @abc.abstractmethod
    def y0(self) -> Y:
        """The initial state that the source uses, at time 0."""

    @abc.abstractmethod
    def sample(self, key: PRNGKeyArray) -> Y:
        """One random initial state from the sampling domain; use `jax.vmap` for many."""

    @abc.abstractmethod
    def solution(self, ts: Float[Array, " times"], y0: Any) -> Any:
        """The states in float64 at the times `ts` after `y0`; called by `reference`."""

    def period(self, y0: Any = None) -> Float[Array, ""] | None:
        """The period of the solution through `y0`; `None` if no closed form is known."""
        del y0

    @property
    def metric(self) -> Y | None:
        """Weights, shaped like `y`, with which a projection on the energy alone conserves linear
        integrals; `None` if the system does not need any."""
        return None

    def trajectories(self, ys: Any) -> Curves:
        """Named curves in two or three coordinates, for a phase picture of the states `ys`; by
        default one of the first components of the state."""
        return {self.title: jtu.tree_leaves(ys)[0][:, : len(self.axes)]}

    @property
    def args(self) -> None:
        """The `args` for `diffrax.diffeqsolve`: parameters are fields, so there are none."""

    def reference(
        self,
        ts: Real[ArrayLike, "..."] | Sequence[RealScalarLike],
        y0: Any = None,
        *,
        t0: RealScalarLike = 0.0,
    ) -> Any:
        """The states at the times `ts`, as accurate as float64 allows.

        By the exact solution if there is one in closed form, otherwise by an eighth-order solve,
        with errors of 1e-13 to 1e-12 of the largest component over the default time span; each
        system says which.

        **Arguments:**

        - `ts`: times, one-dimensional, non-decreasing, none of them before `t0`.
        - `y0`: the state at `t0`; by default the system's own `y0`.
        - `t0`: the initial time.

        **Returns:**

        A PyTree like `y0`, with a leading time axis.

        **Raises:**

        `RuntimeError` unless `jax_enable_x64` is on; `ValueError` if `ts` is not one-dimensional or
        empty; at run time an error if `ts` decreases or starts before `t0`.
        """
        check_float64("reference")
        ts = jnp.asarray(ts, jnp.float64)
        if ts.ndim != 1 or ts.size == 0:
            raise ValueError(
                f"`ts` must be a one-dimensional array of times, but has shape {ts.shape}. "
                "For one time write `reference(jnp.array([t]))`."
            )
        y0 = jtu.tree_map(lambda x: jnp.asarray(x, jnp.float64), self.y0 if y0 is None else y0)
        return _solution(self, ts - t0, y0)

    def like(self: _System, y: Any) -> _System:
        """This system with its parameters in the precision of `y`, so that `f` has that precision
        too."""
        dtype = jnp.result_type(*jtu.tree_leaves(y))
        return jtu.tree_map(lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, self)


@eqx.filter_jit
def _solution(system: AbstractSystem, ts: Float[Array, " times"], y0: Any) -> Any:
    ts = eqx.error_if(
        ts,
        jnp.any(jnp.diff(ts, prepend=0.0) < 0),
        "`reference` takes non-decreasing times `ts`, none of them before `t0`.",
    )
    return system.solution(ts, y0)


class AbstractIntegratedSystem(AbstractSystem):
    """A system without a known solution in closed form: its reference is computed numerically.

    The solver steps exactly to the times, because dense output has errors of 1e-10 even at
    tolerances near roundoff.
    """

    solver: ClassVar[dfx.AbstractSolver] = dfx.Dopri8()
    # Relative and absolute. Local errors add up: over the default time spans 1e-13 leads to errors
    # of 1e-12 to 5e-9, and 1e-15 to errors of 1e-13 to 4e-11, with 1.6 times the steps.
    tolerances: ClassVar[tuple[float, float]] = (1e-15, 1e-15)

    def solution(self, ts: Float[Array, " times"], y0: Any) -> Any:
        controller = dfx.ClipStepSizeController(dfx.PIDController(*self.tolerances), step_ts=ts)
        sol = dfx.diffeqsolve(
            dfx.ODETerm(self.vector_field), self.solver, 0.0, ts[-1], None, y0, self.args,
            saveat=dfx.SaveAt(ts=ts), stepsize_controller=controller, max_steps=10**7,
        )  # fmt: skip
        return sol.ys


def annulus(
    key: PRNGKeyArray, shape: tuple[int, ...] = (), *, inner: float, outer: float
) -> Float[Array, "*shape 2"]:
    """Points of the plane with radius between `inner` and `outer`, uniform in area."""
    radius_key, angle_key = jr.split(key)
    r = jnp.sqrt(jr.uniform(radius_key, shape, minval=inner**2, maxval=outer**2))
    phi = jr.uniform(angle_key, shape, maxval=2 * jnp.pi)
    return jnp.stack([r * jnp.cos(phi), r * jnp.sin(phi)], axis=-1)


def shell(key: PRNGKeyArray, *, inner: float, outer: float) -> Float[Array, "3"]:
    """A point of space with radius uniform between `inner` and `outer`, in any direction."""
    radius_key, direction_key = jr.split(key)
    return jr.uniform(radius_key, minval=inner, maxval=outer) * direction(direction_key, 3)


def direction(key: PRNGKeyArray, dimension: int) -> Float[Array, " dimension"]:
    """A unit vector, uniform on the sphere."""
    x = jr.normal(key, (dimension,))
    return x / jnp.linalg.norm(x)
