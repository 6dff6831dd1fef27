"""Projection along the step, known as relaxation."""

from typing import ClassVar, final

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .base import Problem
from .directional import AbstractAlongLine


@final
class Relaxation(AbstractAlongLine):
    r"""Projects along the step, for one integral: $y_{n+1} = y_n + \gamma (\hat y - y_n)$.

    The scalar $\gamma$ near 1 solves $g(y_n + \gamma (\hat y - y_n)) = 0$ by Newton's method. All
    linear integrals that the wrapped solver conserves stay conserved, and no error estimate is
    needed. For a Runge-Kutta method $y_{n+1}$ approximates the solution at $t_n + \gamma h$, where
    $\gamma = 1 + O(h^{p-1})$ in a method of order $p$. But the steps of diffrax end at
    $t_n + h$, so the order is $p - 1$ (the *incremental direction technique*).

    For order $p$ (*relaxation* proper) let the solver carry the time: append a component $\tau$
    with $\tau' = 1$ to the state, and write the vector field and the integral in terms of
    $\tau$. It is relaxed like the others, and the state belongs to the time $\tau$, not to the time
    of diffrax.

    The projection fails where the integral does not change along the step, as at a candidate on a
    chord of a level set that is straight, and where it finds no solution with $\gamma \ge 1/2$:
    $\gamma = 0$, the start of the step, is always one, and not what is sought. So it fails with
    Euler's method, which moves along a tangent of the level set, and with a quantity that is not
    conserved, in short steps. At saved times inside a step and in dense output $\hat y$ is the
    dense output. Derivatives follow from the implicit function theorem.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        energy = dfc.FirstIntegral(lambda t, y, args: y[1] ** 2 / 2 - jnp.cos(y[0]))
        solver = dfc.ManifoldProjection(diffrax.Heun(), energy, projection=dfc.Relaxation())
        ```

    ??? cite "Reference"

        Ketcheson, "Relaxation Runge-Kutta methods: conservation and stability for inner-product
        norms", *SIAM J. Numer. Anal.* 57 (2019), 2850-2870. Ranocha, Sayyari, Dalcin, Parsani and
        Ketcheson, "Relaxation Runge-Kutta methods: fully discrete explicit entropy-stable schemes
        for the compressible Euler and Navier-Stokes equations", *SIAM J. Sci. Comput.* 42 (2020),
        A612-A638, for integrals that are not quadratic.
    """

    unknowns: ClassVar[str] = "has one unknown"

    def direction(self, problem: Problem, candidate: Float[Array, " n"]) -> Float[Array, " n"]:
        if problem.step is None:
            raise ValueError(
                "`Relaxation` moves along a step, but there is none outside a solve. Pass "
                "`projection=Newton()`."
            )
        return candidate - problem.step.y0

    def is_wanted(
        self, problem: Problem, candidate: Float[Array, " n"], y: Float[Array, " n"]
    ) -> Bool[Array, ""]:
        """The start of the step is on the line and on the manifold. It is no solution: time would
        stand still. So the end of a step must be at least as near to the candidate as to the start,
        which is `γ ≥ 1/2`. Every component tells, so the largest differences will do, in any units.
        A saved time just after the start is another matter: there the way is as short as its error.
        """
        assert problem.step is not None
        far = lambda x: jnp.max(jnp.abs(y - x), initial=0)  # noqa: E731
        return (far(candidate) <= far(problem.step.y0)) | (problem.t != problem.step.t1)


Relaxation.__init__.__doc__ = """**Arguments:**

- `rtol`, `atol`, `max_steps`: see `SimplifiedNewton`.

**Raises:**

`ValueError` with more than one scalar constraint, and outside a solve, as in
[`diffrax_conserve.project`][].
"""
