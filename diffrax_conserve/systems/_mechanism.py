"""Chemical kinetics: the differential equations of reactions with given rates, and balances."""

import functools as ft
import re
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from typing import NamedTuple, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Real
from scipy.optimize import linprog

from .._constants import MAX_STEPS, TOLERANCE_IN_EPS
from .._custom_types import Args, RealScalarLike
from .._manifold import FirstIntegral
from .._numerics.implicit import root
from .._numerics.iterate import iterate, remaining_after_test
from .._numerics.lanes import where_active
from .._numerics.problem import ABOVE_TOLERANCE, AT_ROUNDOFF
from .._numerics.rows import solve_dense
from .._projection.closed_form import ClosedForm
from ._base import real

State = Float[Array, " species"]


@final
class Balance(eqx.Module):
    """A weighted sum of concentrations that no reaction changes."""

    weights: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, t: RealScalarLike, y: State, args: Args) -> Float[Array, ""]:
        del t, args
        return jnp.sum(jnp.asarray(self.weights, y.dtype) * y)


@final
class Mechanism(eqx.Module):
    r"""Reactions with mass-action kinetics, as a differential equation for the concentrations.

    $$y' = S r(y), \qquad r_j(y) = k_j \prod_i y_i^{a_{ij}}, \qquad S_{ij} = b_{ij} - a_{ij},$$

    where reaction $j$ consumes $a_{ij}$ molecules of species $i$ and produces $b_{ij}$. The rate
    constants $k$ are numbers, or a function of `(t, y, args)`. Whatever they are, $w \cdot y$ is
    conserved for each $w$ with $w^\top S = 0$: these are the balances of elements or of groups that
    the reactions do not split. They are computed in exact arithmetic, and have positive weights
    wherever there are such balances.

    !!! example

        ```python
        import diffrax_conserve as dfc

        mechanism = dfc.systems.Mechanism(["NO + O3 -> NO2", "NO2 -> NO + O3"], [26.6, 0.35])
        print(list(mechanism.manifold))
        y0 = mechanism.state({"NO": 0.2, "O3": 0.04})
        mechanism.vector_field(0.0, y0, None)
        ```

        ```text
        ['O3 + NO2', 'NO + NO2']
        ```

    Source: P. Érdi and J. Tóth, "Mathematical Models of Chemical Reactions" (1989).
    """

    rates: Float[Array, " reactions"] | Callable[..., Real[ArrayLike, " reactions"]]
    reactions: tuple[str, ...] = eqx.field(static=True)
    species: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        reactions: Sequence[str],
        rates: Real[ArrayLike, " reactions"]
        | Sequence[RealScalarLike]
        | Callable[..., Real[ArrayLike, " reactions"]],
        *,
        species: Sequence[str] | None = None,
    ):
        self.reactions = tuple(reactions)
        self.rates = rates if callable(rates) else self._of_each_reaction(real(rates))
        found = dict.fromkeys(name for r in self.reactions for side in _sides(r) for name in side)
        self.species = tuple(found) if species is None else tuple(species)
        if set(found) - set(self.species) or len(set(self.species)) < len(self.species):
            raise ValueError(
                f"`species` is {self.species}, but it must name each species once, among them "
                f"those of the reactions: {', '.join(found)}."
            )

    def _of_each_reaction(self, rates: Array) -> Float[Array, " reactions"]:
        if rates.shape != (len(self.reactions),):
            raise ValueError(
                f"`rates` has shape {rates.shape}, but there are {len(self.reactions)} "
                "`reactions`: give each of them one rate constant."
            )
        return rates

    @property
    def _tables(self) -> "_Tables":
        return _tables(self.reactions, self.species)

    @property
    def stoichiometry(self) -> np.ndarray:
        """The matrix $S$, species by reactions."""
        return self._tables.change

    @property
    def balances(self) -> dict[str, Balance]:
        """The conserved quantities, a basis of the left null space of $S$, by their formulas."""
        return {_formula(w, self.species): Balance(w) for w in self._tables.balances}

    @property
    def manifold(self) -> dict[str, FirstIntegral]:
        """The balances as first integrals."""
        return {name: FirstIntegral(balance) for name, balance in self.balances.items()}

    def state(self, concentrations: Mapping[str, RealScalarLike]) -> State:
        """The state with these concentrations; those of all other species are zero."""
        unknown = set(concentrations) - set(self.species)
        if unknown:
            raise ValueError(
                f"The mechanism has no species {', '.join(sorted(unknown))}. It has "
                f"{', '.join(self.species)}."
            )
        return jnp.stack([real(concentrations.get(name, 0.0)) for name in self.species])

    def vector_field(self, t: RealScalarLike, y: State, args: Args) -> State:
        """The rates of change of the concentrations."""
        constants = self.rates
        if callable(constants):
            constants = self._of_each_reaction(jnp.asarray(constants(t, y, args)))
        # The missing factors of reactions of lower order are one.
        factors = jnp.append(y, jnp.ones((), y.dtype))[self._tables.factors]
        rates = constants.astype(y.dtype) * jnp.prod(factors, axis=1)
        return jnp.sum(jnp.asarray(self.stoichiometry, y.dtype) * rates[None, :], axis=1)

    def positive_projection(self) -> ClosedForm:
        r"""A projection to the balances after which no concentration is negative.

        It returns $y_i = \max(\hat y_i, 0)\, e^{(W^\top \mu)_i}$ with the $\mu$ for which $W y$ has
        the conserved values: the nearest state in relative entropy, found by Newton's method for
        the convex dual problem. A concentration of zero stays zero. The balances must have a basis
        with positive weights, and an error names the species for which there is none.

        Source: I. Csiszár, "I-divergence geometry of probability distributions and minimization
        problems", Ann. Probab. 3 (1975).
        """
        rows = self._tables.balances
        if not rows:
            raise ValueError("No balance is conserved by this mechanism, so none can be restored.")
        signed = [name for name, row in zip(self.balances, rows, strict=True) if min(row) < 0]
        if signed:
            positive = np.any([row for row in rows if min(row) >= 0], axis=0)
            lacking = np.any(rows, axis=0) & ~positive
            species = ", ".join(x for x, lacks in zip(self.species, lacking, strict=True) if lacks)
            raise ValueError(
                f"The balance {signed[0]} has negative weights, so that factors cannot restore it, "
                f"and no other basis of the balances is without them: {species} occur in no "
                "balance with positive weights alone. Project with `SimplifiedNewton()`."
            )
        return ClosedForm(_Entropic(rows, tuple(self.balances)))


