"""States of half precision work with every projection, or are refused with a remedy."""

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc

from ..thinned import some_of

SQUARE = {"square": dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))}
WORK = {
    "simplified": dfc.SimplifiedNewton(),
    "bounded": dfc.SimplifiedNewton(lower=-2.0),
    "formula": dfc.ClosedForm(lambda t, y, args, v: y * jnp.sqrt(v["square"] / jnp.sum(y**2))),
    "directional": dfc.Directional(),
    "staged": dfc.Staged(("square", dfc.SimplifiedNewton())),
}


@eqx.filter_jit
def solve(projection, dtype):
    return dfx.diffeqsolve(
        dfx.ODETerm(lambda t, y, args: jnp.stack([-y[1], y[0]])),
        dfc.ManifoldProjection(dfx.Bosh3(), SQUARE, projection=projection),
        *jnp.array([0, 1, 0.125], dtype),
        jnp.array([1.0, 0.5], dtype),
        saveat=dfx.SaveAt(ts=jnp.array([0.25, 0.4, 1], dtype)),
    )


@some_of("name", WORK, ids=WORK, period=3)
def test_it_works_in_half_precision(name):
    for dtype in (jnp.float16, jnp.bfloat16):
        ys = solve(WORK[name], dtype).ys
        assert ys.dtype == dtype
        squares = np.sum(np.asarray(ys, np.float64) ** 2, axis=1)
        # The tolerance, of a scale of three times the square, and what rounding the state costs.
        limit = (16 * 3 + 4) * 1.25 * float(jnp.finfo(dtype).eps)
        np.testing.assert_allclose(squares, 1.25, atol=limit)


def test_it_is_refused_before_compilation():
    with pytest.raises(TypeError, match="Convert the state to float32"):
        solve(dfc.Newton(), jnp.float16)
