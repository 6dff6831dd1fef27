"""Index reduction: from the equations `F(t, y, y') = 0` to their hidden constraints.

Of the equations `F_0 = F` we select, by elimination, as many as can be solved for some of the
slopes `y'`, and put these slopes into the others. What is left does not contain `y'` any more. It
is a constraint, `h_0(t, y) = 0`. Its derivative `∂h_0/∂t + ∂h_0/∂y y' = 0` takes the place of the
equations that gave it, which makes `F_1`. We go on until `F_ν` determines all slopes. `ν` is the
index. A solution satisfies all `h_k = 0`, and `F_ν` is an ordinary differential equation on the
manifold of these states (P. J. Rabier and W. C. Rheinboldt, *Theoretical and numerical analysis of
differential-algebraic equations*, Handbook of Numerical Analysis VIII, 2002; C. W. Gear,
*Differential-algebraic equation index transformations*, SIAM J. Sci. Stat. Comput. 9, 1988).

Which equations and slopes are selected is the `Structure`. It is that of almost all states, so it
is found from numbers at a single state in general position.
"""

import dataclasses
import functools as ft
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float

from .._constants import REGULARISATION_POWER
from .._fast.arrays import folded
from .._fast.run_once import RunOnce
from .._fast.scalars import small
from .._numerics.implicit import root
from .._numerics.rows import AbstractRows
from .._tree import eps_of, irregular_weights
from .elimination import Blocks, Elimination, Round, elimination
from .large import Large
from .newton import SparseNewton, algebraic_newton
from .places import FindPlaces, Numbers

# `F(t, y, y')` as a function of a time and two vectors.
Implicit = Callable[[Array, Array, Array], Array]

_NO_ROUND = Round((), ())  # nothing is solved yet
# Outputs of outputs are looked for so often, in large systems too.
_MOST_OUTPUTS = 8


