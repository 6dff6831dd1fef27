"""Laws of the derivative of a projection."""

import diffrax as dfx
import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
from hypothesis import given, settings
from jax.flatten_util import ravel_pytree

import diffrax_conserve as dfc

from .common import PARALLEL, SYSTEMS, check, every_law_on_every_system, inputs, project


def direction(flat, phase):
    return jnp.sin(1 + phase + jnp.arange(flat.size))


def on_the_manifold_it_is_the_orthogonal_projector_that_keeps_the_flow(system, y, displacement):
    """In the Euclidean metric."""
    fixed = jax.tree.map(jnp.asarray, y)
    flat, unravel = ravel_pytree(fixed)

    def run(flat):
        out, ok = project(system.manifold, unravel(flat), fixed)
        return ravel_pytree(out)[0], ok

    _, jvp, ok = jax.linearize(run, flat, has_aux=True)
    a, b = direction(flat, 0), direction(flat, 5)
    flow = ravel_pytree(system.vector_field(0.0, fixed, None))[0]
    flow = flow / jnp.linalg.norm(flow)
    once = jvp(a)
    return ok, (1 + jvp(once), 1 + once @ b, jvp(flow)), (1 + once, 1 + a @ jvp(b), flow)


LAW = on_the_manifold_it_is_the_orthogonal_projector_that_keeps_the_flow


@every_law_on_every_system([LAW], skip={(LAW.__name__, PARALLEL)})
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