Mechanism.__init__.__doc__ = """**Arguments:**

- `reactions`: such as `"2 NO + O2 -> 2 NO2"`, one for each rate. An integer before a name is the
    number of molecules; a side may be empty.
- `rates`: the rate constants $k$, or a function of `(t, y, args)` that returns them, such as those
    of sunlight or of a temperature.
- `species`: the order of the species in the state. Default: the order in which the reactions name
    them.

**Raises:**

`ValueError` if a reaction cannot be parsed, or rates or species do not match the reactions.
"""


@final
class _Entropic(eqx.Module):
    """The formula of the projection in relative entropy."""

    rows: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, t: RealScalarLike, y: State, args: Args, values: object) -> State:
        del t, args
        assert isinstance(values, Mapping)
        return _balanced(self.rows, y, jnp.stack([values[name] for name in self.names]))


Rows = tuple[tuple[int, ...], ...]


def _balanced(rows: Rows, y: State, target: Float[Array, " balances"]) -> State:
    """The state `max(y, 0) exp(Wᵀ μ)` with the balances `target`, by Newton's method for `μ`."""
    y, weights = jnp.maximum(y, 0), jnp.asarray(rows, y.dtype)
    small = TOLERANCE_IN_EPS * jnp.finfo(y.dtype).eps

    def state(multiplier: Array) -> State:
        return y * jnp.exp(jnp.sum(multiplier[:, None] * weights, axis=0))

    def missing(multiplier: Array) -> Float[Array, " balances"]:
        # A sum of products, because a matrix product rounds differently in a batch.
        return target - jnp.sum(weights * state(multiplier), axis=1)

    def advance(multiplier: Array, tests_left: Array) -> tuple[Array, Array]:
        left = missing(multiplier)
        met = jnp.all(jnp.abs(left) <= small * jnp.abs(target))
        tests_left = remaining_after_test(jnp.where(met, AT_ROUNDOFF, ABOVE_TOLERANCE), tests_left)
        gram = jnp.sum(weights[:, None, :] * weights * state(multiplier), axis=2)
        change = solve_dense(gram, left)
        # An exponent changes by at most one in a step.
        longest = jnp.max(jnp.abs(jnp.sum(change[:, None] * weights, axis=0)), initial=1)
        return where_active(tests_left, multiplier + change / longest, multiplier), tests_left

    # Errors of ten per cent decrease as 1e-1, 5e-3, 1e-5, 1e-10, roundoff.
    newton = lambda guess: iterate(advance, guess, max_steps=MAX_STEPS)  # noqa: E731
    return state(root(missing, newton, jnp.zeros_like(target), solve_dense).y)


class _Tables(NamedTuple):
    change: np.ndarray  # species by reactions
    factors: np.ndarray  # reactions by factors of their rate, as indices of species
    balances: tuple[tuple[int, ...], ...]


@ft.cache
def _tables(reactions: tuple[str, ...], species: tuple[str, ...]) -> _Tables:
    change = np.zeros((len(species), len(reactions)), int)
    factors = []
    for j, (taken, made) in enumerate(map(_sides, reactions)):
        for sign, side in ((-1, taken), (1, made)):
            for name, count in side.items():
                change[species.index(name), j] += sign * count
        factors.append([species.index(name) for name, count in taken.items() for _ in range(count)])
    width = max(map(len, factors), default=0)
    padded = [row + [len(species)] * (width - len(row)) for row in factors]
    balances = tuple(tuple(vector.tolist()) for vector in _balances(change))
    return _Tables(change, np.array(padded, int).reshape(len(padded), width), balances)