@dataclasses.dataclass(frozen=True, eq=False)
class Structure:
    """How equations are reduced.

    - `size`: the number of equations and of unknowns.
    - `rounds`: for each differentiation, what is solved for what before it.
    - `eliminations`: for each differentiation, how the slopes follow that its constraints need;
      `None` where they need none. In a small system one more, for all slopes at the end, and
      another for those in which the equations are not linear, if there are any.
    - `is_linear`: whether the equations are linear in the slopes.
    - `mass`: `∂F/∂y'`, if it is known to be constant.
    - `is_semi_explicit`: whether the equations that are left first contain no slopes, not even some
      that cancel.
    - `always_fits`: whether their program tells that these contain none, whatever the numbers are,
      once the selected slopes are eliminated.
    - `without_free`: whether it tells that no equation contains slopes of the `free` unknowns.
    - `stages`: for each constraint the stage in which a consistent state is sought for it, such as
      those of positions, velocities and forces.
    - `new_unknowns`: for each stage the unknowns that its constraints contain and those before do
      not; empty if a consistent state is not sought in stages.
    - `is_shared`: whether free unknowns that are not outputs are in constraints of an earlier stage
      than the last, or in more than they can meet.
    - `without_slopes`: the unknowns whose slopes no equation contains, as the equations are given.
    - `shares_free`: whether the algebraic unknowns are in more constraints than they can meet, as
      where cells in parallel have one voltage.
    - `by_free`: in a small system which constraints depend on which free unknowns, a row for each
      constraint, if a projection must know it, because they share these or because roundoff hides
      it; see `free_unknowns`. Otherwise `None`.
    - `large`: what large equations need in addition; `None` where all matrices are dense.
    """

    size: int
    rounds: tuple[Round, ...]
    is_linear: bool
    mass: Any = None
    is_semi_explicit: bool = False
    always_fits: bool = False
    without_free: bool = False
    stages: tuple[int, ...] = ()
    new_unknowns: tuple[tuple[int, ...], ...] = ()
    is_shared: bool = False
    without_slopes: tuple[int, ...] = ()
    shares_free: bool = False
    by_free: Bool[np.ndarray, "m f"] | None = None
    eliminations: tuple[Elimination | None, ...] = ()
    large: Large | None = None

    def _values(self) -> tuple[Any, ...]:
        by_free = None if self.by_free is None else self.by_free.tobytes()
        if self.large is not None:  # found once for equations, so it is compared by identity
            return self.large, self.rounds, by_free
        rest = dataclasses.replace(self, mass=None, by_free=None, eliminations=())
        mass = None if self.mass is None else self.mass.tobytes()
        return *dataclasses.astuple(rest), self.eliminations, by_free, mass

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Structure) and self._values() == other._values()

    def __hash__(self) -> int:
        return hash(self._values())

    @property
    def index(self) -> int:
        return len(self.rounds)

    @property
    def ranks(self) -> tuple[int, ...]:
        """For how many slopes the equations are solved before each differentiation."""
        return tuple(len(one.slopes) for one in self.rounds)

    @property
    def num_differentiations(self) -> tuple[int, ...]:
        """How often each equation is differentiated."""
        lefts = [set(self.left(k)) for k in range(self.index)]
        return tuple(sum(i in left for left in lefts) for i in range(self.size))

    @property
    def freedom(self) -> int:
        """The number of degrees of freedom."""
        return self.size - sum(self.num_differentiations)

    def __str__(self) -> str:
        return f"index {self.index} and {self.freedom} degrees of freedom"

    def selected(self, k: int, count: int) -> Round:
        """What is selected in a round, if that is so many slopes; otherwise raises `OtherRanks`."""
        if self.ranks[k : k + 1] != (count,):
            raise OtherRanks
        return self.rounds[k]

    def left(self, k: int) -> tuple[int, ...]:
        """The equations that are left in a round, and give constraints."""
        solved = set(self.rounds[k].equations)
        return tuple(i for i in range(self.size) if i not in solved)

    @property
    def free(self) -> np.ndarray:
        """The unknowns for whose slopes the equations, as they are given, are not solved, such as
        forces. A projection moves them as far as the constraints ask for."""
        known = self.rounds[0].slopes if self.rounds else range(self.size)
        return np.setdiff1d(np.arange(self.size), np.array(known, int))

    @property
    def algebraic(self) -> np.ndarray:
        """The free unknowns for whose slopes the equations are not solved before the last
        differentiation either."""
        known = self.rounds[-1].slopes if self.rounds else range(self.size)
        return np.setdiff1d(np.arange(self.size), np.array(known, int))

    @property
    def determines_free(self) -> bool:
        """Whether some free unknowns are not algebraic, but follow from constraints."""
        return self.algebraic.size < self.free.size

    @property
    def moves_free(self) -> bool:
        """Whether the projection of a step moves along the directions that the equations do not
        differentiate, as in `free_unknowns`; otherwise algebraic unknowns have large units."""
        return self.by_free is not None or (self.large is not None and self.shares_free)

    def equilibrated_units(
        self, sizes: Float[Array, " n"], jacobian: AbstractRows, algebraic: np.ndarray
    ) -> Float[Array, " n"]:
        """The units of a projection that moves other unknowns only where the `algebraic` ones, such
        as forces, do not do. Those of the others are their sizes.

        The sizes of algebraic unknowns may have any ratios, as at a start where some vanish, and a
        Gram matrix would square these. So their units come from the constraint Jacobian,
        equilibrated as by LAPACK's `geequ`: first each row is divided by its largest element, then
        each column. All are so large that they exceed in each row that has some what the other
        unknowns contribute, by the factor `1/ε`."""
        is_algebraic = np.isin(np.arange(self.size), algebraic)
        others = jacobian.scale_columns(jnp.where(is_algebraic, 0, sizes)).largest_in_rows()
        free = jacobian.scale_columns(jnp.asarray(is_algebraic, sizes.dtype))
        largest = free.largest_in_rows()
        is_zero, divisor = largest == 0, jnp.where(largest > 0, largest, 1)
        column = free.divide_rows(divisor).largest_in_columns()
        factor = jnp.max(jnp.where(is_zero, 0, others / divisor), initial=0)
        factor = jnp.where(factor > 0, factor, 1) / eps_of(sizes)
        return jnp.where(is_algebraic, factor / jnp.where(column > 0, column, 1), sizes)

    def search_stages(self, freely: bool) -> tuple[np.ndarray, np.ndarray]:
        """The stages in which a consistent state is sought: which constraints are asked for, and
        which unknowns move. In the last two all are asked for, and all move."""
        alone, count = self.new_unknowns if freely else (), sum(self.num_differentiations)
        asked = [np.array(self.stages) == k for k in range(len(alone))]
        moving = [np.isin(np.arange(self.size), found) for found in alone]
        last = np.full((2, count), True), np.full((2, self.size), True)
        return np.stack([*asked, *last[0]]), np.stack([*moving, *last[1]])


