"""The Radau IIA method of order five, for stiff and for differential-algebraic equations."""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, final

import diffrax as dfx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._constants import TOLERANCE_IN_EPS
from .._custom_types import VF, Args, BoolScalarLike, DenseInfo, RealScalarLike, Y
from .._hashable import Hashable
from .._numerics.implicit import root
from .._numerics.iterate import Solved, iterate, remaining_after_step
from .._numerics.lanes import where_active
from .._options import check_counts
from .._projection.options import check_state, option, refuse_half_precision
from .._solver.failure import no_time_passes
from .._solver.terms import in_field_time, vector_fields
from .._time import nonzero_length
from .._tree import eps_of, ravel, unravel
from .stage_systems import systems_at

# The nodes of the method, its inverse matrix `A⁻¹`, by which slopes follow from increments, and the
# powers of the nodes, by which the coefficients of the collocation polynomial follow from them.
_NODES = np.array([(4 - 6**0.5) / 10, (4 + 6**0.5) / 10, 1.0])
_POWERS = _NODES[:, None] ** np.arange(1, 4)
_INVERSE = (_POWERS / _NODES[:, None] * np.arange(1, 4)) @ np.linalg.inv(_POWERS)
# `A⁻¹ = V Λ V⁻¹`, with the real eigenvalue first, and one of the conjugate pair.
_EIGENVALUES, _VECTORS = np.linalg.eig(_INVERSE)
_ORDER = np.argsort(np.abs(np.imag(_EIGENVALUES)), kind="stable")
_EIGENVALUES, _VECTORS = _EIGENVALUES[_ORDER], _VECTORS[:, _ORDER]
_REAL, _PAIR = float(_EIGENVALUES[0].real), complex(_EIGENVALUES[1])
_TO_MODES = np.linalg.inv(_VECTORS)
# The weights of the increments in the error estimate.
_ERROR = np.array([-13 - 7 * 6**0.5, -13 + 7 * 6**0.5, -1.0]) / 3

# The safety factor of diffrax's controllers. A step that follows an accepted one is at least this
# share of it, so that a shorter one follows a rejected one. Where the error estimate is this number
# to the fourth, for a method of order three, the next step is as long.
_SAFETY = 0.9


class _Last(NamedTuple):
    """What a step leaves to the next: the coefficients of its polynomial in the share of the step,
    without the constant one, and its length. They are zero before the first step."""

    coefficients: Float[Array, "3 n"]
    length: Float[Array, ""]


