"""Differential-algebraic equations, as equations on a manifold."""

import dataclasses
import functools as ft
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, final

import diffrax as dfx
import equinox as eqx
import jax
import jax.core
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import scipy.sparse as sp
from jax.experimental.sparse import BCOO
from jaxtyping import Array, Bool, Float, PyTree

from .._constants import MAX_STEPS, MIN_KLU, TOLERANCE_IN_EPS
from .._custom_types import Args, Manifold, RealScalarLike, Values, Y
from .._fast.run_once import RunOnce
from .._hashable import Hashable
from .._manifold import Constraint, named_entries, slope_like
from .._memory import Memory
from .._numerics.implicit import root
from .._numerics.iterate import Solved
from .._numerics.metric import Diagonal
from .._numerics.problem import Problem, problem_of
from .._numerics.report import ProjectionInfo
from .._numerics.roundoff import cancellation_scale
from .._numerics.rows import DenseRows
from .._options import check_function
from .._projection.base import AbstractProjection, check_projection
from .._projection.options import check_state, refuse_half_precision
from .._projection.simplified_newton import SimplifiedNewton
from .._projection.staged import Staged
from .._solver.manifold_projection import ManifoldProjection, or_trivial
from .._tree import eps_of, ravel, tree_all_finite, tree_shapes, tree_stop_gradient, unravel
from .elimination import NotFound, SparseMatrix
from .free_unknowns import nearest_with_free
from .newton import (
    MAX_NEWTON_STEPS,
    SparseNewton,
    algebraic_newton,
    error_oriented_newton,
    implied_by_others,
    least_exact,
    solve_equilibrated,
)
from .radau import Radau
from .reduction import Implicit, OtherRanks, Reduction, Singular, Structure
from .search import MOST_DENSE, Search, any_traced, lifted, tree_key


@final
class _Matrix(eqx.Module):
    """A constant matrix, known while JAX traces."""

    known: SparseMatrix = eqx.field(static=True)


def _mass(mass: Any) -> Any:
    if mass is None or callable(mass) or isinstance(mass, _Matrix):
        return mass
    if isinstance(mass, jax.core.Tracer):
        raise TypeError(
            "`mass` of a `DAE` is traced by JAX, but its zeros decide how the equations are "
            "solved. Pass a function `mass(t, y, args)`, and what it depends on in `args`."
        )
    if isinstance(mass, BCOO) and mass.n_batch == mass.n_dense == 0:
        at = tuple(np.asarray(mass.indices).T)
        mass = sp.coo_array((np.asarray(mass.data), at), mass.shape)
    elif isinstance(mass, BCOO):
        mass = mass.todense()
    mass = mass if sp.issparse(mass) else np.asarray(mass)
    values = mass.tocoo().data if sp.issparse(mass) else mass  # pyright: ignore
    is_real = values.dtype.kind in "biuf" and np.all(np.isfinite(values))
    if mass.ndim != 2 or mass.shape[0] != mass.shape[1] or not is_real:
        raise ValueError(
            f"`mass` of a `DAE` has the shape {mass.shape} and the dtype {values.dtype}, or is not "
            "finite. Pass a square matrix of real numbers, with a row for each equation and a "
            "column for each number of the state, two for a complex one, or a function "
            "`mass(t, y, args)` that returns one."
        )
    return _Matrix(SparseMatrix(sp.csr_array(mass, dtype=float)))


def _product(mass: Any, slopes: Float[Array, " n"]) -> Float[Array, " n"]:
    """The product with what a function `mass` returns. That of a sparse array is by places, which
    are found when the equations are searched for them."""
    if sp.issparse(mass):
        raise TypeError(
            "The function `mass` of a `DAE` returns an array of `scipy.sparse`, which JAX cannot "
            "trace. Return a `jax.experimental.sparse.BCOO` or a matrix, or pass a constant mass "
            "matrix itself."
        )
    mass = mass if isinstance(mass, BCOO) else jnp.asarray(mass)
    if jnp.issubdtype(mass.dtype, jnp.complexfloating) or mass.shape != (slopes.size,) * 2:
        raise ValueError(
            f"The function `mass` of a `DAE` returns a matrix of the shape {mass.shape} and the "
            f"dtype {mass.dtype}. Return one of real numbers, with {slopes.size} rows and columns, "
            "one for each number of the state, two for a complex one."
        )
    if isinstance(mass, BCOO) and mass.n_batch == mass.n_dense == 0:
        rows, columns = mass.indices.T
        terms = mass.data.astype(slopes.dtype) * slopes[columns]
        return jnp.zeros(mass.shape[0], slopes.dtype).at[rows].add(terms)
    mass = mass.todense() if isinstance(mass, BCOO) else mass
    return mass.astype(slopes.dtype) @ slopes