class Reduction:
    """The functions that belong to a structure of equations, for times and vectors like these.

    Each is derived from those before it, and written out as a small program before the next is
    derived. If one of them would be too large in scalars, all stay in arrays: the derivative of a
    program in scalars, as JAX makes it, is several times as large, and is not written out.
    `constraints(t, y)` returns `h_0` to `h_{ν-1}`.
    """

    def __init__(self, structure: Structure, equations: Implicit, t: Any, y: Array):
        self.like, self.structure = (t, y), structure
        self._write = small if structure.large is None else folded
        if not self._derived(equations, t, y):
            self._write = folded
            self._derived(equations, t, y)

    def _derived(self, equations: Implicit, t: Array, y: Array) -> bool:
        """Derives all constraints. It fails if one is too large after one that is not."""
        self.equations = self.small(equations, t, y, y)
        self.constraints: Callable[[Array, Array], list[Array]] = lambda t, y: []
        in_scalars = self.equations is not equations
        for k in range(self.structure.index):
            further = self._further(k)
            self.constraints = self.small(further, t, y)
            if self._write is small and in_scalars and self.constraints is further:
                return False
            in_scalars = in_scalars or self.constraints is not further
        return True

    def small(self, fn: Callable[..., Any], *like: Array) -> Callable[..., Any]:
        return self._write(fn, *like)

    def _further(self, k: int) -> Callable[[Array, Array], list[Array]]:
        """The constraints with those of round `k`. The first are the equations that are left at the
        slopes that are selected; each of the others is a derivative of what is left of the one
        before."""
        structure, before, equations = self.structure, self.constraints, self.equations
        left, large = np.array(structure.left(k), int), structure.large
        if k == 0 and large is not None and large.combinations is not None:
            combinations = large.combinations
            return lambda t, y: [combinations @ equations(t, y, jnp.zeros_like(y))]
        slopes = self.slopes(k)
        if k == 0:
            return lambda t, y: [equations(t, y, slopes(t, y))[left]]
        those = np.searchsorted(structure.left(k - 1), left)

        def further(t: Array, y: Array) -> list[Array]:
            given, rates = _along(before, t, y, slopes(t, y))
            return [*given, rates[-1][those]]

        return further

    def slopes(self, k: int) -> Callable[[Array, Array], Array]:
        """The slopes that the constraints of round `k` need; after the last one all of them, and
        then those in which the equations are not linear. Others are zero."""
        structure, equations, constraints = self.structure, self.equations, self.constraints
        is_last = structure.large is not None and k >= structure.index
        found = None if is_last else structure.eliminations[k]
        if found is None and not is_last:  # the equations that are left contain no slopes
            return lambda t, y: jnp.zeros_like(y)
        as_given = found is not None and found.as_given

        def slopes(t: Array, y: Array) -> Array:
            def residual(slopes: Array) -> Array:
                rates = [] if as_given else _along(constraints, t, y, slopes)[1][:k]
                return self._replaced(equations(t, y, slopes), rates)

            return self._sparsely(residual, y) if found is None else found.slopes(residual, y)

        return slopes if structure.large is not None else self.small(slopes, *self.like)

    def _sparsely(self, residual: Callable[[Array], Array], like: Array) -> Array:
        """The root of the equations of a large system by all slopes."""
        assert self.structure.large is not None
        assert self.structure.large.for_slopes is not None
        begin, newton = jnp.zeros_like(like), SparseNewton(self.structure.large.for_slopes)
        if self.structure.is_linear:
            return newton.solve(newton.jacobian(residual)(begin), -residual(begin))
        iterate = ft.partial(algebraic_newton, residual, sparse=newton)
        return root(residual, iterate, begin, newton.solve, newton.jacobian).y

    def index_one_equations(self, t: Array, y: Array, slopes: Array) -> Array:
        """`F_{ν-1}`, the equations after all differentiations but the last."""
        differentiated = ft.partial(self._differentiated, lambda t, y: self.constraints(t, y)[:-1])
        return self.small(differentiated, t, y, slopes)(t, y, slopes)

    def derivatives(self, t: Array, y: Array) -> tuple[Array, Array]:
        """The derivatives of `F_{ν-1}` by the state and by the slopes, at the slopes that the last
        constraints need."""
        differentiated = ft.partial(self.index_one_equations, t)
        return jax.jacfwd(differentiated, (0, 1))(y, self.slopes(self.structure.index - 1)(t, y))

    def _differentiated(self, constraints: Any, t: Array, y: Array, slopes: Array) -> Array:
        """The equations, with these constraints differentiated."""
        _, rates = _along(constraints, t, y, slopes)
        return self._replaced(self.equations(t, y, slopes), rates)

    def _replaced(self, values: Array, rates: Sequence[Array]) -> Array:
        """The values of the equations, with those that are left in the first rounds replaced by the
        rates of their constraints."""
        for k, rate in enumerate(rates):
            values = values.at[np.array(self.structure.left(k), int)].set(rate)
        return values

    def mass_null_space(self, t: Any, y: Float[Array, " n"]) -> tuple[Any, np.ndarray]:
        """A basis of the directions `d` with `∂F/∂y' d = 0`, in which a state may be moved without
        what the equations differentiate, such as the charges of condensers; and which unknowns are
        the coordinates along it."""
        structure, free = self.structure, self.structure.free
        rows, columns = (np.array(x, int) for x in structure.rounds[0])
        if structure.large is not None:
            return structure.large.along, free
        one = jnp.eye(free.size, dtype=y.dtype)
        along = jnp.zeros((structure.size, free.size), y.dtype).at[free].set(one)
        if structure.without_free:
            return along, free
        matrix = structure.mass if structure.mass is not None else self._by_slopes(t, y)
        solve = np.linalg.solve if structure.mass is not None else jnp.linalg.solve
        inner, outer = matrix[np.ix_(rows, columns)], matrix[np.ix_(rows, free)]
        return along.at[columns].set(jnp.asarray(-solve(inner, outer), y.dtype)), free

    def _by_slopes(self, t: Array, y: Array) -> Float[Array, "n n"]:
        slopes = jnp.zeros_like(y)
        if not self.structure.is_linear:
            selected = Blocks(*((x,) for x in self.structure.rounds[0]), is_linear=False)
            together = Elimination(blocks=(selected,))
            slopes = together.slopes(ft.partial(self.equations, t, y), y)
        return jax.jacfwd(self.equations, 2)(t, y, slopes)

    def fits(self, t: Array, y: Array) -> Bool[Array, ""]:
        """Whether the equations that are left contain no slopes with the numbers at hand, which may
        be others than those with which the structure was found."""
        structure = self.structure
        if structure.always_fits or not structure.rounds:
            return jnp.asarray(True)
        if structure.large is not None:
            by_slope, slopes = structure.large.by_slope, jnp.zeros_like(y)
            values = by_slope.values(lambda slopes: self.equations(t, y, slopes), slopes)
            left = np.isin(by_slope.rows, structure.left(0))
            return ~jnp.any(values[left])
        left = self._by_slopes(t, y)[np.array(structure.left(0), int)]
        if structure.is_semi_explicit:
            return ~jnp.any(left)
        along, _ = self.mass_null_space(t, y)
        least = eps_of(y) ** REGULARISATION_POWER
        return jnp.all(jnp.abs(left @ along) <= least * (jnp.abs(left) @ jnp.abs(along)))

    def all_slopes(self, t: Array, y: Array) -> Array:
        """The slopes after all differentiations; NaN where the structure does not fit."""
        return self._where_it_fits(self.slopes(self.structure.index), t, y)

    def nonlinear_slopes(self, t: Array, y: Array) -> Array:
        """The slopes on which `∂F/∂y'` depends; in large systems all."""
        return self.slopes(self.structure.index + 1)(t, y)

    def all_constraints(self, t: Array, y: Array) -> list[Array]:
        """The constraints; NaN where the structure does not fit."""
        return self._where_it_fits(self.constraints, t, y)

    def _where_it_fits(self, fn: Callable[[Array, Array], Any], t: Array, y: Array) -> Any:
        def checked(t: Array, y: Array) -> Any:
            fits = self.fits(*lax.stop_gradient((t, y)))
            return jtu.tree_map(lambda x: jnp.where(fits, x, jnp.nan), fn(t, y))

        return self.small(checked, t, y)(t, y)


