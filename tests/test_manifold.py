"""Wrong input is refused with an error that names the argument and the remedy."""

import dataclasses
import functools as ft

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc

from .problems import (
    OMEGA0,
    RIGID_BODY,
    drift_of,
    largest,
    refused,
    rigid_body,
    rotational_energy,
    solve,
)

FirstIntegral, Constraint, Simplified = dfc.FirstIntegral, dfc.Constraint, dfc.SimplifiedNewton
ENERGY = FirstIntegral(rotational_energy)
SPHERE = Constraint(lambda t, y, args: jnp.sum(y**2) - 1)
GAIN = FirstIntegral(rotational_energy, value=1.0, rate=lambda t, y, args: 1j * y[0])
NOT_EXPLICIT = dfx.Euler(), dfx.Kvaerno5(), dfx.Kvaerno5().tableau, "Tsit5"
IMPLICIT = dfx.HalfSolver(dfx.Kvaerno3())


def wrap(manifold, **kwargs):
    return dfc.ManifoldProjection(dfx.Tsit5(), manifold, **kwargs)


def run(manifold, y0=OMEGA0, **kwargs):
    return solve(rigid_body, wrap(manifold, **kwargs), y0)


def newton(**options):
    return run(SPHERE, projection=Simplified(**options))


def drift(saveat, convert=lambda sol: sol, manifold=ENERGY):
    """Of a solve that is traced only."""
    sol = ft.partial(solve, rigid_body, wrap(ENERGY), OMEGA0, saveat=saveat)
    return jax.eval_shape(lambda: dfc.drift(convert(sol()), manifold))


def resumed(init):
    """A solve that is traced only, with the state that `init` makes."""
    state = lambda: init(dfx.ODETerm(rigid_body), 0.0, 1.0, OMEGA0, None)  # noqa: E731
    return jax.eval_shape(lambda: solve(rigid_body, wrap(ENERGY), OMEGA0, solver_state=state()))


def batch(sol):
    return dataclasses.replace(sol, ts=jnp.zeros((2, 3)), ys=jnp.zeros((2, 3, 3)))


def looped(t, y, args):
    return jax.lax.while_loop(lambda x: x[0] < 3, lambda x: (x[0] + 1, x[1] * y[0]), (0, y[1]))[1]


NOT_TRACEABLE = (
    (looped, ValueError),
    (lambda t, y, args: y[0] if y[1] > 0 else y[2], jax.errors.TracerBoolConversionError),
    (lambda t, y, args: jnp.asarray(float(y[0])), jax.errors.ConcretizationTypeError),
    (lambda t, y, args: jnp.asarray(np.sin(y[0])), jax.errors.TracerArrayConversionError),
)


def check(field=rigid_body, integral=ENERGY, states=OMEGA0[None]):
    return dfc.check_invariance(field, {"a": integral}, states)


