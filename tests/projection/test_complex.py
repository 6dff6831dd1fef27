"""Complex states: real functions of them, kept by corrections of real and imaginary parts."""

import diffrax as dfx
import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings

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


def real_field(t, y, args):
    return split(field(t, join(y), args))


REAL_QUANTA = dfc.FirstIntegral(lambda t, y, args: quanta(t, join(y), args))


def test_the_invariance_is_proved():
    def states(key):
        parts = jax.random.normal(key, (2, 3))
        z = parts[0] + 1j * parts[1]
        return {"z": z[:2], "x": z[2:]}

    assert dfc.check_invariance(field, QUANTA, states, args=ARGS, num_states=5).ok
    wrong = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y["z"].real ** 2))
    assert not dfc.check_invariance(field, wrong, states, args=ARGS, num_states=5).ok


TWO = jnp.array([2.0, 5.0])
SIMPLIFIED = dfc.SimplifiedNewton()
PROJECTIONS = {
    "simplified": (SIMPLIFIED, SIMPLIFIED),
    "newton": (dfc.Newton(), dfc.Newton()),
    "metric": (
        dfc.SimplifiedNewton(metric={"z": TWO, "x": 3.0}),
        dfc.SimplifiedNewton(metric={"re": TWO, "im": TWO, "x": 3.0}),
    ),
    "bounded": (dfc.SimplifiedNewton(upper=0.98), dfc.SimplifiedNewton(upper=0.98)),
    "bounded-metric": (
        dfc.SimplifiedNewton(upper=0.98, metric={"z": TWO, "x": 3.0}),
        dfc.SimplifiedNewton(upper=0.98, metric={"re": TWO, "im": TWO, "x": 3.0}),
    ),
    "staged": (dfc.Staged(("q", SIMPLIFIED)), dfc.Staged(("q", SIMPLIFIED))),
}


@eqx.filter_jit
def solve(projection, y0=Z0, args=ARGS, vf=field, manifold=QUANTA, **options):
    # The simplest of all solvers, as what is compared is the projection.
    solver = dfc.ManifoldProjection(dfx.Euler(), {"q": manifold}, projection=projection)
    options = {"t1": 0.6, "dt0": 0.1, "throw": False} | options
    t1, dt0 = options.pop("t1"), options.pop("dt0")
    return dfx.diffeqsolve(dfx.ODETerm(vf), solver, 0.0, t1, dt0, y0, args, **options)


@pytest.mark.parametrize(
    "name",
    [n if n == "simplified" else pytest.param(n, marks=pytest.mark.slow) for n in PROJECTIONS],
)
def test_it_is_the_solve_in_real_and_imaginary_parts(name):
    complex_one, real_one = PROJECTIONS[name]
    saveat = dfx.SaveAt(ts=jnp.linspace(0, 0.6, 9))
    got = solve(complex_one, saveat=saveat)
    expected = solve(real_one, split(Z0), vf=real_field, manifold=REAL_QUANTA, saveat=saveat)
    assert got.ys["z"].dtype == jnp.complex128
    for x, y in zip(jax.tree.leaves(got.ys), jax.tree.leaves(join(expected.ys)), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-11)
    assert (got.result == dfx.RESULTS.successful) == (expected.result == dfx.RESULTS.successful)


def one_projection(manifold):
    def projected(y, args):
        candidate = jax.tree.map(lambda x: 1.01 * x, y)
        value = {"q": quanta(0.0, Z0, ARGS)}
        return dfc.project(
            {"q": manifold}, candidate, value=value, args=args, projection=SIMPLIFIED
        )[0]

    return projected


def test_gradients_agree_with_those_in_parts():
    def total(y):
        z, x = y["z"], y["x"]
        return z[0].real + 2 * z[1].real + jnp.sum(z.imag**2) + x[0].real

    @jax.jit
    def gradients(y, args):
        whole, parts = one_projection(QUANTA), one_projection(REAL_QUANTA)
        return (
            jax.grad(lambda y, a: total(whole(y, a)), (0, 1))(y, args),
            jax.grad(lambda y, a: total(join(parts(y, a))), (0, 1))(split(y), args),
        )

    got, expected = gradients(Z0, ARGS)
    # jax's convention of the gradient by a complex number: the conjugate.
    np.testing.assert_allclose(got[0]["z"], expected[0]["re"] - 1j * expected[0]["im"], rtol=1e-10)
    np.testing.assert_allclose(got[1], expected[1], rtol=1e-10)


@settings(max_examples=15)
@given(st.lists(st.floats(-1, 1), min_size=6, max_size=6))
def test_project_alone_and_in_a_batch(numbers):
    y = {
        "z": jnp.array([1 + 0.1 * numbers[0] + 0.1j * numbers[1], 0.5 + 0.2j * numbers[2]]),
        "x": jnp.array([0.7 + (0.4 + 0.1 * numbers[3]) * 1j]),
    }
    (alone, info), batch = projected(y)
    if info.ok:
        found = quanta(0.0, alone, ARGS)
        np.testing.assert_allclose(found["number"], 1.3, rtol=1e-14)
        np.testing.assert_allclose(found["amplitude"], 0.6, rtol=1e-14)
        np.testing.assert_allclose(batch["z"][1], alone["z"], rtol=1e-12)


CIRCLES = dfc.FirstIntegral(
    lambda t, y, args: {k: quanta(t, y, args)[k] for k in ("number", "amplitude")}
)
VALUE = {"number": 1.3, "amplitude": 0.6}


@eqx.filter_jit
def projected(y):
    def one(y):
        return dfc.project(CIRCLES, y, value=VALUE, args=ARGS, projection=SIMPLIFIED)

    sizes = jnp.array([1.01, 1.0])
    return one(y), jax.vmap(lambda s: one(jax.tree.map(lambda x: s * x, y))[0])(sizes)


def test_a_complex_value_is_refused():
    with pytest.raises(TypeError, match="real and its imaginary"):
        dfc.project(dfc.Constraint(lambda t, y, args: y[0]), jnp.ones(2) * 1j)