@final
class DAE(Hashable):
    r"""A differential-algebraic equation, in one of three forms.

    - `DAE(residual=F)` is $F(t, y, y', args) = 0$.
    - `DAE(f, mass=M)` is $M y' = f(t, y, args)$, where $M$ may be singular.
    - `DAE(f, algebraic=g)` is $x' = f(t, x, z, args)$, $0 = g(t, x, z, args)$, and its state is the
        pair $(x, z)$.

    Equations without slopes are constraints. The program finds them, also as combinations of
    equations, differentiates them by automatic differentiation, and goes on until the equations
    determine all slopes. The number of differentiations is the index. What is found on the way are
    the hidden constraints: of a pendulum in Cartesian coordinates, of index 3, its length, that its
    velocity is tangential, and the equation for its force. `report` tells what was found.

    `wrap` gives a solver that projects each step, saved times, dense output and events to the
    manifold of all these constraints, to roundoff. Use [`diffrax_conserve.Radau`][], which solves
    the equations themselves, after all differentiations but the last. Every other solver of diffrax
    solves the ordinary differential equation that follows from the last; that is good for equations
    that are not stiff.

    Which equations are differentiated belongs to the equations: it is found from numbers in general
    position in the place of the state and of all arrays in `args`, whatever their values are and
    whatever is called first. Where the values decide, such as zeros in a matrix that is in `args`,
    or where the equations are not finite at such numbers, `dae.at(guess, args=args)` gives the same
    equations as they are there, and `consistent` and `report` say so.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        # A pendulum of length 1 in Cartesian coordinates: position, velocity, and force.
        def pendulum(t, y, dy, args):
            (q, v, force), (dq, dv, _) = y, dy
            return dq - v, dv + force * q - jnp.array([0.0, -9.81]), jnp.sum(q**2) - 1

        dae = dfc.DAE(residual=pendulum)
        y0 = dae.consistent((jnp.array([1.0, 0.0]), jnp.zeros(2), jnp.array(0.0)))
        print(dae.report(y0))
        steps = diffrax.PIDController(rtol=1e-6, atol=1e-6)
        sol = diffrax.diffeqsolve(
            dae.term, dae.wrap(dfc.Radau()), 0.0, 1.0, 1e-3, y0, stepsize_controller=steps
        )
        ```

        ```text
        Index 3, with 2 degrees of freedom.
        Differentiated: [2] 3 times.
        Without slopes: y[2].
        ```

    ??? cite "Reference"

        Rabier and Rheinboldt, *Theoretical and numerical analysis of differential-algebraic
        equations*, Handbook of Numerical Analysis VIII, 2002; Hairer and Wanner, *Solving Ordinary
        Differential Equations II*, Springer 1996, VI and VII.
    """

    f: Callable[..., Any] | None = None
    mass: Any = eqx.field(default=None, kw_only=True, converter=_mass)
    algebraic: Callable[..., Any] | None = eqx.field(default=None, kw_only=True)
    residual: Callable[..., Any] | None = eqx.field(default=None, kw_only=True)
    structure: Structure | None = eqx.field(default=None, kw_only=True, static=True)

    def __check_init__(self):
        forms = [x is not None for x in (self.mass, self.algebraic, self.residual)]
        if sum(forms) != 1 or (self.f is None) != (self.residual is not None):
            raise ValueError(
                "A `DAE` is given as `DAE(residual=F)`, as `DAE(f, mass=M)` or as "
                "`DAE(f, algebraic=g)`. If no slope is multiplied and there are no algebraic "
                "equations, it is an ordinary differential equation: use `diffrax.ODETerm(f)`."
            )
        pair = self.algebraic is not None
        call = "t, x, z, args" if pair else "t, y, args"
        if self.f is not None:
            check_function("`f` of a `DAE`", self.f, f"f({call})", "a value like `x` or `y`")
        if self.algebraic is not None:
            name, returns = "`algebraic` of a `DAE`", "as many numbers as `z` has"
            check_function(name, self.algebraic, f"algebraic({call})", returns)
        if self.residual is not None:
            call, returns = "residual(t, y, dy, args)", "as many numbers as `y` has"
            check_function("`residual` of a `DAE`", self.residual, call, returns)
        if callable(self.mass):
            check_function("`mass` of a `DAE`", self.mass, "mass(t, y, args)", "a square matrix")

    @property
    def term(self) -> dfx.ODETerm[Any]:
        """The term for [`diffrax.diffeqsolve`][], with the slopes that the equations determine."""
        return dfx.ODETerm(_Slopes(self))

    def wrap(
        self,
        solver: dfx.AbstractSolver[Any],
        manifold: Manifold = (),
        *,
        projection: AbstractProjection | None = None,
    ) -> ManifoldProjection:
        """A solver whose steps and dense output satisfy all constraints to roundoff.

        **Arguments:**

        - `solver`: [`diffrax_conserve.Radau`][], or another solver of diffrax if the equations are
            not stiff.
        - `manifold`: what is kept beside the equations, such as the energy of a mechanism: a
            [`diffrax_conserve.FirstIntegral`][], also with a `rate`, a
            [`diffrax_conserve.Constraint`][], or a PyTree of them. In messages their names begin
            with `manifold['further']`.
        - `projection`: how that is kept, and within which bounds:
            [`diffrax_conserve.SimplifiedNewton`][], the default, or [`diffrax_conserve.Newton`][].
            A state that satisfies the equations is found first, and from there the nearest one that
            satisfies all. Bounds can be kept without a `manifold`.

        **Returns:**

        A [`diffrax_conserve.ManifoldProjection`][].

        **Raises:**

        `TypeError` if `solver` is none, or one that is wrapped already, if an entry of `manifold`
        is neither a first integral nor a constraint, or if `projection` is none, or needs the step.
        """
        if isinstance(solver, Radau):  # a wrapper of one too, for diffrax
            if type(solver) is not Radau:
                raise TypeError(
                    "`wrap` makes a projected solver of one that is not: pass "
                    "`diffrax_conserve.Radau()` itself."
                )
            solver = dataclasses.replace(solver, _equations=_IndexOneEquations(self))
        kept: dict[str, Any] = {"equations": Constraint(_Constraints(self))}
        back: AbstractProjection = ConstraintProjection(dae=self)
        if projection is not None or named_entries(manifold):
            further = SimplifiedNewton() if projection is None else projection
            check_projection(further)
            if further.sees_step:
                raise TypeError(
                    f"`projection` is {further!r}, which moves along the step, but in `wrap` of a "
                    "`DAE` it starts from a state that satisfies the equations. Pass "
                    "`SimplifiedNewton()` or `Newton()`."
                )
            kept["further"] = or_trivial(manifold)
            back = Staged(("equations", back), ("further", further))
        return ManifoldProjection(solver, kept, projection=back)

    def consistent(
        self,
        *guess: Any,
        t: RealScalarLike = 0.0,
        args: Args = None,
        fixed: PyTree[bool] | None = None,
    ) -> Any:
        """The state near the guess that satisfies all constraints, those that are hidden too.

        Use it at the start, and after an event that changes the state, `args` or the equations.

        **Arguments:**

        - `guess`: the state, with its structure, shapes and dtype; of `DAE(f, algebraic=g)` its two
            parts, `consistent(x, z)`, or their pair, as `consistent` returns it.
        - `t`, `args`: passed to the functions.
        - `fixed`: which parts of the state must stay as they are: a PyTree like the state, of which
            each leaf is `True`, `False` or an array of them. By default, with index 1, all that the
            equations differentiate stays, such as $x$ or $M y$. With a higher index the state moves
            to the nearest point, in the Euclidean distance of what they differentiate. If each
            differentiation brings unknowns with which its constraints can be met, these alone move
            for them: of a mechanism first the positions, then the velocities, then the forces and
            outputs, such as a power.

        **Returns:**

        The state, as `y0` of [`diffrax.diffeqsolve`][]. What was changed is told by `report`.

        **Raises:**

        `ValueError` or `TypeError` if the equations do not fit the state, or are singular;
        `ValueError` if no consistent state is found, or inside of `jit` an error at run time.
        """
        y = self._state(guess)
        _checked_structure(self, t, y, args)
        is_traced = _is_traced(self, t, y, args)
        t = jnp.asarray(t, jnp.result_type(float, t))
        flags = None if fixed is None else _flags(fixed, y).tobytes()
        found, ok = (_consistent.inside if is_traced else _consistent)(self, t, y, args, flags)
        message = (
            "`consistent` found no state near the guess that satisfies the equations and their "
            "derivatives: give a better guess, or hold fewer unknowns fixed. `report(guess)` names "
            "the equations that are differentiated. Where coefficients of slopes vanish, as at "
            "rest, `dae.at(guess)` finds which slopes the equations can be solved for there."
        )
        if isinstance(ok, jax.core.Tracer):
            return eqx.error_if(found, ~ok, message)
        if not ok:
            raise ValueError(message)
        return found

    def report(self, *guess: Any, t: RealScalarLike = 0.0, args: Args = None) -> "DAEReport":
        """What was found out about the equations, at the state of a guess.

        **Arguments:**

        - `guess`, `t`, `args`: as those of `consistent`.

        **Returns:**

        A `DAEReport`, which prints as a text. Its fields are `index`; `differentiated`, how often
        which equation is; `algebraic`, the unknowns whose slopes no equation contains; `freedom`,
        the number of degrees of freedom; and `residuals`, the largest of each group of constraints
        at the guess, in the order in which they were found.

        **Raises:**

        As `consistent`.
        """
        y = self._state(guess)
        structure = _checked_structure(self, t, y, args)
        t = jnp.asarray(t, jnp.result_type(float, t))
        equations, unknowns = self._names(t, y, args), _names("y", y)
        times = structure.num_differentiations
        off = RunOnce(eqx.filter_jit, _Constraints(self))(t, y, args)[: structure.index]
        return DAEReport(
            index=structure.index,
            differentiated={equations[i]: n for i, n in enumerate(times) if n},
            algebraic=tuple(unknowns[j] for j in structure.without_slopes),
            freedom=structure.freedom,
            residuals=tuple(float(jnp.max(jnp.abs(h), initial=0)) for h in off),
        )

    def at(self, *guess: Any, t: RealScalarLike = 0.0, args: Args = None) -> "DAE":
        """The same equations, with the structure that they have near a guess with these `args`.

        Use it where values in `args` decide which equations contain slopes, or if the equations are
        not finite, or of a lower rank, at numbers in general position. `consistent`, `term` and
        `wrap` of the result keep this structure. If a solve has other `args` that it does not fit,
        that solve fails.

        **Arguments:**

        - `guess`, `t`, `args`: as those of `consistent`; numbers that JAX does not trace.

        **Returns:**

        A `DAE`.

        **Raises:**

        As `consistent`, and `TypeError` where JAX traces.
        """
        y = self._state(guess)
        if _is_traced(self, t, y, args):
            raise TypeError(
                "`at` of a `DAE` finds its structure from numbers, but JAX traces them here: call "
                "it outside of `jax.jit` and the like."
            )
        search = _search(self, y, args)
        found = _found(self, t, y, args, lambda: search.at((self, args), *_numbers(t, y)))
        return dataclasses.replace(self, structure=found)

    def _state(self, guess: tuple[Any, ...]) -> Any:
        wanted = 1 if self.algebraic is None else 2
        if wanted == 2 and len(guess) == 1 and isinstance(guess[0], tuple | list):
            guess = tuple(guess[0])
        if len(guess) != wanted:
            names = "the state `y`" if wanted == 1 else "the two parts of the state, `x, z`"
            raise ValueError(f"Pass {names}: {wanted} positional arguments, not {len(guess)}.")
        y = jtu.tree_map(jnp.asarray, guess[0] if wanted == 1 else guess)
        check_state(y, "a `DAE`", kind=jnp.inexact)
        refuse_half_precision("A `DAE`", y)
        return y

    def _values(self, t: RealScalarLike, y: Y, slopes: Y, args: Args) -> dict[str, Any]:
        """What the user's functions return, by their names."""
        if self.residual is not None:
            return {"": self.residual(t, y, slopes, args)}
        assert self.f is not None
        if self.algebraic is None:
            return {"f": self.f(t, y, args)}
        if not isinstance(y, tuple | list) or len(y) != 2:
            raise ValueError(
                "The state of a `DAE` with `algebraic` must be a pair `(x, z)`, but it is "
                f"{tree_shapes(y)}. Pass `y0=dae.consistent(x, z)`."
            )
        slope = slope_like(y[0], self.f(t, *y, args), "f", "x")
        return {"f": slope, "algebraic": self.algebraic(t, *y, args)}

    def _names(self, t: RealScalarLike, y: Y, args: Args) -> list[str]:
        """The names of the equations."""
        values = jax.eval_shape(lambda: self._values(t, y, y, args))
        order = ("", "f", "algebraic")  # JAX sorts the keys
        return [name for key in order if key in values for name in _names(key, values[key])]

    def _equations(self, t: RealScalarLike, y: Y, args: Args) -> Implicit:
        """The equations as a function of vectors, for states like `y`."""
        values = jax.eval_shape(lambda: self._values(t, y, y, args))
        size, given = ravel(y).size, sum(x.size * _parts(x) for x in jtu.tree_leaves(values))
        which = next(x for x in ("residual", "algebraic", "f") if getattr(self, x) is not None)
        if which == "algebraic":
            z = ravel(y[1]).size
            size, given = z, given - (size - z)
        if given != size:
            of = "`z`" if which == "algebraic" else "the state"
            raise ValueError(
                f"`{which}` returns {given} numbers, but {of} has {size}: there must be as many "
                "equations as unknowns."
            )
        matrix = self.mass.known if isinstance(self.mass, _Matrix) else None
        if matrix is not None and matrix.shape[0] != size:
            raise ValueError(
                f"`mass` has {matrix.shape[0]} rows, but the state has {size} numbers, two for a "
                "complex one: pass a matrix with a row for each equation and a column for each "
                "number of the state."
            )

        def equations(t: Array, vector: Array, slopes: Array) -> Array:
            state = unravel(vector, y)
            values = self._values(t, state, unravel(slopes, y), args)
            if self.residual is not None:
                return ravel(values).astype(vector.dtype)
            f = ravel(values["f"]).astype(vector.dtype)
            if self.algebraic is not None:
                g = ravel(values["algebraic"]).astype(vector.dtype)
                return jnp.concatenate([slopes[: f.size] - f, g])
            if matrix is not None and size >= MIN_KLU:
                return matrix @ slopes - f
            mass = self.mass(t, state, args) if matrix is None else matrix.matrix.toarray()
            return _product(mass, slopes) - f

        return equations


