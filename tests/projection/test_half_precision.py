"""States of half precision work with every projection, or are refused with a remedy."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc

from ..thinned import combinations, some_of

SQUARE = {"square": dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))}
WORK = {
    "simplified": dfc.SimplifiedNewton(),
    "bounded": dfc.SimplifiedNewton(lower=-2.0),
    "formula": dfc.ClosedForm(lambda t, y, args, v: y * jnp.sqrt(v["square"] / jnp.sum(y**2))),
    "directional": dfc.Directional(),
    "staged": dfc.Staged(("square", dfc.SimplifiedNewton())),
}
DTYPES = [jnp.float16, jnp.bfloat16]


@eqx.filter_jit
def solve(projection, dtype):
    return dfx.diffeqsolve(
        dfx.ODETerm(lambda t, y, args: jnp.stack([-y[1], y[0]])),
        dfc.ManifoldProjection(dfx.Bosh3(), SQUARE, projection=projection),
        *jnp.array([0, 1, 0.125], dtype),
        jnp.array([1.0, 0.5], dtype),
        saveat=dfx.SaveAt(ts=jnp.array([0.25, 0.4, 1], dtype)),
    )


CASES = combinations({name: name for name in WORK}, {x.__name__: x for x in DTYPES})


@some_of("name,dtype", CASES.values(), ids=CASES, period=5)
def test_it_works_in_half_precision(name, dtype):
    ys = solve(WORK[name], dtype).ys
    assert ys.dtype == dtype
    squares = np.sum(np.asarray(ys, np.float64) ** 2, axis=1)
    # The tolerance, of a scale of three times the square, and what rounding the state costs.
    np.testing.assert_allclose(
        squares, 1.25, atol=(16 * 3 + 4) * 1.25 * float(jnp.finfo(dtype).eps)
    )


@pytest.mark.parametrize("dtype", DTYPES)
def test_it_is_refused_before_compilation(dtype):
    with pytest.raises(TypeError, match="Convert the state to float32"):
        jax.eval_shape(lambda: solve(dfc.Newton(), dtype).ys)
