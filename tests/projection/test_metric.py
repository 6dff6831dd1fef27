"""A metric that is a matrix in parts of the state, or a function that returns one."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

import diffrax_conserve as dfc

from ..thinned import some_of

RNG = np.random.default_rng(0)
FACTOR = RNG.normal(size=(4, 4)) + 3 * np.eye(4)
MATRIX = FACTOR @ FACTOR.T
BOTH = {
    "one": dfc.Constraint(lambda t, y, args: jnp.sum(y[1] ** 3) + y[0][0] - 2),
    "two": dfc.Constraint(lambda t, y, args: jnp.sum(jnp.sin(y[1])) - y[0][1] ** 2),
}
START = jnp.array([0.6, -0.8]), jnp.array([0.9, 0.4, -0.3, 0.7])


@pytest.mark.slow
@some_of("method", [dfc.SimplifiedNewton, dfc.Newton], ids=["SimplifiedNewton", "Newton"], period=2)
def test_a_matrix_is_the_euclidean_metric_in_other_coordinates(method: Any):
    """With `M = L Lᵀ` the nearest point is Euclidean in `z = Lᵀ v`, and its derivatives follow."""
    there = lambda v: v @ FACTOR  # noqa: E731
    back = lambda z: jnp.linalg.solve(FACTOR.T, z)  # noqa: E731
    other = {
        name: dfc.Constraint(lambda t, y, args, fn=entry.fn: fn(t, (y[0], back(y[1])), args))
        for name, entry in BOTH.items()
    }

    def by_matrix(v: Array) -> Array:
        (_, v), info = dfc.project(BOTH, (START[0], v), projection=method(metric=(2.0, MATRIX)))
        return jnp.where(info.ok, v, jnp.nan)

    def by_coordinates(v: Array) -> Array:
        y = START[0], there(v)
        (_, z), info = dfc.project(other, y, projection=method(metric=(2.0, 1.0)))
        return jnp.where(info.ok, back(z), jnp.nan)

    def with_jacobian(fn: Any) -> Any:
        """The value and the Jacobian, by one program."""
        twice = lambda v: (fn(v),) * 2  # noqa: E731
        return jax.jit(jax.jacrev(twice, has_aux=True))(START[1])

    for found, expected in zip(*map(with_jacobian, (by_matrix, by_coordinates)), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11)


def test_a_function_is_evaluated_at_the_candidate():
    """A solve whose metric depends on the state, and the gradient through it by differences."""
    energy = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y[1] ** 2) / 2 - jnp.cos(y[0][0]))

    def mass(t: Any, y: Any, args: Any) -> Array:
        return jnp.array([[1.5 + jnp.cos(y[0][0]), 0.3], [0.3, 1.0]]) * args

    def field(t: Any, y: Any, args: Any) -> Any:
        q, v = y
        return v, jnp.array([-jnp.sin(q[0]), 0.0])

    projection = dfc.SimplifiedNewton(metric=(jnp.inf, mass))
    solver = dfc.ManifoldProjection(diffrax.Heun(), energy, projection=projection)

    def end(speed: Array) -> Array:
        y0 = jnp.array([0.4, 0.0]), jnp.array([1.0, 0.5]) * speed
        term = diffrax.ODETerm(field)
        options = dict(args=jnp.asarray(1.2), adjoint=diffrax.ForwardMode())
        sol = diffrax.diffeqsolve(term, solver, 0, 2, 0.1, y0, **options)
        return jnp.append(sol.ys[0][-1], energy.fn(0, jax.tree.map(lambda x: x[-1], sol.ys), None))

    end_and_slope = jax.jit(lambda speed: jax.jvp(end, (speed,), (jnp.ones(()),)))
    found, slope = end_and_slope(1.0)
    conserved = 1.25 / 2 - np.cos(0.4)
    assert np.abs(found[2] - conserved) < 1e-15
    (plus, _), (minus, _) = (end_and_slope(1 + h) for h in (1e-6, -1e-6))
    np.testing.assert_allclose(slope, (plus - minus) / 2e-6, rtol=0, atol=1e-8)


def test_generalised_coordinates():
    """`M(q) v' = F + Gᵀ λ` for a double pendulum that is held by a rod between its end and a point:
    the field is that of the equations, solved for the acceleration and the force."""

    def mass(t: Any, y: Any, args: Any) -> Array:
        cosine = jnp.cos(y[0][0] - y[0][1])
        return jnp.array([[2.0, cosine], [cosine, 1.0]])

    def free(t: Any, y: Any, args: Any) -> Any:
        return y[1], jnp.linalg.solve(mass(t, y, args), -jnp.sin(y[0]) * jnp.array([2.0, 1.0]))

    height = dfc.Constraint(lambda t, y, args: jnp.sum(jnp.cos(y[0])) - 1.2)
    held = dfc.tangent(free, height.derivative(free), metric=(jnp.inf, mass))
    y = q, v = np.array([0.3, 0.9]), np.array([0.2, -0.1])
    found = jax.jit(lambda y: (held(0.0, y, None)[1], held.multipliers(0.0, y), mass(0.0, y, None)))
    acceleration, force, matrix = map(np.asarray, found(y))
    right = -np.sin(q) * (np.array([2.0, 1.0]) + force)
    np.testing.assert_allclose(matrix @ acceleration, right, rtol=0, atol=1e-14)
    assert np.abs(np.cos(q) @ v**2 + np.sin(q) @ acceleration) < 1e-14


def test_wrong_matrices_are_told():
    with pytest.raises(ValueError, match="symmetric and positive definite"):
        dfc.SimplifiedNewton(metric=np.array([[1.0, -2.0], [-2.0, 1.0]]))
    with pytest.raises(TypeError, match=r"`metric` has the parameters .* positive definite matrix"):
        dfc.SimplifiedNewton(metric=lambda y: MATRIX)
    projection = dfc.Newton(metric=(1.0, MATRIX[:3, :3]))
    with pytest.raises(ValueError, match=r"or a matrix of shape \(4, 4\)"):
        dfc.project(BOTH, START, projection=projection)
    wrong = dfc.Newton(metric=(1.0, lambda t, y, args: -jnp.asarray(MATRIX)))
    assert not dfc.project(BOTH, START, projection=wrong)[1].ok