DAE.__init__.__doc__ = r"""**Arguments:**

- `f`: with `mass`, called as `f(t, y, args)`, and returns as many numbers as `y` has; with
    `algebraic`, called as `f(t, x, z, args)`, and returns a value like `x`.
- `mass`: the matrix $M$, also as an array of `scipy.sparse` or a `jax.experimental.sparse.BCOO`,
    or a function `mass(t, y, args)` that returns it. It acts on the numbers of the state, in the
    order of the leaves.
- `algebraic`: the algebraic equations, called as `algebraic(t, x, z, args)`; as many numbers as
    `z` has.
- `residual`: called as `residual(t, y, dy, args)`; a PyTree with as many numbers as `y` has.
- `structure`: which equations are differentiated, if it is not that of numbers in general position.
    The method `at` sets it.

JAX differentiates all of them, as often as the index is.

**Raises:**

`TypeError` or `ValueError` if they make none of the three forms, or cannot be called so. In a
solve, before compilation, `ValueError` if the numbers of equations and unknowns differ, or if the
equations are singular.
"""


@dataclasses.dataclass(frozen=True)
class DAEReport:
    """What was found out about a [`diffrax_conserve.DAE`][]; see its `report`."""

    index: int
    differentiated: Mapping[str, int]
    algebraic: tuple[str, ...]
    freedom: int
    residuals: tuple[float, ...]

    def __str__(self) -> str:
        times = lambda n: "once" if n == 1 else f"{n} times"  # noqa: E731
        lines = [f"Index {self.index}, with {self.freedom} degrees of freedom."]
        if self.differentiated:
            found = (f"{name} {times(n)}" for name, n in self.differentiated.items())
            lines += ["Differentiated: " + ", ".join(found) + "."]
        if self.algebraic:
            lines += ["Without slopes: " + ", ".join(self.algebraic) + "."]
        return "\n".join(lines)