def _along(constraints: Any, t: Array, y: Array, slopes: Array) -> Any:
    """Constraints, and their derivatives along the slopes."""
    return jax.jvp(constraints, (t, y), (jnp.ones_like(t), slopes))


# ---- The structure ----


class Singular(ValueError):
    """Equations that determine no solution: the positions of those that are to blame, and of the
    unknowns that no equation contains."""

    def __init__(self, left: tuple[int, ...], absent: tuple[int, ...]):
        self.left, self.absent = left, absent


class OtherRanks(ValueError):
    """Equations are solved for another number of slopes than in a known structure."""


# The equations as a function of the numbers in them, and of what an `Implicit` takes.
WithNumbers = Callable[[Numbers, Array, Array, Array], Array]


def find_structure(
    equations: WithNumbers,
    numbers: Numbers,
    others: Numbers,
    t: Array,
    y: Array,
    mass: np.ndarray | None,
    unknown: tuple[int, ...],
    memory: dict[Any, Any],
    known: Structure | None = None,
) -> Structure:
    """The structure of equations with these numbers near a state, by elimination. Whether `∂F/∂y'`
    is constant, the other numbers tell. `unknown` are the numbers that may have any values;
    `memory` holds what does not depend on them, for the next search.

    With a `known` structure what that selects is taken, for which the programs are compiled. It
    raises `OtherRanks` as soon as a rank is another, and `FloatingPointError` where what is
    selected is singular, so that these numbers do not tell."""
    t, y, matrix, at_rest, is_linear, absent = _general_position(equations, numbers, t, y)
    other = matrix
    if mass is None:  # does it depend on the time, the state or parameters?
        later, moved = 2 * np.asarray(t) + 1, 2 * np.asarray(y)
        other = np.asarray(_by_slope(equations, others, later, moved, y))
        mass = matrix.copy() if np.array_equal(matrix, other) else None
    selected, given = _extended(matrix, _extended(at_rest, _NO_ROUND)), matrix.copy()
    gradients = computed = np.zeros((0, y.size))  # without and with roundoff
    both = np.stack([matrix, other])
    rest = np.delete(both, selected.equations, axis=1)
    without = tuple(np.flatnonzero(~both.any((0, 1))).tolist())
    find = FindPlaces(memory, numbers, unknown, t, y)
    places = find.dense(equations, 2, y.size)
    without_free = not np.delete(places, selected.slopes, axis=1).any()
    in_rest = np.delete(places, selected.equations, axis=0).any()
    structure = Structure(
        y.size,
        (),
        is_linear,
        mass,
        is_semi_explicit=not np.any(rest),
        always_fits=mass is not None or without_free or not in_rest,
        without_free=without_free,
        without_slopes=without,
    )
    by_slopes = ft.partial(_by_slope, equations, numbers, t, y)
    eliminated = ft.partial(_with_elimination, ft.partial(_is_linear, by_slopes, t, y))
    while len((selected := _extended(matrix, selected)).equations) < y.size:
        if known is not None:
            selected = known.selected(structure.index, len(selected.slopes))
            inner = matrix[np.ix_(*selected)]
            if len(_extended(inner, _NO_ROUND).slopes) < len(inner):
                raise FloatingPointError
        structure = dataclasses.replace(structure, rounds=(*structure.rounds, selected))
        left = structure.left(structure.index - 1)
        needed = np.any(places[list(left)], axis=0)
        structure = eliminated(structure, places, selected, needed)
        by_y, by_slope = _derivatives(equations, structure, numbers, t, y)
        by_slope = np.where(matrix == 0, 0, by_slope)
        with_roundoff, terms = _reduced(np.asarray(by_y), by_slope, selected, left)
        new = _unless_roundoff(with_roundoff, terms)
        computed = np.concatenate([computed, with_roundoff])
        gradients = np.concatenate([gradients, new])
        independent = _extended(gradients, _NO_ROUND).equations
        if len(independent) < len(gradients):
            first = len(gradients) - len(left)
            blamed = (i for k, i in enumerate(left) if first + k not in independent)
            raise Singular(tuple(blamed), absent)
        matrix[list(left)] = new  # `∂/∂y'` of `∂h/∂t + ∂h/∂y y'`
        last = LastConstraints(equations, structure)
        places = places.copy()
        places[list(left)] = find.dense(last, 1, len(left))
    if known is not None and structure.index != known.index:
        raise OtherRanks
    every = tuple(range(y.size))
    structure = eliminated(structure, places, Round(every, every), np.full(y.size, True))
    if not is_linear:
        needed = _nonlinear(by_slopes, t, y)
        structure = eliminated(structure, places, Round(every, every), needed)
    return _with_unknowns(structure, gradients, computed, given)


