r"""Second-order training: each update solves a linear least-squares problem in the weights.

With the defects of all collocation points in one vector $r(\theta)$ and its Jacobian $J$, an update
$\delta$ minimises $|J \delta + r|^2 + \lambda |\delta - \zeta|^2$. A loss $\ell$ of the squared
norms $q_i$ that is not their mean gives each point the weight $\partial \ell / \partial q_i$, which
leaves the gradient the same.

Both methods are written here because no library has them: optax has none for least squares, and the
Levenberg-Marquardt of optimistix damps all weights alike and took 9.4 s for a step of 0.1 s here.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from ..._custom_types import RealScalarLike
from ..._tree import eps_of

# A function from the squared norm of the defect at each point, and a typical squared norm of `f`,
# to a loss.
Loss = Callable[[Float[Array, " points"], Float[Array, ""]], Float[Array, ""]]


def squared_norms(vectors: Float[Array, "points n"]) -> Float[Array, " points"]:
    return jnp.sum(jnp.square(vectors), axis=1)


class LeastSquares(NamedTuple):
    """The problem of one update, as a function of the weights in one vector."""

    defects: Callable[[Float[Array, " weights"]], Float[Array, "points n"]]
    jacobian: Callable[[Float[Array, " weights"]], Float[Array, "points n weights"]]
    loss: Loss
    typical: Float[Array, ""]
    fraction: RealScalarLike  # of the training that is done
    linear: Bool[Array, " weights"]  # marks the weights of the last layer

    def rows(
        self, weights: Float[Array, " weights"]
    ) -> tuple[Float[Array, " rows"], Float[Array, "rows weights"], Float[Array, ""]]:
        """`r`, `J` and the loss, with every point weighted for the loss."""
        defects = self.defects(weights)
        loss, importance = jax.value_and_grad(self.loss)(squared_norms(defects), self.typical)
        root = jnp.sqrt(jnp.maximum(importance, 0))[:, None]
        jacobian = root[:, :, None] * self.jacobian(weights)
        return (root * defects).reshape(-1), jacobian.reshape(-1, weights.size), loss


class SpringState(NamedTuple):
    update: Float[Array, " weights"]  # the last one
    loss: Float[Array, ""]  # a running mean


@final
class SPRING(eqx.Module):
    r"""A natural gradient in sample space, with momentum, for new points in each epoch.

    Of all updates that solve the linearised equations at the points of the epoch, up to the
    damping, this is the one nearest to $\zeta = \mu \delta_{\text{last}}$:

    $$\delta = \zeta - J^\top (J J^\top + \lambda I)^{-1} (r + J \zeta),$$

    with a damping $\lambda$ proportional to the loss. The size of the matrix is the number of
    equations or that of weights, if it is smaller. After two fifths of the epochs the length of the
    updates decreases linearly to zero, so that the noise of the batches averages out.

    ??? cite "Reference"

        G. Goldshlager, N. Abrahamsen and L. Lin, J. Comput. Phys. 516 (2024), for wave functions.
    """

    damping: float  # in units of the loss

    def init(self, weights: Any) -> SpringState:
        vector, _ = ravel_pytree(weights)
        return SpringState(jnp.zeros_like(vector), jnp.asarray(jnp.inf, vector.dtype))

    def update(
        self, problem: LeastSquares, weights: Float[Array, " weights"], state: SpringState
    ) -> tuple[Float[Array, " weights"], SpringState, Float[Array, ""]]:
        r, jacobian, loss = problem.rows(weights)
        running = jnp.where(jnp.isfinite(state.loss), 0.95 * state.loss + 0.05 * loss, loss)
        zeta = _MOMENTUM * state.update
        damping, target = self.damping * running, r + jacobian @ zeta
        if r.dtype == jnp.float64:
            update = zeta - _by_gram_matrix(jacobian, target, damping)
        else:
            update = zeta - _by_triangular_factor(jacobian, target, damping)
        length = jnp.asarray(_LENGTH(problem.fraction), r.dtype)
        return weights + length * update, SpringState(update, running), loss


# The factor `μ` of the last update.
_MOMENTUM = 0.9
_LENGTH = optax.linear_schedule(1.0, 0.0, 0.6, transition_begin=0.4)  # pyright: ignore


def _by_gram_matrix(matrix: Array, rhs: Array, damping: Array) -> Array:
    """The minimiser of `|A x - b|² + λ |x|²`, by the smaller of two Cholesky factorisations."""
    tall = matrix.shape[0] > matrix.shape[1]
    gram = matrix.T @ matrix if tall else matrix @ matrix.T
    # Roundoff in the Gram matrix is proportional to its largest eigenvalue. A damping below it does
    # not keep the matrix positive definite.
    damping = jnp.maximum(damping, eps_of(gram) * jnp.trace(gram))
    factor = jsl.cho_factor(gram + damping * jnp.eye(gram.shape[0], dtype=gram.dtype), lower=True)
    if tall:
        return jsl.cho_solve(factor, matrix.T @ rhs)
    return matrix.T @ jsl.cho_solve(factor, rhs)


def _by_triangular_factor(matrix: Array, rhs: Array, damping: Array) -> Array:
    """The same for single precision, in which the Gram matrix knows no eigenvalue below 1e-7 of the
    largest, and needs a damping above it."""
    # Less damping amplifies the roundoff in `b`. On predators and prey the error was 1e-5 with a
    # hundred times as much or with none, and 3e-6 with this.
    least = 0.01 * eps_of(matrix) * jnp.sum(jnp.square(matrix))
    damping = jnp.maximum(damping, least)
    rows, columns = matrix.shape
    if rows > columns:
        return _damped_least_squares(matrix, rhs, damping)
    identity = jnp.sqrt(damping) * jnp.eye(rows, dtype=matrix.dtype)
    r = jnp.linalg.qr(jnp.concatenate([matrix.T, identity]), mode="r")
    half = jsl.solve_triangular(r, rhs, trans="T")
    return matrix.T @ jsl.solve_triangular(r, half)


@final
class LevenbergMarquardt(eqx.Module):
    r"""Gauss-Newton steps with an adaptive damping, for small networks and fixed points.

    An update that does not reduce the loss is rejected, and the damping $\lambda$ is increased;
    after an update that reduces the loss as the linear model predicts, it is decreased. Its unit is
    the mean squared norm of the columns of $J$. The weights of the last layer, in which the output
    is linear, are damped by $10^{-12} \lambda$, so that every update solves for them almost
    exactly, as in variable projection: with equal damping the residual reaches $10^{-5}$ instead of
    $10^{-10}$. The problem is ill-conditioned, and therefore solved by a QR factorisation of $J$.

    ??? cite "Reference"

        J. J. Moré, "The Levenberg-Marquardt algorithm", Lect. Notes Math. 630 (1978); G. H. Golub
        and V. Pereyra, SIAM J. Numer. Anal. 10 (1973), for variable projection.
    """

    damping: float  # that of the first update

    def init(self, weights: Any) -> Float[Array, ""]:
        return jnp.asarray(self.damping, ravel_pytree(weights)[0].dtype)

    def update(
        self, problem: LeastSquares, weights: Float[Array, " weights"], state: Float[Array, ""]
    ) -> tuple[Float[Array, " weights"], Float[Array, ""], Float[Array, ""]]:
        r, jacobian, loss = problem.rows(weights)
        units = jnp.where(problem.linear, jnp.asarray(_FREEDOM, r.dtype), 1)
        damping = state * jnp.mean(jnp.sum(jnp.square(jacobian), axis=0))
        update = units * _damped_least_squares(jacobian * units, -r, damping)
        after = problem.loss(squared_norms(problem.defects(weights + update)), problem.typical)
        change = jacobian @ update
        predicted = -(2 * r @ change + change @ change)
        ratio = (loss - after) / predicted
        better = after < loss
        factor = jnp.where(ratio > 0.5, 0.1, jnp.where(ratio > 0.1, 0.5, 2.0))
        state = state * jnp.where(better, factor, 5.0).astype(r.dtype)
        return jnp.where(better, weights + update, weights), state, loss


# The unit of the weights of the last layer. In these units they are damped like all others.
_FREEDOM = 1e6

SecondOrder = SPRING | LevenbergMarquardt
# The words by which a recipe chooses one.
METHODS = {"spring": SPRING, "levenberg-marquardt": LevenbergMarquardt}


def _damped_least_squares(
    matrix: Float[Array, "rows columns"], rhs: Float[Array, " rows"], damping: Float[Array, ""]
) -> Float[Array, " columns"]:
    """The minimiser of `|A x - b|² + λ |x|²`."""
    columns = matrix.shape[1]
    identity = jnp.sqrt(damping) * jnp.eye(columns, dtype=matrix.dtype)
    zeros = jnp.zeros(columns, rhs.dtype)
    extended = jnp.block([[matrix, rhs[:, None]], [identity, zeros[:, None]]])
    # The last column of the triangular factor of `[A, b]` is Qᵀ b.
    r = jnp.linalg.qr(extended, mode="r")
    return jsl.solve_triangular(r[:columns, :columns], r[:columns, columns])
