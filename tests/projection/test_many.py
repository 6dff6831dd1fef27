"""Many constraints, formulas of the user, and half precision."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc

from ..problems import solve
from ..thinned import some_of

# ---- A projection that the user writes down is used as it is, and checked ----


SPHERE = {"square": dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))}


def rescale(t, y, args, values):
    return y * jnp.sqrt(values["square"] / jnp.sum(y**2))


def rotation(t, y, args):
    return args * jnp.stack([y[1], -y[0]])


def run(projection, y0, args, **kwargs):
    solver = dfc.ManifoldProjection(dfc.RK4(), SPHERE, projection=projection)
    return solve(rotation, solver, y0, args=args, **kwargs)


def test_it_agrees_with_newton_and_so_do_its_derivatives():
    def total(y, value, projection):
        found, _ = dfc.project(SPHERE, y, value={"square": value}, projection=projection)
        return jnp.sum(found**3)

    gradient = jax.jit(jax.value_and_grad(total, (0, 1)), static_argnums=2)
    y, value = jnp.array([3.0, 4.1]), jnp.array(25.0)
    closed, newton = (gradient(y, value, p) for p in (dfc.ClosedForm(rescale), dfc.Newton()))
    for a, b in zip(jax.tree.leaves(closed), jax.tree.leaves(newton), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)


def test_wrong_input_is_explained():
    for fn in (lambda t, y, args, values: (y,), lambda t, y, args, values: y[:1]):
        with pytest.raises(ValueError, match="`fn` of a `ClosedForm` returned"):
            run(dfc.ClosedForm(fn), jnp.array([3.0, 4.0]), 1.0)


# ---- States of half precision work with every projection, or are refused with a remedy ----


SQUARE = {"square": dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))}
WORK = {
    "simplified": dfc.SimplifiedNewton(),
    "bounded": dfc.SimplifiedNewton(lower=-2.0),
    "formula": dfc.ClosedForm(lambda t, y, args, v: y * jnp.sqrt(v["square"] / jnp.sum(y**2))),
    "along a line": dfc.AlongLine(direction="error"),
    "staged": dfc.Staged(("square", dfc.SimplifiedNewton())),
}


def in_half_precision(projection, dtype):
    solver = dfc.ManifoldProjection(dfx.Bosh3(), SQUARE, projection=projection)
    saveat = dfx.SaveAt(ts=jnp.array([0.25, 0.4, 1], dtype))
    y0 = jnp.array([1.0, 0.5], dtype)
    return solve(rotation, solver, y0, args=jnp.ones((), dtype), dt0=0.125, saveat=saveat)


@some_of("dtype", [jnp.float16, jnp.bfloat16], ids=["float16", "bfloat16"], period=2)
@some_of("name", WORK, ids=WORK, period=5)
def test_it_works_in_half_precision(name, dtype):
    ys = in_half_precision(WORK[name], dtype).ys
    assert ys.dtype == dtype
    squares = np.sum(np.asarray(ys, np.float64) ** 2, axis=1)
    # The tolerance, of a scale of three times the square, and what rounding the state costs.
    limit = (16 * 3 + 4) * 1.25 * float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose(squares, 1.25, rtol=0, atol=limit)


def test_it_is_refused_before_compilation():
    with pytest.raises(TypeError, match="Convert the state to float32"):
        in_half_precision(dfc.Newton(), jnp.float16)