# ---- The structure ----

# The searches, and the structures that were found, by the functions and the shapes. Both depend on
# these alone, so that it does not matter which are known.
_SEARCHES, _FOUND = Memory(), Memory()


# What JAX raises where a function asks for the value of a number that is traced.
_ASKED = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)


def _structure(dae: DAE, t: RealScalarLike, y: Y, args: Args) -> Structure:
    """The structure of the equations. Inside a solve the numbers are not known any more, so it does
    not depend on them."""
    if dae.structure is not None:
        if dae.structure.size != ravel(y).size:
            raise ValueError(
                f"The state has {ravel(y).size} numbers, but the structure that `at` found is one "
                f"of {dae.structure.size} unknowns: call `at` with a state of this shape."
            )
        return dae.structure

    def found() -> Structure:
        search = _search(dae, y, args)
        return _found(dae, t, y, args, lambda: search.general((dae, args)))

    return _FOUND(tree_key((dae, y, args)), found)


def _checked_structure(dae: DAE, t: RealScalarLike, y: Y, args: Args) -> Structure:
    """The structure; raises if the equations have another one with the numbers that are given."""
    structure = _structure(dae, t, y, args)
    if dae.structure is not None or _is_traced(dae, t, y, args):
        return structure
    search = _search(dae, y, args)

    def near() -> Structure:
        try:
            return search.at((dae, args), *_numbers(t, y), structure)
        except FloatingPointError:  # a poor guess tells nothing
            return structure

    try:
        _found(dae, t, y, args, near)
    except OtherRanks:
        raise ValueError(
            "Near this state the equations determine other slopes than with values in general "
            f"position, with which they have {structure}. Where values decide, such as zeros in "
            "`args`, write `dae = dae.at(guess, t=t0, args=args)`, and take `consistent`, "
            "`report`, `term` and `wrap` of that. Otherwise roundoff hides how they depend on the "
            "unknowns: give another guess."
        ) from None
    return structure


