"""Complex states: real functions of them, kept by corrections of real and imaginary parts."""

import functools as ft

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc

pytestmark = pytest.mark.filterwarnings("ignore:Complex dtype support")


def field(t, y, args):
    """Two oscillators that exchange quanta, and one by itself."""
    a, b = y["z"]
    coupling = args * jnp.stack([b, a])
    return {"z": -1j * (jnp.array([1.0, 2.0]) * y["z"] + coupling), "x": -1j * y["x"]}


def quanta(t, y, args):
    z = y["z"]
    return {
        "number": jnp.sum(z.real**2 + z.imag**2),
        "energy": jnp.sum(jnp.array([1.0, 2.0]) * jnp.abs(z) ** 2)
        + 2 * args * jnp.real(jnp.conj(z[0]) * z[1]),
        "amplitude": jnp.sum(jnp.abs(y["x"]) ** 2),
    }


QUANTA = dfc.FirstIntegral(quanta)
Z0 = {"z": jnp.array([1.0 + 0.5j, -0.3 + 0.2j]), "x": jnp.array([0.6 + 0.1j])}
ARGS = jnp.array(0.3)


def split(y):
    return {"re": y["z"].real, "im": y["z"].imag, "x": jnp.stack([y["x"].real, y["x"].imag])}


def join(y):
    return {"z": y["re"] + 1j * y["im"], "x": y["x"][..., 0, :] + 1j * y["x"][..., 1, :]}


real_field = lambda t, y, args: split(field(t, join(y), args))  # noqa: E731
REAL_QUANTA = dfc.FirstIntegral(lambda t, y, args: quanta(t, join(y), args))


@eqx.filter_jit
def solve(projection, y0, vf, manifold):
    # The simplest of all solvers: what is compared is the projection. It starts out of bounds.
    solver = dfc.ManifoldProjection(dfx.Euler(), {"q": manifold}, projection=projection)
    saveat = dfx.SaveAt(ts=jnp.linspace(0, 0.6, 9))
    return dfx.diffeqsolve(dfx.ODETerm(vf), solver, 0.0, 0.6, 0.1, y0, ARGS, saveat=saveat)


TWO = jnp.array([2.0, 5.0])


@pytest.mark.slow
def test_it_is_the_solve_in_real_and_imaginary_parts():
    """Within a bound, and in a metric."""
    in_metric = ft.partial(dfc.Newton, upper=0.98)
    got = solve(in_metric(metric={"z": TWO, "x": 3.0}), Z0, field, QUANTA)
    real_one = in_metric(metric={"re": TWO, "im": TWO, "x": 3.0})
    expected = solve(real_one, split(Z0), real_field, REAL_QUANTA)
    assert got.ys["z"].dtype == jnp.complex128
    for x, y in zip(jax.tree.leaves(got.ys), jax.tree.leaves(join(expected.ys)), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-11)


def projected(manifold, y, args):
    candidate, value = jax.tree.map(lambda x: 1.01 * x, y), {"q": quanta(0.0, Z0, ARGS)}
    options = dict(value=value, args=args, projection=dfc.SimplifiedNewton())
    return dfc.project({"q": manifold}, candidate, **options)[0]


def test_gradients_agree_with_those_in_parts():
    def total(y):
        z, x = y["z"], y["x"]
        return z[0].real + 2 * z[1].real + jnp.sum(z.imag**2) + x[0].real

    @jax.jit
    def gradients(y, args):
        whole = jax.grad(lambda y, a: total(projected(QUANTA, y, a)), (0, 1))
        parts = jax.grad(lambda y, a: total(join(projected(REAL_QUANTA, y, a))), (0, 1))
        return whole(y, args), parts(split(y), args)

    got, expected = gradients(Z0, ARGS)
    # jax's convention of the gradient by a complex number: the conjugate.
    np.testing.assert_allclose(got[0]["z"], expected[0]["re"] - 1j * expected[0]["im"], rtol=1e-10)
    np.testing.assert_allclose(got[1], expected[1], rtol=1e-10)


def test_a_complex_value_is_refused():
    with pytest.raises(TypeError, match="real and its imaginary"):
        dfc.project(dfc.Constraint(lambda t, y, args: y[0]), jnp.ones(2) * 1j)
