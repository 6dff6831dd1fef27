"""An orthonormal basis of random tanh features on the unit interval, and what a step needs of it.

Random features are nearly dependent: the singular values of fifty of them fall to roundoff within
twenty. So what a step fits are not the features but the leading directions of their span, computed
here once, in numpy and in double precision. A direction is a Legendre series, which is integrated
exactly; to integrate the features themselves with coefficients that undo the small singular values
would lose the digits that these have lost.
"""

import functools as ft
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.polynomial import legendre

from .chebyshev import chebyshev_points, to_coefficients

# Of a Legendre series, and of the Gauss rule that finds it: far more than any feature needs.
_DEGREES = 80
# Directions that are exact: the constant (a bias) and the straight line (a skip connection).
_EXACT = 2
# Neurons drawn for each direction kept: fewer, and the directions depend on the draw.
_NEURONS = 4


class FeatureBasis(NamedTuple):
    """Tables of an orthonormal basis `q_k` of slopes on [0, 1], the constant first.

    The first `size` of its members span the solution, all of them its error. Columns belong to
    members, rows to the Gauss points `fractions`.
    """

    size: int
    fractions: Float[np.ndarray, " points"]
    slopes: Float[np.ndarray, "points wide"]  # q_k
    integrals: Float[np.ndarray, "points wide"]  # of q_k, from 0
    fit: Float[np.ndarray, "wide points"]  # values to the coefficients of the least-squares fit
    series: Float[np.ndarray, "degrees wide"]  # the integrals, as Chebyshev series in 2 s - 1


@ft.cache
def feature_basis(count: int, seed: int) -> FeatureBasis:
    """The basis with `count` members for the solution and half as many again for its error."""
    return tabulate(count, _directions(count + -(-count // 2), seed))


def tabulate(count: int, members: Float[np.ndarray, "degrees wide"]) -> FeatureBasis:
    """The tables of a basis that is given by its Legendre coefficients, in `2 s - 1`."""
    integrated = legendre.legint(members, lbnd=-1, axis=0) / 2

    points, weights = legendre.leggauss(2 * count)
    slopes = legendre.legval(points, members).T
    root = np.sqrt(weights / 2)[:, None]
    # The members are orthonormal for the Gauss rule too, up to roundoff; the fit removes that.
    fit = np.linalg.pinv(root * slopes) * root.T

    nodes = 2 * count + 8
    values = legendre.legval(2 * chebyshev_points(nodes) - 1, integrated).T
    return FeatureBasis(
        count,
        (points + 1) / 2,
        slopes,
        legendre.legval(points, integrated).T,
        fit,
        to_coefficients(nodes) @ values,
    )


def _directions(wide: int, seed: int) -> Float[np.ndarray, "degrees wide"]:
    """The Legendre coefficients, in `2 s - 1`, of an orthonormal basis of slopes."""
    points, weights = legendre.leggauss(_DEGREES)
    norms = np.sqrt(2 * np.arange(_DEGREES) + 1)
    project = (legendre.legvander(points, _DEGREES - 1) * norms).T * (weights / 2)
    features = project @ _slopes((points + 1) / 2, wide, seed)
    features[:_EXACT] = 0
    leading = np.linalg.svd(features, full_matrices=False)[0]
    members = np.eye(_DEGREES, wide)
    members[_EXACT:, _EXACT:] = leading[_EXACT:, : wide - _EXACT]
    return members * norms[:, None]


def _slopes(s: np.ndarray, wide: int, seed: int) -> Float[np.ndarray, "points neurons"]:
    """`d/ds` of `s tanh(a (s - c))`, what a neuron adds to a network with an exact initial state.

    The steepness `a` grows with the number of directions, such that the last of them stand out of
    roundoff. Flatter features span nearly polynomials, and steeper ones are worse on smooth
    solutions.
    """
    rng = np.random.default_rng(seed)
    steepness = rng.uniform(-wide / 8, wide / 8, _NEURONS * wide)
    centre = rng.uniform(0, 1, _NEURONS * wide)
    tanh = np.tanh(steepness * (s[:, None] - centre))
    return tanh + s[:, None] * steepness * (1 - tanh**2)