def _is_linear(
    by_slopes: Callable[[Array], Array],
    t: Array,
    y: Array,
    structure: Structure,
    rows: np.ndarray,
    columns: np.ndarray,
) -> bool:
    """Whether some of the equations are linear in some of the slopes, whatever the others are.
    Those that are differentiated are."""
    if structure.is_linear:
        return True
    given = np.setdiff1d(rows, structure.left(0) if structure.rounds else ())
    _, _, (slopes, others) = general_states(t, y, 0.0)
    moved = jnp.where(np.isin(np.arange(y.size), columns), others, slopes)
    both = (np.asarray(by_slopes(x))[np.ix_(given, columns)] for x in (slopes, moved))
    return np.array_equal(*both, equal_nan=False)


def _nonlinear(by_slopes: Callable[[Array], Array], t: Array, y: Array) -> Bool[np.ndarray, " n"]:
    """The slopes on which `∂F/∂y'` depends. As second derivatives are symmetric, they are those of
    which a column changes with the slopes."""
    _, _, slopes = general_states(t, y, 0.0)
    first, second = (np.asarray(by_slopes(x)) for x in slopes)
    return np.any(first != second, axis=0)


def _with_elimination(
    is_linear: Callable[[Structure, np.ndarray, np.ndarray], bool],
    structure: Structure,
    places: Bool[np.ndarray, "n n"],
    selected: Round,
    needed: Bool[np.ndarray, " n"],
) -> Structure:
    """The structure with the elimination of one more round."""
    found = None
    if structure.eliminations or not structure.is_semi_explicit or not structure.rounds:
        mass = structure.mass
        found = elimination(
            sp.csr_array(places),
            selected,
            needed,
            structure.left(0) if structure.rounds else (),
            is_linear=ft.partial(is_linear, structure),
            mass=None if mass is None else sp.csr_array(mass),
        )
    return dataclasses.replace(structure, eliminations=(*structure.eliminations, found))