def _is_traced(dae: DAE, t: RealScalarLike, y: Y, args: Args) -> bool:
    """Whether JAX traces one of these, what the functions close over, or a function around this
    call, in which each operation gives a tracer."""
    if any_traced((dae, t, y, args, jnp.zeros(()) + 0)):
        return True
    return dae.structure is None and _search(dae, y, args).is_traced


def _search(dae: DAE, y: Y, args: Args) -> Search:
    mass = dae.mass.known.matrix if isinstance(dae.mass, _Matrix) else None

    def equations(tree: Any) -> Implicit:
        dae, args = tree
        return dae._equations(0.0, y, args)

    # A Python float is traced, so that a solve in which JAX traces that number needs no search of
    # its own; unless the functions ask for its value.
    tree = dae, args
    search = ft.partial(Search, equations, tree, ravel(y), mass)
    try:
        return _SEARCHES(tree_key((lifted(tree), y)), lambda: search(floats=True))
    except _ASKED:
        return _SEARCHES(tree_key((tree, y)), lambda: search(floats=False))


def _numbers(t: RealScalarLike, y: Y) -> tuple[Array, Array]:
    return jnp.asarray(t, jnp.result_type(float, t)), ravel(y)


def _found(
    dae: DAE, t: RealScalarLike, y: Y, args: Args, search: Callable[[], Structure]
) -> Structure:
    """What a search finds; its errors with the names of the user."""
    elsewhere = (
        " If they are so only far from the state of the solve, find their structure at it, by "
        "`dae = dae.at(guess, t=t0, args=args)`, outside of functions that JAX traces."
    )
    try:
        return search()
    except Singular as error:
        names = dae._names(t, y, args)
        which = ", ".join(f"`{names[i]}`" for i in error.left)
        unknowns = ", ".join(f"`{_names('y', y)[j]}`" for j in error.absent)
        lacking = (
            f"No equation contains {unknowns}."
            if unknowns
            else "So some unknown is not determined."
        )
        repeated = (
            f"{which}, or a derivative of it, follows from the other equations or contradicts "
            f"them. {lacking} Leave out what is stated twice, and add the equation that is missing."
        )
        # At a poor guess a rank may be lost by roundoff: then no equation is to blame.
        hidden = (
            "near this state roundoff hides how they depend on the unknowns. Give another one; if "
            "they are singular there too, an equation follows from others: leave it out."
        )
        raise ValueError(
            f"The equations are singular: {repeated if error.left else hidden}{elsewhere}"
        ) from None
    except FloatingPointError:
        raise ValueError(
            f"The equations, or their derivatives, are not finite near the state.{elsewhere}"
        ) from None
    except NotFound as error:
        raise ValueError(
            f"The structure of these {ravel(y).size} equations was not found, because {error}. It "
            f"is found by dense matrices for at most {MOST_DENSE} of them."
        ) from None


