"""An orthonormal basis of random tanh features on the unit interval, with the tables for a step.

Of the singular values of fifty random features only the first twenty are above roundoff. A step
therefore fits the leading directions of their span. A direction is a Legendre series and is
integrated exactly; integrating the features instead would lose digits by cancellation.
"""

import functools as ft
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.polynomial import legendre

from .collocation import chebyshev_points, to_coefficients

# The length of the Legendre series, and of the Gauss rule that computes them.
_DEGREES = 80
# The number of exact directions: the constant (a bias) and the linear function (a skip connection).
_EXACT = 2
# The number of neurons drawn for each direction: with fewer, these would depend on the draw.
_NEURONS = 4


class FeatureBasis(NamedTuple):
    """Tables of an orthonormal basis `q_k` of slopes on [0, 1], the constant first.

    The first `size` members span the solution, all of them its error. In `slopes` and `integrals`,
    columns belong to members and rows to the Gauss points, the first `fractions`.
    """

    size: int
    fractions: Float[np.ndarray, " points+2"]  # of the step: the Gauss points, then both ends
    slopes: Float[np.ndarray, "points wide"]  # q_k
    integrals: Float[np.ndarray, "points wide"]  # of q_k, from 0
    fit: Float[np.ndarray, "wide points"]  # values to the coefficients of the least-squares fit
    unresolved: Float[np.ndarray, "4 points+2"]  # see `_unresolved`
    series: Float[np.ndarray, "degrees wide"]  # the integrals, as Chebyshev series in 2 s - 1


@ft.cache
def feature_basis(count: int) -> FeatureBasis:
    """The basis with `count` members for the solution and 1.5 times as many for its error."""
    members = _directions(count + -(-count // 2))
    integrated = legendre.legint(members, lbnd=-1, axis=0) / 2
    points, weights = legendre.leggauss(2 * count)
    slopes = legendre.legval(points, members).T
    root = np.sqrt(weights / 2)[:, None]
    # The members are orthonormal for the Gauss rule up to roundoff, which the inverse removes.
    fit = np.linalg.pinv(root * slopes) * root.T
    nodes = 2 * count + 8
    values = legendre.legval(2 * chebyshev_points(nodes) - 1, integrated).T
    return FeatureBasis(
        count,
        np.append((points + 1) / 2, [0.0, 1.0]),
        slopes,
        legendre.legval(points, integrated).T,
        fit,
        _unresolved(points, weights),
        to_coefficients(nodes) @ values,
    )


def _unresolved(
    points: Float[np.ndarray, " points"], weights: Float[np.ndarray, " points"]
) -> Float[np.ndarray, "4 points+2"]:
    """From values at the points of a Gauss rule and then at both ends, about what the rule misses:
    the last two Legendre coefficients, and how far the polynomial through the points is from the
    values at the ends, times the distance of an end from the points."""
    norms = np.sqrt(2 * np.arange(len(points)) + 1)
    fit = (norms * legendre.legvander(points, len(points) - 1)).T * weights / 2
    gap = (1 + points[0]) / 2
    at_ends = norms * legendre.legvander([-1, 1], len(points) - 1) @ fit
    return np.block([[fit[-2:], np.zeros((2, 2))], [-gap * at_ends, gap * np.eye(2)]])


def _directions(wide: int) -> Float[np.ndarray, "degrees wide"]:
    """The Legendre coefficients, in `2 s - 1`, of an orthonormal basis of slopes."""
    points, weights = legendre.leggauss(_DEGREES)
    norms = np.sqrt(2 * np.arange(_DEGREES) + 1)
    project = (legendre.legvander(points, _DEGREES - 1) * norms).T * (weights / 2)
    features = project @ _slopes((points + 1) / 2, wide)
    features[:_EXACT] = 0
    leading = np.linalg.svd(features, full_matrices=False)[0]
    members = np.eye(_DEGREES, wide)
    members[_EXACT:, _EXACT:] = leading[_EXACT:, : wide - _EXACT]
    return members * norms[:, None]


def _slopes(s: np.ndarray, wide: int) -> Float[np.ndarray, "points neurons"]:
    """`d/ds` of `s tanh(a (s - c))`, the term of a neuron in a network with an exact initial state.

    The steepness `a` grows with the number of directions, so that the last ones are above roundoff;
    steeper features are less accurate for smooth solutions.
    """
    rng = np.random.default_rng(0)
    steepness = rng.uniform(-wide / 8, wide / 8, _NEURONS * wide)
    centre = rng.uniform(0, 1, _NEURONS * wide)
    tanh = np.tanh(steepness * (s[:, None] - centre))
    return tanh + s[:, None] * steepness * (1 - tanh**2)
