"""A solver can be a static argument of `jax.jit` and a key of a dictionary, with any manifold."""

from functools import partial

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc

from ..laws.test_lanes import CASES

TERM = dfx.ODETerm(lambda t, y, args: jnp.stack([y[1], -y[0]]))


def radius(t, y, args):
    return jnp.sum(y**2)


# Made anew at each call, from the same function.
MANIFOLDS = {
    "one": lambda: dfc.FirstIntegral(radius),
    "tuple": lambda: (dfc.FirstIntegral(radius),),
    "list": lambda: [dfc.FirstIntegral(radius)],
    "dictionary": lambda: {"radius": dfc.FirstIntegral(radius)},
    "value": lambda: dfc.FirstIntegral(radius, value=1.0),
    "array": lambda: dfc.FirstIntegral(radius, value=jnp.array(1.0)),
}
PROJECTIONS = {
    "default": dfc.SimplifiedNewton,
    "metric": lambda: dfc.SimplifiedNewton(metric=jnp.ones(2)),
    "metric of numpy": lambda: dfc.Newton(metric=np.ones(2)),
    "bounds": lambda: dfc.SimplifiedNewton(lower=jnp.array([-2.0, -2.0]), upper=2.0),
    "tolerance": lambda: dfc.SimplifiedNewton(rtol=jnp.array(1e-10)),
}
PAIRS = [(m, "default") for m in MANIFOLDS] + [("dictionary", p) for p in PROJECTIONS]


@partial(jax.jit, static_argnames="solver")
def orbit(y0, solver):
    return dfx.diffeqsolve(TERM, solver, 0.0, 1.0, 0.5, y0).ys[-1]


def made(manifold, projection):
    manifold, projection = MANIFOLDS[manifold](), PROJECTIONS[projection]()
    return dfc.ManifoldProjection(dfx.Heun(), manifold, projection=projection)


@pytest.mark.parametrize(("manifold", "projection"), PAIRS)
def test_equal_solvers_are_one_key(manifold, projection):
    a, b = made(manifold, projection), made(manifold, projection)
    assert hash(a) == hash(b)
    assert a == b
    assert {a: 1}[b] == 1
    assert a != dfc.ManifoldProjection(dfx.Euler(), MANIFOLDS[manifold]())


def test_other_values_are_other_keys():
    a, b = (dfc.FirstIntegral(radius, value=jnp.array(x)) for x in (1.0, 2.0))
    assert a != b
    assert a != dfc.FirstIntegral(radius)
    assert a != 1.0


def test_a_static_argument_is_traced_once_inside_of_another_trace_too():
    solver = made("array", "metric")
    y0 = jnp.array([1.0, 0.0])
    first = orbit(y0, solver=solver)
    traced = orbit._cache_size()
    # The comparison of equal solvers takes place while JAX traces.
    again = jax.jit(lambda y: orbit(y, solver=made("array", "metric")))(y0)
    np.testing.assert_array_equal(first, again)
    orbit(y0, solver=made("array", "metric"))
    assert orbit._cache_size() == traced


@pytest.mark.parametrize("name", CASES)
def test_every_solver_is_hashable(name):
    solver = CASES[name][1]
    assert solver in {jax.tree.map(lambda x: x, solver): name}