def _names(root: str, tree: Any) -> list[str]:
    """The names of the numbers of a tree, such as `y[0][1]`."""
    out = []
    for path, leaf in jtu.tree_flatten_with_path(tree)[0]:
        name = root + jtu.keystr(path)
        places = (
            [""]
            if leaf.ndim == 0
            else [f"[{', '.join(map(str, i))}]" for i in np.ndindex(leaf.shape)]
        )
        parts = ("",) if _parts(leaf) == 1 else (".real", ".imag")
        out += [name + place + part for part in parts for place in places]
    return out


def _parts(leaf: Any) -> int:
    """How many numbers an element of a leaf is, in the order of `ravel`."""
    return 2 if jnp.issubdtype(leaf.dtype, jnp.complexfloating) else 1


def _flags(fixed: Any, y: Y) -> np.ndarray:
    def spread(flag: Any, part: Any) -> Any:
        if isinstance(flag, jax.core.Tracer):
            raise TypeError("`fixed` must be known while JAX traces: pass a NumPy array.")
        if np.asarray(flag).dtype != bool:
            raise ValueError(f"{flag!r} is not `True` or `False`.")
        return jtu.tree_map(lambda x: np.broadcast_to(flag, x.shape), part)

    try:
        flags = jtu.tree_map(spread, fixed, y)
    except ValueError as error:
        raise ValueError(
            f"`fixed` is {fixed}, but it must be `True` or `False` for the state, or for each part "
            f"of it, or an array of them; the shapes of the state are {tree_shapes(y)}."
        ) from error
    pairs = zip(jtu.tree_leaves(flags), jtu.tree_leaves(y), strict=True)
    return np.concatenate([np.tile(flag.ravel(), _parts(x)) for flag, x in pairs])