IN_A_SOLVE = lambda integral: run({"a": integral})  # noqa: E731
TO_UNIT = lambda integral: dfc.project({"a": integral}, OMEGA0, value={"a": 1.0})  # noqa: E731
NEEDS_ARGS = lambda t, y, args: args["scale"] * y[0]  # noqa: E731
A_CALLED = r"`fn` of `manifold\['a'\]` was called as `fn\(t, y, args\)`, here with t = .*, y = f64"
SUBS = dfx.SaveAt(subs=[dfx.SubSaveAt(ts=[0.0, 1.0]), dfx.SubSaveAt(t1=True)])
STEPS = dfx.SaveAt(steps=True)
PARTS = dfx.SaveAt(ts=[0.0, 1.0], fn=lambda t, y, args: y[:2], dense=True)
test_mistakes_are_named = refused(
    (lambda: wrap(rotational_energy), TypeError, r"manifold.*FirstIntegral\(fn\)"),
    (lambda: wrap({"energy": rotational_energy}), TypeError, r"manifold\['energy'\]"),
    (
        lambda: FirstIntegral(3),
        TypeError,
        r"`fn` of a `FirstIntegral` is of type `int`, .*`fn\(t, y, args\)`",
    ),
    (lambda: Constraint("sphere"), TypeError, r"`fn` of a `Constraint` is of type `str`"),
    (lambda: FirstIntegral(lambda y: y[0]), TypeError, r"parameters `\(y\)`.*`fn\(t, y, args\)`"),
    (lambda: FirstIntegral(jnp.sum, rate=lambda t, y: y), TypeError, r"`\(t, y\)`.*`rate\(t, y, a"),
    (lambda: FirstIntegral(jnp.sum, rate=3), TypeError, "rate"),
    (
        lambda: FirstIntegral(lambda y, t, args: y[0]),
        TypeError,
        r"`\(y, t, args\)`, in another ord",
    ),
    (lambda: check(field=lambda x, t, args: x), TypeError, r"`\(x, t, args\)`, in another order"),
    (lambda: check(field=NEEDS_ARGS), TypeError, r"`vector_field` was called .*need `args`"),
    (lambda: check(states=lambda: OMEGA0), TypeError, r"`states` has .* `states\(key\)`"),
    *(
        (lambda f=f: f(integral=FirstIntegral(NEEDS_ARGS)), TypeError, A_CALLED + ".*need `args`")
        for f in (check, IN_A_SOLVE)
    ),
    *(
        (lambda f=f, fn=fn: f(integral=FirstIntegral(fn)), error, f"{A_CALLED}.*`jnp.where`")
        for fn, error in NOT_TRACEABLE
        for f in (check, IN_A_SOLVE, TO_UNIT)
    ),
    (lambda: dfc.systems.hamiltonian_vector_field(ENERGY), TypeError, "is of type `FirstIntegral`"),
    (lambda: dfc.ClosedForm(lambda t, y, args: y), TypeError, r"`fn\(t, y, args, values\)`"),
    *((lambda x=x: wrap(x), ValueError, "nothing to conserve") for x in ((), [], {}, None)),
    (lambda: run(FirstIntegral(lambda t, y, args: ())), ValueError, "no array"),
    (lambda: run(SPHERE, projection=Simplified), TypeError, "which is not a projection"),
    (lambda: dfc.ManifoldProjection(rigid_body, ENERGY), TypeError, "not a diffrax solver"),
    (lambda: dfc.ManifoldProjection(dfx.Tsit5, ENERGY), TypeError, "Pass an instance"),
    (lambda: dfc.ManifoldProjection(IMPLICIT, ENERGY), ValueError, "VeryChord"),
    (lambda: dfc.project(RIGID_BODY, OMEGA0, value=(1.0, 2.0)), ValueError, "not that of `manifo"),
    (lambda: dfc.project(RIGID_BODY, OMEGA0), ValueError, "Pass `value="),
    (lambda: dfc.project(SPHERE, OMEGA0, value=2.0), ValueError, "`manifold`, which is a `Constr"),
    (lambda: dfc.project(Constraint(lambda t, y, args: 1.0 * y), jnp.array(1)), TypeError, "float"),
    (lambda: dfc.project(GAIN, OMEGA0), TypeError, "`rate` of `manifold` returns complex128"),
    *(
        (
            lambda x=x: run(dataclasses.replace(ENERGY, value=x)),
            ValueError,
            "conserved value of `manifold` has the structure",
        )
        for x in ((1.0, 2.0), jnp.ones(1), {"energy": 1.0})
    ),
    *(
        (lambda x=x: run((ENERGY, FirstIntegral(lambda *_: x))), TypeError, r"1\]` must.*floating")
        for x in (1, True, 1j, "energy", np.ones(2, int))
    ),
    (
        lambda: resumed(lambda *_: ()),
        ValueError,
        "`solver_state` is not the state of a solve by this",
    ),
    (
        lambda: resumed(wrap([ENERGY]).init),
        ValueError,
        r"entries manifold\[0\], not manifold\. Pass",
    ),
    (lambda: drift(dfx.SaveAt(t1=True)), ValueError, r"SaveAt\(t0=True, t1=True\)"),
    (lambda: drift(dfx.SaveAt(dense=True)), ValueError, "saved states"),
    (lambda: drift(dfx.SaveAt(ts=[0.0, 1.0]), batch), ValueError, r"equinox\.filter_vmap"),
    (lambda: drift(STEPS, manifold=FirstIntegral(NEEDS_ARGS)), ValueError, "`args` of the solve"),
    (lambda: drift(SUBS), ValueError, r"`SaveAt\(subs=...\)`.*dataclasses.replace"),
    (lambda: drift(PARTS), ValueError, r"saved \(2,\) at each time, but the states are \(3,\)"),
    (lambda: Simplified(lower=1.0, upper=0.0), ValueError, "`lower` is 1"),
    (lambda: newton(lower=(0.0,)), ValueError, "`lower` has the struc"),
    (lambda: newton(upper=jnp.ones(2)), ValueError, "`upper` has a le"),
    (lambda: newton(metric=(1.0,)), ValueError, "`metric` has the stru"),
    (lambda: newton(metric=jnp.ones(2)), ValueError, r"of shape \(2,\)"),
    *((lambda x=x: dfc.Unrolled(x), TypeError, "explicit Runge-Kutta") for x in NOT_EXPLICIT),
    *(
        (lambda x=x: dfc.Newton(metric=jnp.array([1.0, x])), ValueError, "weight that is not posit")
        for x in (0.0, -1.0, np.nan)
    ),
)