@final
class Radau(Hashable, dfx.AbstractImplicitSolver[_Last]):
    r"""The Radau IIA method with three stages, of order five, for stiff equations.

    A step is the collocation polynomial $u$ of degree three with $u(t_n) = y_n$ that satisfies the
    equations at the times $t_n + c_i h$, where $c = (4 \mp \sqrt 6)/10$ and $1$. It is L-stable,
    and dense output is $u$ itself. The three stages are solved for together, by Newton's method
    with one Jacobian for a step, from the polynomial of the last step as a guess; the linear
    systems are one real and one complex one of the size of the state. The error estimate is that
    of an embedded method of order three, which damps stiff components: once, or twice in a step
    that follows a rejected one, as in the code RADAU5 of the reference.

    From 100 unknowns on, in float64 on a CPU, the linear systems are sparse: which elements of the
    Jacobian can differ from zero is found when the solve is traced, and KLU solves them. That takes
    the package of `pip install 'diffrax-conserve[sparse]'`. Without it, in float32 and on a GPU, or
    if a quarter of the elements can differ from zero, the systems are dense, which takes $n^3$
    operations in a step. A singular matrix ends Newton's method, as if it had not converged.

    Where the solution oscillates, as in a circuit, the local error does too, and a step that
    follows it is often rejected. `diffrax.PIDController(rtol=1e-5, atol=1e-5, pcoeff=0.4,
    icoeff=0.3)` is steadier: of the transistor amplifier it rejects half as many steps, and the
    error is a fifth or less.

    Inside [`diffrax_conserve.DAE`][] the equations are $F(t, y, y') = 0$; by itself, they are
    $y' = f(t, y)$.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        def robertson(t, y, args):
            slow, back, fast = 0.04 * y[0], 1e4 * y[1] * y[2], 3e7 * y[1] ** 2
            return jnp.stack([back - slow, slow - back - fast, fast])

        steps = diffrax.PIDController(rtol=1e-4, atol=1e-9)
        sol = diffrax.diffeqsolve(
            diffrax.ODETerm(robertson), dfc.Radau(), 0.0, 1e4, 1e-3, jnp.array([1.0, 0.0, 0.0]),
            stepsize_controller=steps,
        )
        print(sol.stats["num_steps"] < 100, jnp.round(sol.ys[-1, 0], 2))
        ```

        ```text
        True 0.11
        ```

    ??? cite "Reference"

        Hairer and Wanner, *Solving Ordinary Differential Equations II*, Springer 1996, IV.5 and
        IV.8.
    """

    root_finder: Any = option(dfx.with_stepsize_controller_tols(dfx.VeryChord)())
    root_find_max_steps: int = option(10, static=True)  # pyright: ignore
    # Of a `DAE`, which sets them: `F(t, y, y', args) = 0`, in the time of the vector field.
    _equations: Any = option(None)

    term_structure: ClassVar = dfx.ODETerm

    @property
    def interpolation_cls(self) -> Callable[..., dfx.AbstractLocalInterpolation]:  # pyright: ignore
        return CollocationInterpolation

    def __check_init__(self):
        check_counts(root_find_max_steps=self.root_find_max_steps)
        if not all(hasattr(self.root_finder, x) for x in ("rtol", "atol", "norm", "kappa")):
            raise TypeError(
                f"`root_finder` of `Radau` is {self.root_finder!r}, but it must be a "
                "`diffrax.VeryChord`, such as `diffrax.VeryChord(rtol=1e-8, atol=1e-8)`."
            )

    def order(self, terms: PyTree[dfx.AbstractTerm]) -> int:
        del terms
        return 5

    def error_order(self, terms: PyTree[dfx.AbstractTerm]) -> int:
        del terms
        return 4

    def init(
        self, terms: dfx.AbstractTerm, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args
    ) -> _Last:
        if self._equations is not None:
            self._equations.check(vector_fields(terms))
        check_state(y0, kind=jnp.inexact)
        refuse_half_precision("`Radau`", y0)
        y = ravel(y0)
        terms, t0, t1 = in_field_time(terms, t0, t1)
        length = nonzero_length(t0, t1).astype(y.dtype)
        slopes = None if self._equations is None else self._equations.first_slopes(t0, y0, args)
        coefficients = jnp.zeros((3, y.size), y.dtype)
        if slopes is not None:
            coefficients = coefficients.at[0].set(length * slopes)
        return lax.stop_gradient(_Last(coefficients, length))

    def step(
        self,
        terms: dfx.AbstractTerm,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: _Last,
        made_jump: BoolScalarLike,
    ) -> tuple[Y, Y, DenseInfo, _Last, dfx.RESULTS]:
        terms, t0, t1 = in_field_time(terms, t0, t1)
        start = ravel(y0)
        nodes, inverse = jnp.asarray(_NODES, start.dtype), jnp.asarray(_INVERSE, start.dtype)
        length = nonzero_length(t0, t1).astype(start.dtype)
        residual = self._residual(terms, y0, args)
        at_stages = jax.vmap(residual)
        # The polynomial of the last step is continued.
        last = lax.stop_gradient(solver_state)
        q = jnp.where(made_jump, 0, last.coefficients)
        powers = jnp.arange(1, 4)
        later = (1 + nodes * length / last.length)[:, None] ** powers - 1
        guess = start + later @ q
        slope = powers.astype(start.dtype) @ q / last.length

        def stages(y: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
            times = t0 + jnp.asarray(_NODES, jnp.result_type(t0)) * (t1 - t0)
            return at_stages(times, y, inverse @ (y - start) / length)

        systems = systems_at(residual, t0, start, slope)
        # A residual below the roundoff of its terms tells no error: in float32 the last of many
        # unknowns with the sum 1 is known to 1e-7, whatever its size and its tolerance are.
        sizes = systems.sizes_of_terms(start, start / length)
        least = TOLERANCE_IN_EPS * eps_of(start) * sizes
        seen = lambda residual: jnp.where(jnp.abs(residual) <= least, 0, residual)  # noqa: E731
        finder, pair_dtype = self.root_finder, jnp.result_type(start, complex(0))

        def size(change: Array, y: Array) -> Array:
            scale = finder.atol + finder.rtol * jnp.abs(y)
            return finder.norm(jax.vmap(lambda x: unravel(x, y0))(change / scale))

        def judged(once: Array, twice: Array, end: Array) -> Array:
            """The error estimate, from the one that is filtered once and the one that is twice.

            The first contains the distance of the start from a solution without transients, which a
            step damps, but which no shorter step makes smaller. So if it is too large after a step
            was rejected, the error is as large as the second, in which this is damped. Then the
            next step is not longer."""
            largest = jnp.maximum(jnp.abs(start), jnp.abs(end))
            size_of = jax.vmap(lambda error: size(error[None], largest[None]))
            of_once, of_twice = size_of(jnp.stack([once, twice]))
            was_rejected = length / last.length < _SAFETY  # both are negative backwards in time
            enough = jnp.maximum(of_twice, _SAFETY**4) / jnp.where(of_once > 0, of_once, 1)
            return once * jnp.where(was_rejected & (of_once >= 1), jnp.minimum(enough, 1), 1)

        def newton(guess: Array) -> Solved:
            """The stages, and the error estimate."""
            real, pair, freed = systems.solvers(_REAL / length, _PAIR / length)

            def correction(residuals: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
                """`-J⁻¹ residuals`, with the Jacobian `J = A⁻¹/h ⊗ ∂F/∂y' + I ⊗ ∂F/∂y` of the
                stages, by the eigenvectors of `A⁻¹`."""
                vectors, to_modes = (jnp.asarray(x, pair_dtype) for x in (_VECTORS, _TO_MODES))
                modes = -to_modes @ residuals
                first = real(modes[0].real)
                second = pair(modes[1], after=first)
                other = 2 * (vectors[:, 1, None] * second).real
                return vectors[:, 0, None].real * first + other

            def advance(now: Any, tests_left: Array) -> tuple[Any, Array]:
                y, before = now
                change = correction(seen(stages(y)))
                new = y + change
                now_size = size(change, new)
                rate = jnp.where(before < jnp.inf, now_size / before, 0.5)
                # A change by the roundoff of the state cannot become smaller.
                rounded = now_size <= size(TOLERANCE_IN_EPS * eps_of(new) * new, new)
                converged = rounded | ((rate < 1) & (now_size * rate / (1 - rate) < finder.kappa))
                # From a consistent start forces hardly change at first. The second change, by the
                # curvature of their constraints, may exceed the first one and still converge.
                hopeful = (rate < 2) | (tests_left >= self.root_find_max_steps)
                then = remaining_after_step(converged, hopeful, tests_left)
                return where_active(tests_left, (new, now_size), now), then

            begin = guess, jnp.asarray(jnp.inf, start.dtype)
            found = iterate(advance, begin, max_steps=self.root_find_max_steps)
            y = found.y[0]
            slopes = -jnp.asarray(_ERROR, start.dtype) @ (y - start) / length

            def filtered(y: Array, before: Array) -> Array:
                return -real(seen(residual(t0, y, slopes)), after=before)

            once = filtered(start, before=y)
            twice = filtered(start + once, before=once)
            y, once, twice = freed(twice, y, once, twice)
            error = judged(once, twice, y[2])
            return found._replace(y=y, aux=error)

        found = root(
            stages,
            newton,
            guess,
            systems.stages_solution,
            systems.stages_jacobian,
            fallback=jnp.broadcast_to(start, guess.shape),
        )
        # What was not found may be infinite. It is discarded, but in reverse mode zero times its
        # derivatives would be NaN.
        y, error = jnp.where(found.ok, found.y, start), found.aux
        increments = y - start
        coefficients = jnp.asarray(np.linalg.inv(_POWERS), start.dtype) @ increments
        ok = found.ok & jnp.all(jnp.isfinite(error))
        # The shortest step reports no error, so that it is accepted, and its result ends the solve.
        is_shortest = no_time_passes(t1 - t0, jnp.abs(t1))
        big = jnp.where(is_shortest, 0, float(jnp.finfo(start.dtype).max) ** 0.5)
        error = lax.stop_gradient(jnp.where(ok, error, big.astype(start.dtype)))
        success, failure = dfx.RESULTS.successful, dfx.RESULTS.nonlinear_divergence
        result = dfx.RESULTS.where(found.ok, success, failure)  # pyright: ignore
        y1 = unravel(y[2], y0)
        dense_info = dict(y0=y0, coefficients=coefficients)
        state = lax.stop_gradient(_Last(coefficients, length))
        return y1, unravel(error, y0), dense_info, state, result

    def func(self, terms: dfx.AbstractTerm, t0: RealScalarLike, y0: Y, args: Args) -> VF:
        return terms.vf(t0, y0, args)

    def _residual(self, terms: Any, y0: Y, args: Args) -> Any:
        """The equations as a function of time and of vectors."""

        def residual(t: Array, y: Array, slope: Array) -> Array:
            state = unravel(y, y0)
            if self._equations is None:
                return slope - ravel(terms.vf(t, state, args)).astype(y.dtype)
            return ravel(self._equations(t, state, unravel(slope, y0), args)).astype(y.dtype)

        return residual


Radau.__init__.__doc__ = """**Arguments:**

- `root_finder`: a `diffrax.VeryChord`, whose tolerances, norm and `kappa` end Newton's method. By
    default they are those of the step size controller, which must be adaptive then.
- `root_find_max_steps`: the largest number of iterations. If they are not enough, a shorter step is
    tried.
"""


@final
class CollocationInterpolation(dfx.AbstractLocalInterpolation):
    """The collocation polynomial of a step."""

    t0: RealScalarLike  # pyright: ignore[reportIncompatibleVariableOverride]
    t1: RealScalarLike  # pyright: ignore[reportIncompatibleVariableOverride]
    y0: Y
    coefficients: Float[Array, "3 n"]

    def evaluate(
        self, t0: RealScalarLike, t1: RealScalarLike | None = None, left: bool = True
    ) -> PyTree[Array]:
        del left
        if t1 is not None:
            ends = self.evaluate(t1), self.evaluate(t0)
            return jtu.tree_map(lambda a, b: a - b, *ends)
        dtype = self.coefficients.dtype
        share = jnp.asarray((t0 - self.t0) / nonzero_length(self.t0, self.t1), dtype)
        return unravel(ravel(self.y0) + share ** jnp.arange(1, 4) @ self.coefficients, self.y0)