@final
class ConstraintProjection(AbstractProjection):
    """The projection to the constraints. With index 1 it keeps `∂F/∂y' y`, as the solution does,
    and solves for the algebraic variables. With a higher index these are free, and the differential
    variables move to the nearest point."""

    dae: DAE
    metric: None = None
    sees_step: ClassVar[bool] = False

    def solve(
        self, problem: Problem, candidate: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], ProjectionInfo]:
        state = problem.state(candidate)
        structure = _structure(self.dae, problem.t, state, problem.args)
        if structure.large is not None:
            # Along a ladder of a thousand resistors the voltages underflow.
            problem = dataclasses.replace(problem, atol=least_exact(candidate.dtype))
        if structure.index != 1:
            metric, one = problem.factor, jnp.ones_like(candidate)
            sizes = metric.diagonal if isinstance(metric, Diagonal) else one
            if structure.moves_free:
                found = _nearest(self.dae, structure, problem, candidate, sizes)
                info = problem.report(candidate, found.y, found.num_iterations, ok=found.ok)
                return found.y, info
            jacobian = tree_stop_gradient(problem.linearise(candidate)[1])
            units = structure.equilibrated_units(sizes, jacobian, structure.algebraic)
            free = Diagonal(units)
            y, info = SimplifiedNewton().solve(dataclasses.replace(problem, factor=free), candidate)
            length = lax.stop_gradient(metric.norm(y - candidate))
            return y, dataclasses.replace(info, correction=length)
        y, is_root = _solved_for(self.dae, problem.t, state, problem.args, error_oriented_newton)
        # Where a force is large and the unknowns beside it are small, as a voltage is when it
        # changes its sign, the residual does not go below the roundoff of the force, which the
        # scale does not contain. Newton's method tells more.
        return y, problem.report(candidate, y, converged=is_root)


@ft.partial(RunOnce, eqx.filter_jit)
def _consistent(
    dae: DAE, t: Array, y: Y, args: Args, flags: bytes | None
) -> tuple[Y, Bool[Array, ""]]:
    """A consistent state near a guess, of which flags may say what is fixed, and whether it was
    found."""
    structure = _structure(dae, t, y, args)
    if structure.index == 0:
        return y, tree_all_finite(_Slopes(dae)(t, y, args))
    if flags is None and structure.index == 1:
        found = unravel(_solved_for(dae, t, y, args, algebraic_newton)[0], y)
        return found, tree_all_finite(found)
    fixed = np.zeros(structure.size, bool) if flags is None else np.frombuffer(flags, bool)
    count, large = sum(len(structure.left(k)) for k in range(structure.index)), structure.large
    guess = ravel(y)
    none = jnp.zeros(count, guess.dtype)
    # What should be zero would have no tolerance, if it were compared with its own size alone. So
    # this share of the guess, or of what other unknowns make of it, counts as zero, in float32 too,
    # where tiny currents have all digits.
    share = float(np.finfo(float).eps) ** 2
    # If some are fixed, others may be in more constraints than they can meet.
    shared = structure.is_shared or flags is not None
    shared = shared and (large is None or large.along is not None)
    in_stages = flags is None and not (shared and large is not None)
    algebraic = structure.algebraic if structure.is_shared else structure.free

    def with_zeros(found: Array, changes: Array) -> Array:
        value = lax.stop_gradient(found)
        is_zero = jnp.abs(value) <= TOLERANCE_IN_EPS * eps_of(guess) * changes
        return found - jnp.where(is_zero, value, 0)  # keeps its derivative

    def nearer(y: Y, stage: tuple[Array, Array]) -> tuple[Y, Bool[Array, ""]]:
        asked, moving = stage
        manifold = {"equations": Constraint(_Constraints(dae, asked))}
        cancellation = cancellation_scale(manifold, t, y, args)[2]
        vector, moving = ravel(y), moving & ~fixed
        least = None if large is None else least_exact(vector.dtype)
        problem = problem_of(manifold, none, t, y, args, cancellation, atol=least)
        sizes, size = moving.astype(vector.dtype), jnp.abs(guess)
        rows = (problem.with_dense_jacobian() if large is None else problem).linearise(vector)[1]
        if large is None:
            assert isinstance(rows, DenseRows)
            size = jnp.maximum(size, implied_by_others(rows.matrix, jnp.abs(vector)))
        changes = share / eps_of(guess) * lax.stop_gradient(size)
        problem = dataclasses.replace(problem, changes=changes)
        if shared:
            still = ~moving if large is None else fixed
            solved = _nearest(dae, structure, problem, vector, sizes, still, MAX_NEWTON_STEPS)
            return unravel(with_zeros(solved.y, changes), y), solved.ok
        units = structure.equilibrated_units(sizes, rows, algebraic)
        problem = dataclasses.replace(problem, factor=Diagonal(jnp.where(moving, units, 0)))
        found, info = SimplifiedNewton(max_steps=MAX_NEWTON_STEPS).solve(problem, vector)
        return unravel(with_zeros(found, changes), y), info.ok

    # The tolerance follows the roundoff at the guess, so the last time judges by that at the state.
    # `project` measures twice too, in two programs, and compiles nearly twice as much.
    stages = structure.search_stages(freely=in_stages)
    found, ok = lax.scan(nearer, y, jtu.tree_map(jnp.asarray, stages))
    return found, ok[-1]