@dataclasses.dataclass(frozen=True)
class LastConstraints:
    """The constraints of the last round, as a function like those of `WithNumbers`."""

    equations: WithNumbers
    structure: Structure

    def __call__(self, numbers: Numbers, t: Array, y: Array, slopes: Array) -> Array:
        del slopes
        reduction = Reduction(self.structure, ft.partial(self.equations, numbers), t, y)
        return reduction.constraints(t, y)[-1]


def _with_unknowns(
    structure: Structure,
    gradients: Float[np.ndarray, "m n"],
    computed: Float[np.ndarray, "m n"],
    by_slope: Float[np.ndarray, "n n"],
) -> Structure:
    """The structure with what is known of its constraints, from their gradients without and with
    roundoff."""
    if not structure.rounds:
        return structure
    part = gradients[:, structure.algebraic]
    part = part[part.any(1)]
    shares_free = len(_extended(part, _NO_ROUND).equations) < len(part)
    along = _null_space(by_slope, structure)
    by_free, with_roundoff = (
        _unless_roundoff(x @ along, abs(x) @ abs(along)) != 0 for x in (gradients, computed)
    )
    hidden = np.any(by_free != with_roundoff)
    must_know = shares_free or structure.determines_free or hidden
    structure = dataclasses.replace(
        structure, shares_free=shares_free, by_free=by_free if must_know else None
    )
    independent = lambda part: _extended(part.toarray(), _NO_ROUND).equations  # noqa: E731
    return with_stages(structure, sp.csr_array(gradients), independent)


def with_stages(
    structure: Structure,
    gradients: sp.csr_array,
    independent: Callable[[sp.csr_array], Sequence[int] | np.ndarray],
) -> Structure:
    """The structure with the stages of its constraints, from their gradients, and a function that
    names rows of a matrix that are independent, as many as there are.

    A constraint is met in the stage of its differentiation, but one that only defines an output in
    the last: a free unknown that is in no other constraint, or in no other but those of outputs.
    """
    rounds = range(structure.index)
    stages = np.repeat(rounds, [len(structure.left(k)) for k in rounds])
    rows, columns = sp.coo_array(gradients).coords
    is_free = np.isin(columns, structure.free)
    rows, columns = rows[is_free], columns[is_free]
    for _ in range(_MOST_OUTPUTS):
        alone = (np.bincount(columns) == 1)[columns]
        stages[rows[alone]] = structure.index - 1
        others = ~np.isin(rows, rows[alone])
        rows, columns = rows[others], columns[others]
    rows, columns = np.unique(rows), np.unique(columns)
    is_early = np.any(stages[rows] < structure.index - 1)
    is_first = np.any(stages[rows] == 0)  # with the positions, as the voltage of cells is
    shared = bool(is_early) or len(independent(gradients[rows][:, columns])) < rows.size
    seen, found = np.zeros(structure.size, bool), []
    for k in rounds:
        part = gradients[np.flatnonzero(stages == k)]
        contained = np.bincount(part.indices, minlength=structure.size) > 0
        new = np.flatnonzero(contained & ~seen)
        is_met = len(independent(part[:, new])) == part.shape[0]
        # Shared unknowns have no unit, so that a stage must determine all that it moves.
        free = np.intersect1d(new, structure.free) if shared else new[:0]
        is_met = is_met and len(independent(part[:, free])) == free.size
        if not is_met or (shared and is_first):
            shared = structure.shares_free or structure.determines_free
            return dataclasses.replace(structure, is_shared=shared)
        found.append(tuple(new.tolist()))
        seen |= contained
    return dataclasses.replace(
        structure, stages=tuple(stages.tolist()), new_unknowns=tuple(found), is_shared=shared
    )


