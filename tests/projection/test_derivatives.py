"""Derivatives of a projection, against finite differences and against the unrolled iteration."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc

from ..problems import OMEGA0

PROJECTIONS = {"simplified": dfc.SimplifiedNewton(), "newton": dfc.Newton()}
each_projection = pytest.mark.parametrize("projection", list(PROJECTIONS.values()), ids=PROJECTIONS)


class Energy(eqx.Module):
    """An integral with parameters of its own."""

    inertia: jax.Array

    def __call__(self, t, w, args):
        return jnp.sum(self.inertia * w**2) / 2 + args["tilt"] * t * w[0]


def momentum(t, w, args):
    del t
    return jnp.sum(args["squares"] * w**2)


INPUTS = dict(
    inertia=jnp.array([0.1, 0.2, 0.3]),
    args={"tilt": jnp.array(0.05), "squares": jnp.array([0.01, 0.04, 0.09])},
    values=(jnp.array(0.31), jnp.array(0.142)),
    t=jnp.array(0.4),
    y=OMEGA0 + jnp.array([0.02, -0.03, 0.01]),
    metric=jnp.array([1.0, 2.0, 0.5]),
)


def projected(inputs, projection):
    manifold = (dfc.FirstIntegral(Energy(inputs["inertia"])), dfc.FirstIntegral(momentum))
    projection = eqx.tree_at(
        lambda p: p.metric, projection, inputs["metric"], is_leaf=lambda x: x is None
    )
    return dfc.project(
        manifold,
        inputs["y"],
        t=inputs["t"],
        args=inputs["args"],
        value=inputs["values"],
        projection=projection,
    )[0]


def loss(inputs, projection):
    return jnp.sum(jnp.array([1.0, -2.0, 0.5]) * projected(inputs, projection) ** 3)


# Compiled once for all tests.
gradient_of_loss = eqx.filter_jit(eqx.filter_grad(loss))


def unrolled_simplified_newton(inputs):
    """Twelve iterations of the textbook formula, differentiated as they stand."""
    energy = Energy(inputs["inertia"])

    def g(y):
        out = jnp.stack(
            [energy(inputs["t"], y, inputs["args"]), momentum(inputs["t"], y, inputs["args"])]
        )
        return out - jnp.stack(inputs["values"])

    jacobian = jax.jacrev(g)(inputs["y"]) / inputs["metric"]
    gram = jacobian @ jax.jacrev(g)(inputs["y"]).T
    multiplier = jnp.zeros(2)
    for _ in range(12):
        multiplier = multiplier - jnp.linalg.solve(gram, g(inputs["y"] + jacobian.T @ multiplier))
    return inputs["y"] + jacobian.T @ multiplier


def directions(seed):
    leaves, treedef = jax.tree.flatten(INPUTS)
    rng = np.random.default_rng(seed)
    return jax.tree.unflatten(treedef, [jnp.asarray(rng.normal(size=x.shape)) for x in leaves])


def move(inputs, step, direction):
    return jax.tree.map(lambda x, d: np.asarray(x) + step * np.asarray(d), inputs, direction)


def central_difference(f, direction, h=1e-5):
    """Of fourth order, along a direction."""
    values = [f(move(INPUTS, k * h, direction)) for k in (-2, -1, 1, 2)]
    return jax.tree.map(lambda a, b, c, d: (8 * (c - b) - (d - a)) / (12 * h), *values)


def dot(a, b):
    return sum(
        np.sum(np.asarray(x) * y)
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )


@each_projection
def test_gradient_agrees_with_finite_differences(projection):
    """With respect to the state, time, args, conserved values, the metric and what is in `fn`."""
    value = eqx.filter_jit(loss)
    gradient = gradient_of_loss(INPUTS, projection)
    for seed in range(3):
        d = directions(seed)
        difference = central_difference(lambda inputs: value(inputs, projection), d)
        np.testing.assert_allclose(dot(gradient, d), difference, rtol=1e-7, atol=1e-9)
    for name, part in gradient.items():
        assert all(np.any(np.asarray(x) != 0) for x in jax.tree.leaves(part)), name


@pytest.mark.parametrize(
    "transform", [pytest.param(jax.jacfwd, marks=pytest.mark.slow), jax.jacrev]
)
def test_derivatives_agree_with_the_unrolled_iteration(transform):
    def implicit(inputs):
        return projected(inputs, dfc.SimplifiedNewton())

    ours = jax.jit(transform(implicit))(INPUTS)
    theirs = jax.jit(transform(unrolled_simplified_newton))(INPUTS)
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-10)


@each_projection
def test_forward_and_reverse_agree(projection):
    d = directions(7)

    @eqx.filter_jit
    def tangent(inputs, d):
        return jax.jvp(lambda inputs: loss(inputs, projection), (inputs,), (d,))[1]

    forward = tangent(INPUTS, d)
    reverse = dot(gradient_of_loss(INPUTS, projection), d)
    np.testing.assert_allclose(forward, reverse, rtol=1e-12)


@pytest.mark.slow
@each_projection
def test_second_derivatives(projection):
    d = directions(3)
    _, second = eqx.filter_jit(
        lambda inputs, d: eqx.filter_jvp(
            lambda x: eqx.filter_grad(loss)(x, projection), (inputs,), (d,)
        )
    )(INPUTS, d)
    difference = central_difference(lambda inputs: gradient_of_loss(inputs, projection), d)
    for a, b in zip(jax.tree.leaves(second), jax.tree.leaves(difference), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_gradient_with_redundant_constraints_is_that_without():
    def run(inputs, copies):
        manifold = (dfc.FirstIntegral(Energy(inputs["inertia"])),) * copies
        y, _ = dfc.project(
            manifold,
            inputs["y"],
            args=inputs["args"],
            value=(inputs["values"][0],) * copies,
            projection=dfc.SimplifiedNewton(),
        )
        return jnp.sum(y**3)

    gradient = eqx.filter_jit(eqx.filter_grad(run))
    once, twice = (gradient(INPUTS, copies) for copies in (1, 2))
    for a, b in zip(jax.tree.leaves(once), jax.tree.leaves(twice), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)


UNITS = jnp.array([1e-20, 1.0, 1e5, 1e13, 1e24])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "bounds"),
    [(k, b) for b in ({}, {"lower": -9.0}) for k in (dfc.SimplifiedNewton, dfc.Newton)],
    ids=["free-simplified", "free-newton", "bounded-simplified", "bounded-newton"],
)
def test_the_units_of_a_constraint_do_not_count(kind, bounds):
    """Nor do those of the state, if the metric follows."""

    def fn(t, y, args):
        a, b, c = y / args["metre"]
        both = jnp.stack([a**2 + 2 * b**2 + c**2 - 4, jnp.exp(0.3 * a) * c + b * a - 0.5])
        return args["unit"] * both

    candidate = jnp.array([1.1, 0.9, 0.4])

    @jax.jit
    @jax.vmap
    def found(unit, metre):
        def state(x):
            projection = kind(**jax.tree.map(lambda x: x * metre, bounds))
            args = {"unit": unit, "metre": metre}
            y, info = dfc.project(dfc.Constraint(fn), x * metre, args=args, projection=projection)
            return y / metre, info.ok

        _, vjp, ok = jax.vjp(state, candidate, has_aux=True)
        return vjp(jnp.array([0.3, -0.7, 0.5]))[0], ok

    slopes, ok = found(UNITS, jnp.ones(5))
    others, okay = found(jnp.ones(5), jnp.array([1e-9, 1e-3, 1.0, 1e3, 1e9]))
    assert jnp.all(ok & okay)
    np.testing.assert_allclose(slopes, jnp.stack([slopes[1]] * 5), rtol=1e-9)
    np.testing.assert_allclose(others, jnp.stack([slopes[1]] * 5), rtol=1e-9)


@each_projection
def test_a_lane_that_failed_spoils_no_other(projection):
    """In reverse mode as in forward mode, its derivative is NaN or unused, and nothing raises."""

    def one(x):
        sphere = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - 1)
        y, info = dfc.project(sphere, x, projection=projection)
        return jnp.sum(y * jnp.array([1.0, 2.0])), info.ok

    lanes = jnp.array([[1.0, 0.3], [jnp.nan, 1.0], [jnp.inf, 1.0], [0.2, 1.4]])
    _, gradients = jax.jit(jax.vmap(jax.value_and_grad(one, has_aux=True)))(lanes)
    direction = lanes / jnp.linalg.norm(lanes, axis=1, keepdims=True)
    across = jnp.stack([-direction[:, 1], direction[:, 0]], axis=1)
    exact = across * (across @ jnp.array([1.0, 2.0]) / jnp.linalg.norm(lanes, axis=1))[:, None]
    np.testing.assert_allclose(gradients[::3], exact[::3], rtol=1e-9)


def test_derivatives_of_a_large_state_are_right_or_nan():
    """More unknowns than a dense system has. The derivative is linear in the tangent, also in a
    very small one; where the constraint has an infinite derivative, it is NaN in both modes."""
    n = 260
    axes = jnp.linspace(1.0, 2.0, n)
    manifold = dfc.Constraint(lambda t, y, args: jnp.sqrt(y[0]) + jnp.sum(axes * y[1:] ** 2) - 1)

    @jax.jit
    def project(y):
        return dfc.project(manifold, y, projection=dfc.Newton())[0]

    @jax.jit
    def both_modes(y, v, w):
        along = jax.jvp(project, (y,), (v,))[1]
        (gradient,) = jax.vjp(project, y)[1](w)
        return along, gradient

    rng = np.random.default_rng(0)
    y, v, w = (rng.normal(size=n + 1) for _ in range(3))
    y = 0.04 * y
    y[0] = 0.3
    along, gradient = both_modes(y, v, w)
    h = 1e-6
    expected = (project(y + h * v) - project(y - h * v)) / (2 * h)
    np.testing.assert_allclose(along, expected, rtol=0, atol=1e-8)
    np.testing.assert_allclose(gradient @ v, w @ along, rtol=1e-11)
    tiny_along, tiny_gradient = both_modes(y, 1e-14 * v, 1e-14 * w)
    np.testing.assert_allclose(1e14 * tiny_along, along, rtol=0, atol=1e-11)
    np.testing.assert_allclose(1e14 * tiny_gradient, gradient, rtol=0, atol=1e-11)

    on_it = np.zeros(n + 1)
    on_it[1] = 1
    assert all(np.all(np.isnan(x)) for x in both_modes(on_it, v, w))