NO_TOLERANCES = (-1.0, ValueError), (np.nan, ValueError), ("a", TypeError), (True, TypeError)
NO_COUNTS = (0, ValueError), (1.5, TypeError), ("2", TypeError), (True, TypeError)
NEWTONS = Simplified, dfc.Newton, ft.partial(dfc.AlongLine, direction="step")
WRAP, TANGENT = ft.partial(wrap, ENERGY), ft.partial(dfc.tangent, rigid_body, ENERGY)


@pytest.mark.parametrize(
    ("make", "name", "wrong", "error"),
    [
        *((kind, "rtol", wrong, error) for kind in NEWTONS for wrong, error in NO_TOLERANCES),
        *((kind, "max_steps", wrong, error) for kind in NEWTONS for wrong, error in NO_COUNTS),
        (dfc.Newton, "lower", "a", TypeError),
        (dfc.AlongLine, "direction", "estimate", ValueError),
        (Simplified, "atol", -1.0, ValueError),
        (Simplified, "upper", {"q": np.nan}, ValueError),
        (Simplified, "metric", "mass", TypeError),
        (ft.partial(dfc.ClosedForm, print), "rtol", "a", TypeError),
        (WRAP, "max_correction", 0.0, ValueError),
        (WRAP, "max_correction", "x", TypeError),
        (ft.partial(FirstIntegral, jnp.sum), "value", [1.0, 1j], TypeError),
        (ft.partial(dfc.project, ENERGY, OMEGA0), "value", "a", TypeError),
        (ft.partial(dfc.project, ENERGY, value=1.0), "y", "y", TypeError),
        (ft.partial(dfc.project, ENERGY, OMEGA0), "projection", dfc.Newton, TypeError),
        (TANGENT, "gain", None, TypeError),
        (TANGENT, "gain", np.nan, ValueError),
        (Constraint(jnp.sum).derivative, "vector_field", dfx.ODETerm(rigid_body), TypeError),
        (ft.partial(dfc.drift, manifold=ENERGY), "sol", OMEGA0, TypeError),
        (dfc.statistics, "sol", [1], TypeError),
    ],
)
def test_an_argument_that_is_wrong_by_itself(make, name, wrong, error):
    says = "The state has the leaf 'y'" if name == "y" else rf"`{name}(\[.*\])?` (is|has) "
    with pytest.raises(error, match=says):
        make(**{name: wrong})


def test_what_is_right():
    for rtol in (None, 0, 1e-3, np.float32(0.5), np.int64(1), jnp.asarray(0.5, jnp.bfloat16)):
        dfc.Newton(rtol=rtol, atol=rtol)
    jax.eval_shape(lambda x: dfc.Newton(rtol=x, lower=x).rtol, -1.0)
    FirstIntegral(max)  # has no signature
    FirstIntegral(jax.jit(rotational_energy))
    Constraint(lambda *args, scale=1.0: scale * args[1][0])
    one = drift(SUBS, lambda s: dataclasses.replace(s, ts=s.ts[0], ys=s.ys[0]))
    assert one.shape == (2,)
    value = FirstIntegral(rotational_energy, value=jnp.array(0.15))
    found = drift_of(run(RIGID_BODY), value)
    assert float(found[0]) == pytest.approx(0.15 / (0.15 + 0.6), rel=1e-3)


def test_the_components_of_a_vector_have_one_scale():
    """The first component of this angular momentum is zero at the start, so that a scale of its own
    would be zero, and its drift a number of square kilometres per second."""
    momentum = dfc.FirstIntegral(lambda t, y, args: jnp.cross(*y))
    y0 = jnp.array([7000.0, 0.0, 0.0]), jnp.array([0.0, 6.2, 5.0])
    field = lambda t, y, args: (y[1], -398600.4418 * y[0] / jnp.sum(y[0] ** 2) ** 1.5)  # noqa: E731
    solver = dfc.ManifoldProjection(dfc.RK4(), momentum)
    saveat = dfx.SaveAt(t0=True, steps=True)
    sol = solve(field, solver, y0, t1=6000.0, dt0=20.0, saveat=saveat, max_steps=302)
    assert largest(drift_of(sol, momentum)) < 16 * np.finfo(float).eps


def test_unlike_values_in_one_array_have_scales_of_their_own():
    values = {
        "energy": rotational_energy,
        "fast": lambda t, y, args: 1e6 * rotational_energy(t, y, args) ** 3,
    }
    apart = {name: FirstIntegral(fn) for name, fn in values.items()}
    array = FirstIntegral(lambda t, y, args: jnp.stack([fn(t, y, args) for fn in values.values()]))
    saveat = dfx.SaveAt(t0=True, steps=True)
    sol = solve(rigid_body, dfx.Heun(), OMEGA0, t1=5.0, dt0=0.1, saveat=saveat, max_steps=64)
    expected = jnp.stack(list(drift_of(sol, apart).values()), axis=1)
    assert largest(expected) > 1e-6
    np.testing.assert_allclose(drift_of(sol, array), expected, rtol=1e-9, atol=1e-15)