# What a search evaluates is compiled once for the equations, and then serves all numbers.


@ft.partial(RunOnce, ft.partial(jax.jit, static_argnums=0))
def _by_slope(equations: WithNumbers, numbers: Numbers, t: Array, y: Array, slopes: Array) -> Array:
    return jax.jacfwd(small(ft.partial(equations, numbers), t, y, slopes), 2)(t, y, slopes)


@ft.partial(RunOnce, ft.partial(jax.jit, static_argnums=(0, 1)))
def _derivatives(
    equations: WithNumbers,
    structure: Structure,
    numbers: Numbers,
    t: Array,
    y: Array,
) -> tuple[Array, Array]:
    reduction = Reduction(structure, ft.partial(equations, numbers), t, y)
    return reduction.derivatives(t, y)


def _reduced(
    by_y: Float[np.ndarray, "n n"],
    by_slope: Float[np.ndarray, "n n"],
    selected: Round,
    left: tuple[int, ...],
) -> tuple[Float[np.ndarray, "m n"], Float[np.ndarray, "m n"]]:
    """The gradients of what is left of equations whose selected slopes are eliminated, and their
    terms."""
    inner, outer = (by_slope[np.ix_(rows, selected.slopes)] for rows in (selected.equations, left))
    given, solved = (by_y[list(rows)] for rows in (left, selected.equations))
    share = _combinations(outer, inner)
    return given - share @ solved, abs(given) + abs(share) @ abs(solved)


def _combinations(
    rows: Float[np.ndarray, "m k"], matrix: Float[np.ndarray, "k k"]
) -> Float[np.ndarray, "m k"]:
    """`rows matrix⁻¹`, the combinations of the rows of a regular matrix that `rows` are."""
    inverse = np.where(_reaches(matrix), np.linalg.inv(matrix), 0)
    inverse = _unless_roundoff(inverse, abs(inverse) @ abs(matrix) @ abs(inverse))
    return _unless_roundoff(rows @ inverse, abs(rows) @ abs(inverse))


def _reaches(matrix: Float[np.ndarray, "k k"]) -> Bool[np.ndarray, "k k"]:
    """Where the inverse can have elements: an unknown depends on the right side of an equation only
    by a chain of equations. What pivots leave elsewhere is roundoff of numbers that are not seen
    in the inverse."""
    places = sp.csr_array(matrix != 0)
    own = sp.csgraph.maximum_bipartite_matching(places, perm_type="row")
    chain = (matrix[own] != 0).astype(float)
    for _ in range(len(matrix).bit_length()):
        chain = (chain @ chain != 0).astype(float)
    reached = np.zeros(matrix.shape, bool)
    reached[:, own] = chain != 0
    return reached


def _unless_roundoff(
    values: Float[np.ndarray, "m n"], terms: Float[np.ndarray, "m n"]
) -> Float[np.ndarray, "m n"]:
    """What cancels but for the roundoff of its terms is zero. If it counted, equations would have
    another structure than combinations of them."""
    return np.where(abs(values) > eps_of(values) ** REGULARISATION_POWER * terms, values, 0)


def _null_space(
    by_slope: Float[np.ndarray, "n n"], structure: Structure
) -> Float[np.ndarray, "n f"]:
    """As `Reduction.mass_null_space`, of numbers."""
    rows, columns = (np.array(x, int) for x in structure.rounds[0])
    free = structure.free
    along = np.eye(structure.size)[:, free]
    inner, outer = by_slope[np.ix_(rows, columns)], by_slope[np.ix_(rows, free)]
    along[columns] = -_combinations(outer.T, inner.T).T
    return along


