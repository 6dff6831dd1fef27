"""What `print` shows, and functions that are written out in scalars."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_conserve as dfc
from diffrax_conserve._constants import MAX_SCALAR_OPERATIONS, MAX_SCALAR_RESULTS
from diffrax_conserve._fast.jaxprs import jaxprs_inside
from diffrax_conserve._fast.scalars import components, scalarised, scalarised_result

from .problems import INERTIA, printed, rotational_energy, squared_momentum
from .thinned import some_of


@jax.custom_jvp
def own_derivative(x):
    return x


own_derivative.defjvp(lambda primals, tangents: (primals[0], 7 * tangents[0]))


def test_zero_times_nan_is_nan_in_a_batch_too():
    """So that no lane conserves a function that has no value."""
    integral = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2) + 0 * jnp.sqrt(y[0]), value=1.0)
    project = lambda y: dfc.project(integral, y, projection=dfc.SimplifiedNewton())[1].ok  # noqa: E731
    np.testing.assert_array_equal(
        jax.jit(jax.vmap(project))(jnp.array([[0.6, 0.8], [-0.6, 0.8], [-0.6, 0.79]])),
        [True, False, False],
    )


# ---- What is written out, told by what remains in arrays, not by time ----

ORDER = jnp.array([2, 0, 1])
energy = lambda y: rotational_energy(0.0, y, None)  # noqa: E731
momentum = lambda y: squared_momentum(0.0, y, None)  # noqa: E731


def both(y):
    return jnp.stack([energy(y), momentum(y)])


# Two integrals of a state of three components, and the primitives that are left in arrays.
FORMS = {
    "stack": (both, ""),
    "tuple": (lambda y: (energy(y), momentum(y)), ""),
    "dictionary": (lambda y: {"energy": energy(y), "momentum": momentum(y)}, ""),
    "jnp.array": (lambda y: jnp.array([energy(y), momentum(y)]), ""),
    "concatenate": (lambda y: jnp.concatenate([energy(y)[None], momentum(y)[None]]), ""),
    "columns first": (lambda y: jnp.ravel(jnp.stack([both(y), 2 * y[:2]]), order="F")[::2], ""),
    "hstack": (lambda y: jnp.hstack([energy(y), momentum(y)]), ""),
    "append": (lambda y: jnp.append(energy(y), momentum(y)), ""),
    "at set": (lambda y: jnp.zeros(2, y.dtype).at[0].set(energy(y)).at[-1].set(momentum(y)), ""),
    "at add": (lambda y: both(y).at[jnp.array([0, 0, 1])].add(y), ""),
    "at set, outside": (lambda y: both(y).at[jnp.array([5, 0])].set(y[:2], mode="drop"), ""),
    "where": (lambda y: jnp.where(np.array([True, False]), energy(y), momentum(y)), ""),
    "vmap": (lambda y: jax.vmap(lambda k: jnp.sum(k * y**2))(jnp.stack([y, 2 * y])), ""),
    "matrix": (lambda y: jnp.asarray([INERTIA, INERTIA**2], y.dtype) @ y**2, ""),
    "einsum": (lambda y: jnp.einsum("i,ji->j", y, jnp.stack([y, 2 * y])), ""),
    "take": (lambda y: jnp.take(both(y), jnp.array([1, 0])), ""),
    "take, outside": (lambda y: jnp.take(both(y), jnp.array([1, 2]), fill_value=3.0), ""),
    "take, clipped": (lambda y: jnp.take(both(y), jnp.array([-5, 2]), mode="clip"), ""),
    "take of a matrix": (lambda y: jnp.take(jnp.outer(y, y), ORDER, axis=1).sum(0), ""),
    "indices": (lambda y: both(y[ORDER]) + y[np.array([0, 0])] + y[jnp.array([-1, 1])], ""),
    "mask": (lambda y: both(y) + y[np.array([True, False, True])], ""),
    "dynamic slice": (lambda y: 2 * jax.lax.dynamic_slice(y, (1,), (2,)), ""),
    "dynamic update": (lambda y: both(jax.lax.dynamic_update_slice(y, 2 * y[:2], (1,))), ""),
    "split": (lambda y: both(jnp.concatenate(jnp.split(y, 3)[::-1])), ""),
    "roll": (lambda y: both(y + jnp.roll(y, 1)), ""),
    "flip": (lambda y: both(y * jnp.flip(y)), ""),
    "cross": (lambda y: both(jnp.cross(y, INERTIA * y)), ""),
    "diff": (lambda y: jnp.diff(y) ** 2, ""),
    "negative padding": (lambda y: jax.lax.pad(y**2, y[0], [(-1, 1, 1)])[:2], ""),
    "norm": (lambda y: jnp.stack([energy(y), jnp.linalg.norm(y)]), ""),
    "complex": (lambda y: jnp.abs(jax.lax.complex(y, 2 * y) * (1 + 2j)) ** 2, ""),
    "checkpoint": (jax.checkpoint(both), ""),
    "outer product": (lambda y: jnp.tensordot(y, y, axes=0)[0], ""),
    "largest": (lambda y: jnp.stack([jnp.max(y), jnp.prod(y)]), ""),
    "elementary": (lambda y: both(jnp.exp(jnp.sin(y)) / jnp.hypot(y, 2.0) + jnp.log1p(y)), ""),
    "comparisons": (lambda y: both(jnp.where(y > 0.5, jnp.sqrt(y), jnp.clip(y, 0.1, 0.4))), ""),
    "relu": (lambda y: both(jax.nn.relu(y) + jax.nn.softplus(y)), ""),
    # These have a primitive that is evaluated in arrays, and only that.
    "cumsum": (lambda y: both(jnp.cumsum(y)), "cumsum"),
    "sort": (lambda y: both(jnp.sort(y)), "sort"),
    "solve": (lambda y: both(jnp.linalg.solve(jnp.diag(y) + 1, y)), "lu custom_linear_solve"),
    "cond": (lambda y: both(jax.lax.cond(y[0] > 0, jnp.sin, jnp.cos, y)), "cond"),
    "scan": (lambda y: both(jax.lax.fori_loop(0, 3, lambda _, x: x * y, y)), "scan"),
}
# What joins elements and takes arrays apart.
JOINTS = {"broadcast_in_dim", "concatenate", "reshape", "squeeze", "slice", "stack", "unstack"}


def equations_in(jaxpr):
    """Those of a jaxpr, but inside of calls instead of the calls."""
    for eqn in jaxpr.eqns:
        inner = list(jaxprs_inside(eqn)) if eqn.primitive.name in ("jit", "pjit") else []
        for called in inner:
            yield from equations_in(called.jaxpr)
        if not inner:
            yield eqn


def names_of_arrays(jaxpr, of_arrays=lambda aval: aval.ndim > 0):
    return {
        eqn.primitive.name
        for eqn in equations_in(jaxpr)
        if any(of_arrays(var.aval) for var in (*eqn.invars, *eqn.outvars))
    } - JOINTS


def with_jacobian(fn):
    return lambda y: (fn(y), jax.jacrev(fn)(y))


@pytest.mark.parametrize("name", FORMS)
def test_a_form_is_written_out(name):
    fn, arrays = FORMS[name]
    y = jnp.array([0.3, 0.5, 0.7])
    written = scalarised(fn, y)
    assert names_of_arrays(jax.make_jaxpr(written)(components(y)).jaxpr) == set(arrays.split())
    if not arrays:
        written = scalarised(with_jacobian(fn), y)
        closed = jax.make_jaxpr(written)(components(y))
        assert not [v for e in equations_in(closed.jaxpr) for v in e.outvars if v.aval.ndim]


@some_of("name", FORMS, ids=FORMS, period=41)
def test_a_form_that_is_written_out_keeps_its_values_and_derivatives(name):
    """In both precisions, alone and in a batch."""
    fn, _ = FORMS[name]

    def found(y):
        values, jacobian = with_jacobian(fn)(y)
        inside = scalarised_result(with_jacobian(fn), y)
        around = jax.jacrev(lambda y: scalarised_result(fn, y))(y)
        return (values, jacobian, jacobian), (*inside, around)

    for dtype in (jnp.float64, jnp.float32):
        ys = 0.2 + jr.uniform(jr.key(0), (4, 3), dtype)
        wanted, given = jax.jit(jax.vmap(found))(ys)
        for a, b in zip(jax.tree.leaves(wanted), jax.tree.leaves(given), strict=True):
            assert a.dtype == b.dtype
            np.testing.assert_allclose(a, b, rtol=64 * jnp.finfo(dtype).eps, atol=1e-12)
        alone = jax.jit(found)(ys[1])[1]
        for a, b in zip(jax.tree.leaves(given), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a[1], b, rtol=64 * jnp.finfo(dtype).eps, atol=1e-12)


@jax.custom_vjp
def own_transpose(x):
    return x


own_transpose.defvjp(lambda x: (x, None), lambda _, g: (7 * g,))


@pytest.mark.parametrize("fn", [own_derivative, own_transpose])
def test_a_derivative_of_ones_own_is_kept(fn):
    gradient = jax.grad(lambda y: jnp.sum(scalarised_result(lambda y: 2 * fn(y), y)))(jnp.ones(3))
    np.testing.assert_array_equal(gradient, 14 * np.ones(3))
    # Where no derivative is taken afterwards it is written out.
    written = scalarised(with_jacobian(fn), jnp.ones(3))
    assert not names_of_arrays(jax.make_jaxpr(written)(components(jnp.ones(3))).jaxpr)


def test_what_is_too_large_has_an_effect_or_random_numbers_is_not_written_out():
    def prints(y):
        jax.debug.print("{}", y)
        return y

    assert scalarised(lambda y: y * y + 1, jnp.ones(MAX_SCALAR_RESULTS)) is not None
    assert scalarised(lambda y: y * y + 1, jnp.ones(MAX_SCALAR_RESULTS + 1)) is None
    assert scalarised(lambda y: y + 1, jnp.ones(3)) is None
    assert scalarised(lambda y: jnp.sum(y * y), jnp.ones(MAX_SCALAR_OPERATIONS // 2)) is not None
    assert scalarised(lambda y: jnp.sum(y * y), jnp.ones(MAX_SCALAR_OPERATIONS)) is None
    assert scalarised(prints, jnp.ones(3)) is None
    assert scalarised(lambda y: y + jr.normal(jr.key(0)), jnp.ones(3)) is None


LANES = 11


def innermost_loops(jaxpr):
    found = [loop for eqn in jaxpr.eqns for loop in loops_of(eqn)]
    return found or [jaxpr]


def loops_of(eqn):
    if eqn.primitive.name == "while":
        return innermost_loops(eqn.params["body_jaxpr"].jaxpr)
    inner = [closed.jaxpr for closed in jaxprs_inside(eqn)]
    return [loop for jaxpr in inner for loop in innermost_loops(jaxpr) if loop is not jaxpr]


# The systems whose functions are not written out, because they have too many operations.
IN_ARRAYS = {"outer-solar-system", "korteweg-de-vries"}


@some_of("name", dfc.systems.names(), ids=dfc.systems.names(), period=7)
def test_the_projections_of_the_catalogue_are_written_out_in_a_batch(name):
    """Scalars have the lanes as their only axis, and what is computed for all lanes together has
    them as the last. Only a branch passes on arrays with the lanes first, such as the metric."""
    system = dfc.systems.get(name)
    term = dfx.ODETerm(system.vector_field)

    def solve(y0):
        solver = dfc.ManifoldProjection(dfc.RK4(), system.manifold)
        return dfx.diffeqsolve(term, solver, 0.0, 0.1, 0.01, y0, throw=False).ys

    ys = jax.tree.map(lambda x: jnp.stack([x] * LANES), system.y0)
    of_lanes = lambda aval: aval.ndim > 1 and aval.shape[0] == LANES  # noqa: E731
    loops = innermost_loops(jax.make_jaxpr(jax.vmap(solve))(ys).jaxpr)
    arrays = set().union(*(names_of_arrays(loop, of_lanes) for loop in loops))
    assert bool(arrays - {"cond"}) == (name in IN_ARRAYS)


# ---- What `print` shows of the records of the package ----


SPHERE = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - 1)


def test_the_report_is_printed_as_success_or_failure_or_by_its_ranges():
    on_two = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - 2)
    _, info = dfc.project({"one": (SPHERE,), "two": on_two}, jnp.array([1.0, 2.0, 2.0]))
    assert str(info).startswith("NOT PROJECTED: ")
    name = ("manifold['one'][0]", "manifold['two']")[info.worst]
    assert printed(info).endswith(f"worst {name}")
    words = printed(dfc.project(SPHERE, jnp.array([1.0, 2.0, 2.0]))[1])
    assert words.startswith("projected ")
    assert "correction 2.0e+00" in words
    project = jax.jit(jax.vmap(lambda y: dfc.project(SPHERE, y)))
    ys = jnp.array([[2.0, 0.0], [5.0, 0.0], [jnp.nan, 0.0]])
    assert str(project(ys)[1]).startswith("2 of 3 projections succeeded")
    assert printed(project(ys)[1]).endswith("worst manifold")
    _, info = project(ys.at[2, 0].set(3.0))
    assert "correction 1.0e+00 to 4.0e+00" in printed(info)
