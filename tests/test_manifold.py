"""Wrong input is refused with an error that names the argument and the remedy."""

import dataclasses
import functools as ft

import diffrax as dfx
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

import diffrax_conserve as dfc

from .problems import OMEGA0, RIGID_BODY, rigid_body, rotational_energy, solve


@pytest.fixture(autouse=True)
def no_type_checker():
    """As users run it: the run-time type checker of the suite would answer first."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def wrap(manifold, **kwargs):
    return dfc.ManifoldProjection(dfx.Tsit5(), manifold, **kwargs)


def run(manifold, y0=OMEGA0, **kwargs):
    return solve(rigid_body, wrap(manifold, **kwargs), y0)


NO_TOLERANCES = (-1.0, ValueError), (np.nan, ValueError), ("a", TypeError), (True, TypeError)
NO_COUNTS = (0, ValueError), (1.5, TypeError), ("2", TypeError), (True, TypeError)


def test_bare_function():
    with pytest.raises(TypeError, match=r"manifold.*FirstIntegral\(fn\)"):
        wrap(rotational_energy)
    with pytest.raises(TypeError, match=r"manifold\['energy'\]"):
        wrap({"energy": rotational_energy})


def test_not_callable():
    with pytest.raises(TypeError, match=r"`fn` of a `FirstIntegral` is 3, .*`fn\(t, y, args\)`"):
        dfc.FirstIntegral(3)
    with pytest.raises(TypeError, match=r"`fn` of a `Constraint` is 'sphere'"):
        dfc.Constraint("sphere")


def test_functions_of_other_parameters():
    with pytest.raises(TypeError, match=r"parameters `\(y\)`.*`fn\(t, y, args\)`"):
        dfc.FirstIntegral(lambda y: y[0])
    with pytest.raises(TypeError, match=r"parameters `\(t, y\)`.*`rate\(t, y, args\)`"):
        dfc.FirstIntegral(rotational_energy, rate=lambda t, y: y[0])
    with pytest.raises(TypeError, match=r"`fn\(t, y, args, values\)`"):
        dfc.ClosedForm(lambda t, y, args: y)
    dfc.FirstIntegral(max)  # has no signature
    dfc.FirstIntegral(jax.jit(rotational_energy))
    dfc.Constraint(lambda *args, scale=1.0: scale * args[1][0])


@pytest.mark.parametrize("empty", [(), [], {}, None])
def test_empty_manifold(empty):
    with pytest.raises(ValueError, match=r"nothing to conserve"):
        wrap(empty)


def test_integral_that_returns_nothing():
    with pytest.raises(ValueError, match="no array"):
        run(dfc.FirstIntegral(lambda t, y, args: ()))


@pytest.mark.parametrize(
    "fn",
    [
        lambda t, y, args: jnp.round(y[0]).astype(int),
        lambda t, y, args: y[0] > 0,
        lambda t, y, args: y[0] + 1j,
        lambda t, y, args: "energy",
        lambda t, y, args: 3,
    ],
    ids=["integer", "boolean", "complex", "string", "python int"],
)
def test_integral_of_wrong_type(fn):
    with pytest.raises(TypeError, match=r"`fn` of `manifold\[1\]` must return.*floating-point"):
        run((RIGID_BODY["energy"], dfc.FirstIntegral(fn)))


def test_more_constraints_than_unknowns():
    with pytest.raises(ValueError, match=r"4 scalar constraints.*3 unknowns"):
        run(dfc.FirstIntegral(lambda t, y, args: jnp.concatenate([y, y[:1]])))


def test_metric_of_wrong_structure():
    with pytest.raises(ValueError, match=r"`metric` has the structure"):
        run(RIGID_BODY, projection=dfc.SimplifiedNewton(metric=(1.0, 1.0)))
    with pytest.raises(ValueError, match=r"`metric` has a leaf of shape \(2,\)"):
        run(RIGID_BODY, projection=dfc.SimplifiedNewton(metric=jnp.ones(2)))


@pytest.mark.parametrize("weight", [0.0, -1.0, np.nan])
@pytest.mark.parametrize("kind", [dfc.SimplifiedNewton, dfc.Newton])
def test_metric_that_is_not_positive(kind, weight):
    with pytest.raises(ValueError, match="`metric` has a weight that is not positive"):
        kind(metric=jnp.array([1.0, weight, 1.0]))


def test_solver_that_is_none():
    with pytest.raises(TypeError, match="not a diffrax solver"):
        dfc.ManifoldProjection(rigid_body, RIGID_BODY)
    with pytest.raises(TypeError, match=r"Pass an instance"):
        dfc.ManifoldProjection(dfx.Tsit5, RIGID_BODY)


def test_projection_that_is_none():
    with pytest.raises(TypeError, match="which is not a projection"):
        wrap(RIGID_BODY, projection=dfc.SimplifiedNewton)


def test_value_of_wrong_structure():
    with pytest.raises(ValueError, match="not that of `manifold`"):
        dfc.project(RIGID_BODY, OMEGA0, value=(1.0, 2.0))


@pytest.mark.parametrize("value", [(1.0, 2.0), jnp.ones(1), {"energy": 1.0}])
def test_conserved_value_of_wrong_structure(value):
    with pytest.raises(ValueError, match=r"conserved value of `manifold` has the structure"):
        run(dfc.FirstIntegral(rotational_energy, value=value))


def test_integer_state():
    with pytest.raises(TypeError, match="floating-point states, real or complex"):
        dfc.project(dfc.Constraint(lambda t, y, args: 1.0 * y), jnp.array(1))


def test_project_without_a_value():
    with pytest.raises(ValueError, match=r"Pass `value="):
        dfc.project(RIGID_BODY, OMEGA0)


def test_nested_implicit_solver_without_tolerances():
    with pytest.raises(ValueError, match="VeryChord"):
        dfc.ManifoldProjection(dfx.HalfSolver(dfx.Kvaerno3()), RIGID_BODY)


def test_the_names_of_entries():
    manifold = {"b": dfc.Constraint(jnp.sum), "a": (dfc.Constraint(jnp.sum),)}
    assert dfc.entry_name(manifold, 0) == "manifold['a'][0]"
    assert dfc.entry_name(manifold, 1) == "manifold['b']"
    with pytest.raises(ValueError, match="entries 0 to 1"):
        dfc.entry_name(manifold, 2)


def test_drift_of_one_saved_state():
    sol = run(RIGID_BODY)
    with pytest.raises(ValueError, match=r"SaveAt\(t0=True, t1=True\)"):
        dfc.drift(sol, RIGID_BODY)
    value = dfc.FirstIntegral(rotational_energy, value=jnp.array(0.15))
    assert float(dfc.drift(sol, value)[0]) == pytest.approx(0.15 / (0.15 + 0.6), rel=1e-3)


def test_drift_of_nothing():
    sol = run(RIGID_BODY)
    batch = dfx.Solution(**{**vars(sol), "ts": jnp.zeros((2, 3)), "ys": jnp.zeros((2, 3, 3))})
    with pytest.raises(ValueError, match="saved states"):
        dfc.drift(solve(rigid_body, dfx.Tsit5(), OMEGA0, saveat=dfx.SaveAt(dense=True)), RIGID_BODY)
    with pytest.raises(ValueError, match=r"jax\.vmap"):
        dfc.drift(batch, RIGID_BODY)


ENERGY = dfc.FirstIntegral(rotational_energy)
NEWTONS = dfc.SimplifiedNewton, dfc.Newton, dfc.Directional


@pytest.mark.parametrize(
    ("make", "name", "wrong", "error"),
    [
        *((kind, "rtol", wrong, error) for kind in NEWTONS for wrong, error in NO_TOLERANCES),
        *((kind, "max_steps", wrong, error) for kind in NEWTONS for wrong, error in NO_COUNTS),
        *((kind, "lower", "a", TypeError) for kind in NEWTONS[:2]),
        (dfc.SimplifiedNewton, "atol", -1.0, ValueError),
        (dfc.SimplifiedNewton, "upper", {"q": np.nan}, ValueError),
        (dfc.SimplifiedNewton, "metric", "mass", TypeError),
        (ft.partial(dfc.ClosedForm, print), "rtol", "a", TypeError),
        *((ft.partial(wrap, ENERGY), "every", wrong, error) for wrong, error in NO_COUNTS),
        (ft.partial(wrap, ENERGY), "max_correction", 0.0, ValueError),
        (ft.partial(wrap, ENERGY), "max_correction", "x", TypeError),
        (ft.partial(wrap, ENERGY), "max_correction", np.nan, ValueError),
        (ft.partial(dfc.FirstIntegral, jnp.sum), "value", "a", TypeError),
        (ft.partial(dfc.FirstIntegral, jnp.sum), "value", [1.0, 1j], TypeError),
        (ft.partial(dfc.project, ENERGY, OMEGA0), "value", "a", TypeError),
        (ft.partial(dfc.project, ENERGY, value=1.0), "y", "y", TypeError),
        (ft.partial(dfc.project, ENERGY, OMEGA0), "projection", dfc.Newton, TypeError),
        (ft.partial(dfc.tangent, rigid_body, ENERGY), "gain", "a", TypeError),
        (ft.partial(dfc.tangent, rigid_body, ENERGY), "gain", None, TypeError),
        (ft.partial(dfc.tangent, rigid_body, ENERGY), "gain", np.nan, ValueError),
        (dfc.Constraint(jnp.sum).derivative, "vector_field", 3, TypeError),
        (dfc.Constraint(jnp.sum).derivative, "vector_field", dfx.ODETerm(rigid_body), TypeError),
        (ft.partial(dfc.drift, manifold=ENERGY), "sol", OMEGA0, TypeError),
        (dfc.statistics, "sol", [1], TypeError),
    ],
)
def test_an_argument_that_is_wrong_by_itself(make, name, wrong, error):
    says = "The state has the leaf 'y'" if name == "y" else rf"`{name}(\[.*\])?` (is|has) "
    with pytest.raises(error, match=says):
        make(**{name: wrong})


def test_options_that_are_right():
    kinds = None, 0, 1e-3, np.float32(0.5), np.int64(1), jnp.asarray(0.5, jnp.bfloat16)
    for rtol in kinds:
        dfc.Newton(rtol=rtol, atol=rtol)
    jax.eval_shape(lambda x: dfc.Newton(rtol=x, lower=x).rtol, -1.0)


def test_a_metric_is_no_matrix():
    with pytest.raises(ValueError, match="not a matrix"):
        dfc.Newton(metric=jnp.eye(2))


def test_a_rate_is_real():
    gain = dfc.FirstIntegral(rotational_energy, value=1.0, rate=lambda t, y, args: 1j * y[0])
    with pytest.raises(TypeError, match="`rate` of `manifold` returns complex128"):
        dfc.project(gain, OMEGA0)


def saved(saveat, convert=lambda sol: sol):
    """The drift of a solve that is traced only."""
    sol = ft.partial(solve, rigid_body, wrap(ENERGY), OMEGA0, saveat=saveat)
    return jax.eval_shape(lambda: dfc.drift(convert(sol()), ENERGY))


def test_drift_of_several_saved_paths():
    saveat = dfx.SaveAt(subs=[dfx.SubSaveAt(ts=[0.0, 1.0]), dfx.SubSaveAt(t1=True)])
    with pytest.raises(ValueError, match=r"`SaveAt\(subs=...\)`.*dataclasses.replace"):
        saved(saveat)
    one = saved(saveat, lambda s: dataclasses.replace(s, ts=s.ts[0], ys=s.ys[0]))
    assert one.shape == (2,)


def test_drift_of_what_is_no_state():
    saveat = dfx.SaveAt(ts=[0.0, 1.0], fn=lambda t, y, args: y[:2], dense=True)
    with pytest.raises(ValueError, match=r"saved \(2,\) at each time, but the states are \(3,\)"):
        saved(saveat)
