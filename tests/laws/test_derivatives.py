"""Laws of the derivative of a projection."""

import diffrax as dfx
import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
from hypothesis import given, settings
from jax.flatten_util import ravel_pytree

import diffrax_conserve as dfc

from .common import (
    PARALLEL,
    SYSTEMS,
    check,
    displaced,
    every_law_on_every_system,
    inputs,
    project,
    within,
)


def linearised(system, y, displacement, size=0.0):
    """The derivative of the projection near `y`, as a function of flat directions."""
    fixed = jax.tree.map(jnp.asarray, y)
    candidate = displaced(fixed, displacement, size)
    flat, unravel = ravel_pytree(candidate)

    def run(flat):
        out, ok = project(system.manifold, unravel(flat), fixed)
        return ravel_pytree(out)[0], ok

    _, jvp, ok = jax.linearize(run, flat, has_aux=True)
    return jvp, flat, ok


def direction(flat, phase):
    return jnp.sin(1 + phase + jnp.arange(flat.size))


def on_the_manifold_it_is_the_orthogonal_projector_that_keeps_the_flow(system, y, displacement):
    """In the Euclidean metric."""
    jvp, flat, ok = linearised(system, y, displacement)
    a, b = direction(flat, 0), direction(flat, 5)
    flow = ravel_pytree(system.vector_field(0.0, jax.tree.map(jnp.asarray, y), None))[0]
    flow = flow / jnp.linalg.norm(flow)
    once = jvp(a)
    return ok, (1 + jvp(once), 1 + once @ b, jvp(flow)), (1 + once, 1 + a @ jvp(b), flow)


def reverse_mode_is_the_transpose_of_forward_mode(system, y, displacement):
    jvp, flat, ok = linearised(system, y, displacement, size=1e-3)
    a, b = direction(flat, 0), direction(flat, 5)
    (pulled,) = jax.linear_transpose(jvp, flat)(b)
    return ok, 1 + pulled @ a, 1 + b @ jvp(a)


@within(1e-7)
def the_integrals_of_the_projected_state_do_not_change(system, y, displacement):
    """Not even to first order: `∂(I ∘ project) = 0`, in reverse mode."""
    fixed = jax.tree.map(jnp.asarray, y)

    def total(candidate):
        out, ok = project(system.manifold, candidate, fixed)
        values = ravel_pytree([e.fn(0.0, out, None) for e in system.manifold.values()])[0]
        own = jax.lax.stop_gradient(jnp.abs(values)) + 1e-3
        return jnp.sum(values / own), ok

    gradient, ok = jax.grad(total, has_aux=True)(displaced(fixed, displacement))
    size = jnp.max(jnp.abs(ravel_pytree(fixed)[0]))
    return ok, jax.tree.map(lambda g: 1 + g * size, gradient), jax.tree.map(jnp.ones_like, gradient)


LAWS = [
    on_the_manifold_it_is_the_orthogonal_projector_that_keeps_the_flow,
    reverse_mode_is_the_transpose_of_forward_mode,
    the_integrals_of_the_projected_state_do_not_change,
]


@every_law_on_every_system(
    LAWS,
    skip={
        (law.__name__, PARALLEL)
        for law in (
            on_the_manifold_it_is_the_orthogonal_projector_that_keeps_the_flow,
            the_integrals_of_the_projected_state_do_not_change,
        )
    },
)
@settings(max_examples=6)
@given(data=st.data())
def test_law(law, name, data):
    system = SYSTEMS[name]
    check(law, system, data.draw(inputs(system)))


def balancing(t, y, args):
    rate, angle = args
    return jnp.stack([y[1], -jnp.sin(rate * y[0] - angle)])


def balancing_energy(t, y, args):
    rate, angle = args
    return y[1] ** 2 / 2 - jnp.cos(rate * y[0] - angle) / rate


@eqx.filter_jit
def sensitivity(solver, y0, args):
    def end(y0):
        sol = dfx.diffeqsolve(dfx.ODETerm(balancing), solver, 0, 0.5, 0.05, y0, args)
        return sol.ys[-1]

    return jax.jacrev(end)(y0)


@given(
    rate=st.floats(0.5, 2),
    angle=st.floats(-3, 3),
    exponent=st.floats(-9, -1),  # closer to it, derivatives lose all digits with the gradient
    side=st.sampled_from([-1, 1]),
)
def test_a_start_near_an_unstable_equilibrium(rate, angle, exponent, side):
    """The gradient of the energy is small there."""
    args, distance = jnp.array([rate, angle]), side * 10**exponent
    y0 = jnp.array([(angle + jnp.pi) / rate + distance, 0.0])
    projected = dfc.ManifoldProjection(dfc.RK4(), dfc.FirstIntegral(balancing_energy))
    found, plain = (sensitivity(solver, y0, args) for solver in (projected, dfc.RK4()))
    if abs(distance) > 1e-4:
        assert jnp.all(jnp.isfinite(found))
    # Both are derivatives of the flow up to the error of the method.
    assert jnp.all(jnp.isnan(found)) or jnp.max(jnp.abs(found - plain)) < 1e-4