@ft.partial(RunOnce, ft.partial(jax.jit, static_argnums=0))
def _near(
    equations: WithNumbers, numbers: Numbers, t: Array, y: Array, share: float | Array
) -> tuple[Array, ...]:
    """A time and a state at this relative distance, and what is known of the equations there."""
    given = small(ft.partial(equations, numbers), t, y, y)
    later, moved, slopes = general_states(t, y, share)
    all_at = small(lambda *now: (given(*now), *jax.jacfwd(given, (1, 2))(*now)), t, y, y)
    given_at = jnp.stack([moved, moved, jnp.zeros_like(y)]), slopes[jnp.array([0, 1, 0])]
    values, by_ys, by_slopes = jax.vmap(ft.partial(all_at, later))(*given_at)
    values, by_ys, by_slope = values[:2], by_ys[:2], by_slopes[:2]
    value, by_y = values[0], by_ys[0]
    finite = jnp.all(jnp.isfinite(value + by_y.sum(1) + by_slope.sum((0, 2))))
    absent = ~jnp.any(by_y, 0) & ~jnp.any(by_slope, (0, 1))
    is_linear = jnp.all(by_slope[0] == by_slope[1])
    return later, moved, by_slope[0], by_slopes[2], is_linear, absent, finite


def general_states(t: Array, y: Array, share: float | Array) -> tuple[Array, Array, Array]:
    """A time and a state at this relative distance, and two slopes."""
    pattern = irregular_weights(3 * y.size + 1, y.dtype)
    largest = jnp.max(jnp.abs(y), initial=0)
    # A zero has no unit: it moves with the others, but not far if these are large.
    at_zero = jnp.where(largest > 0, jnp.minimum(largest, 1), 1)
    size = jnp.where(y == 0, at_zero, jnp.abs(y))
    moved = y + share * size * (1 + pattern[: y.size] / 2)
    later = t + share * (1 + pattern[-1] / 2) * jnp.where(t == 0, 1, jnp.abs(t))
    return later, moved, size * pattern[:-1].reshape(3, -1)[1:]


def _extended(matrix: np.ndarray, selected: Round) -> Round:
    """The selection with as many more equations and slopes as the rank of the matrix allows, by
    elimination with the largest pivot."""
    matrix = np.array(matrix, float)
    for _ in range(8):  # in units of rows and columns in which the largest elements are one
        for axis in (0, 1):
            largest = np.sqrt(np.max(np.abs(matrix), axis=axis, keepdims=True, initial=0))
            matrix = matrix / np.where(largest > 0, largest, 1)
    rows, columns = list(selected.equations), list(selected.slopes)
    if rows:
        inner = matrix[np.ix_(rows, columns)]
        matrix = matrix - matrix[:, columns] @ np.linalg.solve(inner, matrix[rows])
    matrix[rows], matrix[:, columns] = 0, 0
    least = eps_of(jnp.result_type(float)) ** REGULARISATION_POWER
    while np.max(np.abs(matrix), initial=0) > least:
        i, j = np.unravel_index(np.argmax(np.abs(matrix)), matrix.shape)
        matrix = matrix - np.outer(matrix[:, j], matrix[i]) / matrix[i, j]
        matrix[i], matrix[:, j] = 0, 0
        rows.append(int(i))
        columns.append(int(j))
    return Round(tuple(rows), tuple(columns))


def _general_position(
    equations: WithNumbers, numbers: Numbers, t: Array, y: Array
) -> tuple[Array, Array, np.ndarray, np.ndarray, bool, tuple[int, ...]]:
    """A time and a state in general position, near the given ones, at which the equations and their
    derivatives are finite; `∂F/∂y'` there, and at rest, where its elements are finite; whether it
    depends on `y'`; and the unknowns that no equation contains."""
    for share in (1e-1, 1e-3, 1e-5, 0.0):
        later, moved, *by_slope, is_linear, absent, finite = _near(equations, numbers, t, y, share)
        if finite:
            matrix, at_rest = (np.array(x) for x in by_slope)
            positions = tuple(np.flatnonzero(absent).tolist())
            return later, moved, matrix, usual(at_rest, matrix), bool(is_linear), positions
    raise FloatingPointError


def usual(at_rest: Any, values: Any) -> Any:
    """The elements of `∂F/∂y'` at a state of zeros, where they are finite and not zero in general
    position. Slopes are solved for by these first: others may vanish in a solve, as the velocities
    do by which a power is computed from accelerations."""
    return np.where(np.isfinite(at_rest) & (values != 0), at_rest, 0)