def _nearest(
    dae: DAE,
    structure: Structure,
    problem: Problem,
    candidate: Float[Array, " n"],
    sizes: Float[Array, " n"],
    fixed: Any = None,
    max_steps: int = MAX_STEPS,
) -> Solved:
    """The nearest state on the constraints, with unknowns of these sizes, unless they are free."""
    state = problem.state(candidate)
    equations = dae._equations(problem.t, state, problem.args)
    reduction = Reduction(structure, equations, problem.t, candidate)
    basis = reduction.mass_null_space(problem.t, candidate)
    given = problem, candidate, sizes, *basis, structure.by_free, fixed
    return nearest_with_free(*given, max_steps=max_steps)


@eqx.filter_jit
def _solved_for(
    dae: DAE, t: RealScalarLike, state: Y, args: Args, newton: Callable[..., Solved]
) -> tuple[Float[Array, " n"], Bool[Array, ""]]:
    """The state of equations of index 1, moved without what they differentiate, NaN if Newton's
    method finds none; and whether that is a root."""
    structure, t, state = _at(dae, t, state, args)
    y = ravel(state)
    reduction = Reduction(structure, dae._equations(t, state, args), t, y)
    along, free = reduction.mass_null_space(t, y)
    fits = reduction.fits(t, y)

    def moved(z: Array) -> Array:
        return (y + along @ (z - y[free])).at[free].set(z)

    def residual(z: Array) -> Array:
        return jnp.where(fits, reduction.constraints(t, moved(z))[0], jnp.nan)

    residual = reduction.small(residual, y[free])
    large = structure.large
    if large is None or large.by_free is None or free.size < MIN_KLU:
        found = root(residual, ft.partial(newton, residual), y[free], solve_equilibrated)
    else:
        sparse = SparseNewton(large.by_free)
        newton = ft.partial(newton, residual, sparse=sparse)
        found = root(residual, newton, y[free], sparse.solve, sparse.jacobian)
    return moved(found.y), found.ok & jnp.asarray(False if found.aux is None else found.aux)


@final
class _Slopes(eqx.Module):
    """The vector field: the slopes that the equations determine after all differentiations."""

    dae: DAE

    def __call__(self, t: RealScalarLike, y: Y, args: Args) -> Y:
        given = _at(self.dae, t, y, args)
        return unravel(_value(Reduction.all_slopes, self.dae, given, args), given[2])


@final
class _Constraints(eqx.Module):
    """All constraints, or those that are asked for. Not a closure, with which every `wrap` would
    compile anew."""

    dae: DAE
    asked: Bool[Array, " m"] | None = None

    def __call__(self, t: RealScalarLike, y: Y, args: Args) -> Values:
        given = _at(self.dae, t, y, args)
        if not given[0].index:
            return [jnp.zeros_like(ravel(given[2])[:1])]  # every state will do
        found = _value(Reduction.all_constraints, self.dae, given, args)
        if self.asked is None:
            return found
        ends = np.cumsum([h.size for h in found])[:-1]
        asked = jnp.split(self.asked, ends)
        return [jnp.where(*both, 0) for both in zip(asked, found, strict=True)]


@final
class _IndexOneEquations(eqx.Module):
    """The equations that [`diffrax_conserve.Radau`][] solves, of index 1 at most."""

    dae: DAE

    def check(self, vector_fields: list[Any]) -> None:
        """Raises if the term is that of other equations, which would be ignored."""
        known = [x.dae for x in vector_fields if isinstance(x, _Slopes)]
        if tree_key(self.dae) not in map(tree_key, known):
            raise ValueError(
                "The solver is that of a `DAE`, but the term is not: pass `dae.term` and "
                "`dae.wrap(solver)` of the same `dae` to `diffeqsolve`."
            )

    def first_slopes(self, t: RealScalarLike, y: Y, args: Args) -> Array | None:
        """The slopes at which the first Jacobian of a solve is computed, if it depends on them."""
        given = _at(self.dae, t, y, args)
        if given[0].is_linear:
            return None
        return _value(Reduction.nonlinear_slopes, self.dae, given, args)

    def __call__(self, t: RealScalarLike, y: Y, slopes: Y, args: Args) -> Array:
        given = _at(self.dae, t, y, args)
        return _value(Reduction.index_one_equations, self.dae, given, args, ravel(slopes))


def _at(dae: DAE, t: RealScalarLike, y: Y, args: Args) -> tuple[Structure, Array, Y]:
    """The structure, and time and state without weak types, so that each is traced once."""
    y = jtu.tree_map(lambda x: jnp.asarray(x, jnp.result_type(x)), y)
    t = jnp.asarray(t, jnp.result_type(float, t))
    return _structure(dae, t, y, args), t, y


@eqx.filter_jit
def _value(
    of: Callable[..., Any],
    dae: DAE,
    given: tuple[Structure, Array, Y],
    args: Args,
    *slopes: Array,
) -> Any:
    """A function that belongs to the structure, at a time and a state; traced once for all uses."""
    structure, t, y = given
    reduction = Reduction(structure, dae._equations(t, y, args), t, ravel(y))
    return of(reduction, t, ravel(y), *slopes)