def _sides(reaction: str) -> tuple[dict[str, int], dict[str, int]]:
    """The numbers of molecules of each species that a reaction consumes and produces."""
    sides = reaction.split("->")
    terms = [[term.strip() for term in side.split("+")] for side in sides]
    matches = [[re.fullmatch(r"(\d+)?\s*([^\W\d]\S*)", x) for x in side if x] for side in terms]
    if len(sides) != 2 or any(match is None for side in matches for match in side):
        raise ValueError(
            f"The reaction {reaction!r} cannot be read. Write one such as '2 NO + O2 -> 2 NO2'."
        )
    found = ({}, {})
    for side, counts in zip(matches, found, strict=True):
        for match in side:
            assert match is not None
            counts[match[2]] = counts.get(match[2], 0) + int(match[1] or 1)
    return found


def _left_null_space(matrix: np.ndarray) -> list[np.ndarray]:
    """An integer basis of the `w` with `wᵀ matrix = 0`."""
    rows = matrix.T * Fraction(1)
    pivots: list[int] = []
    for column in range(len(matrix)):
        k = len(pivots)
        candidates = np.flatnonzero(rows[k:, column])
        if candidates.size:
            rows[[k, k + candidates[0]]] = rows[[k + candidates[0], k]]
            rows[k] /= rows[k, column]
            others = np.arange(len(rows)) != k
            rows[others] -= np.outer(rows[others, column], rows[k])
            pivots.append(column)
    free = [i for i in range(len(matrix)) if i not in pivots]
    basis = np.zeros((len(free), len(matrix)), int) * Fraction(1)
    basis[:, free] = np.eye(len(free), dtype=int)
    basis[:, pivots] = -rows[: len(pivots), free].T
    return [_whole(vector) for vector in basis]


def _whole(vector: np.ndarray) -> np.ndarray:
    """The shortest vector of integers in the direction of one of integers or fractions."""
    scaled = vector * np.lcm.reduce([x.denominator for x in vector])
    return (scaled // np.gcd.reduce([int(x) for x in scaled])).astype(int)


def _without_negative(vectors: list[np.ndarray]) -> list[np.ndarray]:
    """A basis of the same space, where multiples of other vectors are added to those with negative
    entries. It is quick and keeps entries small, but does not find every positive basis."""
    for i, vector in enumerate(vectors):
        for j, other in enumerate(vectors):
            if i != j and vector.min() < 0 and other.min() >= 0:
                ratio = [-(v // o) for v, o in zip(vector, other, strict=True) if v < 0 < o]
                vectors[i] = vector = vector + max(ratio, default=0) * other
    return [_whole(vector) for vector in vectors]


def _balances(change: np.ndarray) -> list[np.ndarray]:
    """An integer basis of the left null space, with as many vectors without negative entries as
    there are.

    The vectors without negative entries are a cone. While a vector `c` that is orthogonal to those
    that are known has a product other than zero with one of the cone, so has an edge of the cone,
    which is independent of them: of the vectors with the product 1, a vertex with the least sum. A
    linear program tells where the vertex is not zero. The rest is exact: there one vector of the
    null space, and only one, is zero elsewhere.
    """
    vectors = _without_negative(_left_null_space(change))
    found = [vector for vector in vectors if vector.min() >= 0]
    edge = None
    while len(found) < len(vectors):
        orthogonal = _left_null_space(np.stack([*change.T, *found], axis=1))
        directions = (sign * c for c in orthogonal for sign in (1, -1))
        edge = next((x for c in directions if (x := _edge(change, c)) is not None), None)
        if edge is None:
            break
        found.append(edge)
    if all(any(x is v for v in vectors) for x in found):  # no edge was missing
        return vectors
    for vector in vectors:
        if np.linalg.matrix_rank(np.stack([*found, vector])) > len(found):
            found.append(vector)
    return found


def _edge(change: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
    """The lightest edge of the cone of balances without negative weights, among those whose product
    with the direction is positive; `None` if there is none."""
    rows = np.concatenate([change.T, direction[None] / np.abs(direction).max()])
    given = np.zeros(len(rows))
    given[-1] = 1
    solution = linprog(np.ones(len(change)), A_eq=rows, b_eq=given, method="highs-ds")
    if not solution.success:
        return None
    support = np.flatnonzero(solution.x > 1e-6 * np.max(solution.x))
    inside = _left_null_space(change[support])
    if len(inside) != 1:
        return None
    edge = np.zeros(len(change), int)
    edge[support] = inside[0] * np.sign(inside[0][0])
    return edge if edge.min() >= 0 and edge @ direction > 0 else None


def _formula(weights: tuple[int, ...], species: tuple[str, ...]) -> str:
    """The formula of a balance, such as `NO + 2 N2O5`."""
    parts = [(w, name) for w, name in zip(weights, species, strict=True) if w]
    text = " ".join(
        f"{'-' if w < 0 else '+'} {f'{abs(w)} ' if abs(w) != 1 else ''}{name}" for w, name in parts
    )
    return text.removeprefix("+ ")
