"""Networks: exact at the start for every PyTree, what they compute, and in which precision."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct
from diffrax_conserve._fast.jaxprs import jaxprs_inside

from ..learned import CORES, EAST, LORENZ, SMALL, Still, flow_map, in_single, solution, states
from ..problems import oscillator, refused, solve
from ..thinned import some_of

KEY = jr.key(0)
MIXED = {
    "position": jnp.array([[1.0, 2.0], [3.0, -4.0]]),
    "rest": (jnp.array(0.5), [jnp.array([7.0], jnp.float32)]),
}


def stacked(state, count=5):
    return jax.tree.map(
        lambda x: x[None] + jnp.arange(count, dtype=x.dtype).reshape(-1, *[1] * x.ndim), state
    )


def same_kind(a, b):
    return jax.tree.structure(a) == jax.tree.structure(b) and all(
        x.shape == y.shape and x.dtype == y.dtype
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )


@eqx.filter_jit
def advance(network, y0, h):
    return network(y0, h)


def test_any_pytree_of_arrays_is_a_state():
    pinn = dfc.PINN(MIXED, 1.0, 3.0, key=jr.key(0), **SMALL)
    at = eqx.filter_jit(lambda pinn, t: pinn(t))
    assert same_kind(at(pinn, jnp.array(2.0)), MIXED)
    assert eqx.tree_equal(at(pinn, jnp.array(1.0)), MIXED)
    net = dfc.DeepONet(stacked(MIXED), 0.5, key=jr.key(0), **SMALL)
    assert same_kind(advance(net, MIXED, jnp.array(0.2)), MIXED)
    assert eqx.tree_equal(advance(net, MIXED, jnp.array(0.0)), MIXED)


def test_the_ansatz_of_the_pinn():
    pinn = solution(t1=4.0)
    largest = jnp.max(jnp.abs(LORENZ.y0))
    expected = LORENZ.y0 + 3 / 4 * largest * pinn.window(0).net(jnp.array([2 * 3 / 4 - 1]))
    np.testing.assert_allclose(pinn(3.0), expected, rtol=1e-15)


def test_the_ansatz_of_the_deeponet():
    net, y0, h = flow_map(core="product"), LORENZ.y0, 0.2
    mean, deviation = jnp.mean(states(), axis=0), jnp.std(states(), axis=0)
    b = net.core.branch((y0 - mean) / deviation).reshape(3, 4)
    tau = net.core.trunk(jnp.array([2 * h / 0.25 - 1])).reshape(3, 4)
    expected = y0 + h / 0.25 * deviation * jnp.einsum("jl,jl->j", b, tau) / 2
    np.testing.assert_allclose(net(y0, h), expected, rtol=1e-14)


test_mistakes_are_named = refused(
    (lambda: solution(width=0), ValueError, "`width`"),
    (lambda: solution(depth=-1), ValueError, "`depth`"),
    (lambda: solution(activation="tan"), ValueError, "`activation`"),
    (lambda: solution(windows=0), ValueError, "`windows` is 0, but it must be"),
    (lambda: solution(slope=-1.0), ValueError, "`slope` is -1.0, but it must be positive"),
    (lambda: solution(t1=0.0), ValueError, "`t0` must be less than `t1`"),
    (lambda: solution(t1=jnp.inf), ValueError, "they are 0.0 and inf"),
    (lambda: flow_map(max_step=0.0), ValueError, "`max_step` is 0.0, but it must be positive"),
    (lambda: flow_map(max_step=jnp.inf), ValueError, "`max_step` is infinite"),
    (lambda: flow_map(taylor=2), TypeError, "`taylor` is of type `int`, but it must be a `Taylor`"),
    (lambda: flow_map(layer=2), TypeError, "must be a `ConservativeLayer`"),
    (lambda: solution(layer=2), TypeError, "must be a `ConservativeLayer`"),
    (lambda: dfc.learned.Box(2.0, 1.0), ValueError, "must be at most `upper`"),
    (lambda: dfc.DeepONet(jnp.array([[jnp.nan]]), 1.0, key=KEY), ValueError, "not finite"),
    (lambda: flow_map(core="mlp"), ValueError, "`core` is 'mlp', but it must be one of 'gated"),
    (lambda: flow_map()(jnp.ones(4), 0.1), ValueError, "of 3 numbers, not 4"),
    (lambda: dfc.DeepONet((EAST, LORENZ.y0), 1.0, key=KEY), ValueError, "leading axis"),
    (lambda: dfc.DeepONet(LORENZ.sample, 1.0, key=KEY), TypeError, "Draw states from it"),
    (lambda: dfc.PINN(jnp.array([1j]), 0.0, 1.0, key=KEY), TypeError, "complex"),
    (lambda: dfc.learned.Taylor(LORENZ.vector_field, 0), ValueError, "`order` .*must be a pos"),
)


# ---- The parts of a flow map beyond branch times trunk, and the windows of a PINN ----


KINDS = pytest.mark.parametrize("core", CORES)


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_the_polynomial_of_a_linear_system(order):
    matrix = jr.normal(jr.key(0), (3, 3))
    taylor = dfc.learned.Taylor(lambda t, y, args: args * (matrix @ y), order, args=2.0)
    y0, h = jnp.array([1.0, -2.0, 0.5]), 0.3
    expected, term = np.asarray(y0), np.asarray(y0)
    for j in range(1, order + 1):
        term = 2 * h / j * (np.asarray(matrix) @ term)
        expected = expected + term
    np.testing.assert_allclose(eqx.filter_jit(taylor)(y0, h), expected, rtol=1e-14)


@some_of("order", [0, 1, 2, 3], period=4)
@KINDS
def test_untrained_it_has_the_order_of_its_polynomial(core, order):
    taylor = dfc.learned.Taylor(LORENZ.vector_field, order) if order else None
    network = flow_map(core=core, taylor=taylor)
    assert network.order == order
    steps = 0.02 / 2.0 ** np.arange(3)
    exact = LORENZ.reference(jnp.asarray(steps[::-1]))[::-1]
    ends = jax.jit(jax.vmap(network, (None, 0)))(LORENZ.y0, steps)
    slopes = np.diff(np.log2(np.linalg.norm(ends - exact, axis=1)))
    np.testing.assert_allclose(slopes, -(order + 1), rtol=0, atol=0.15)


@pytest.mark.slow
def test_a_solve_across_windows():
    pinn = dfc.PINN(EAST, 0.0, 4.0, windows=2, width=8, depth=1, slope=2.0, key=jr.key(0))
    end = pinn.window(0)(2.0)
    pinn = eqx.tree_at(lambda p: p.y0s, pinn, jnp.stack([EAST, end]))
    ts = jnp.linspace(0, 4, 9)
    options = dict(t1=4.0, dt0=0.4, saveat=dfx.SaveAt(ts=ts))
    ys = solve(oscillator, dfc.PINNSolver(pinn), EAST, **options).ys
    np.testing.assert_allclose(ys, jax.jit(jax.vmap(pinn))(ts), rtol=0, atol=1e-7)


@pytest.mark.parametrize("exponent", [0.0, 0.1, 0.125, 0.25, 0.3, 1.0])
def test_box_cox_is_a_power_and_has_an_inverse(exponent):
    y = jnp.logspace(-12, 1, 40)
    boxcox = dfc.learned.BoxCox(exponent)
    expected = (y**exponent - 1) / exponent if exponent else jnp.log(y)
    np.testing.assert_allclose(boxcox(y), expected, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(boxcox.inverse(boxcox(y)), y, rtol=1e-10, atol=1e-15)
    assert jnp.all(boxcox.inverse(-20.0 * jnp.ones(2)) >= 0)


# ---- A network evaluated in float32 inside a flow map in float64 ----


EPS32 = float(np.finfo(np.float32).eps)


def both(core):
    """A network and the same in single precision."""
    network = flow_map(core=core, taylor=dfc.learned.Taylor(LORENZ.vector_field, 1))
    return network, in_single(network)


def products(jaxpr):
    """The dtypes of the factors of all products of matrices."""
    found = set()
    for eqn in jaxpr.eqns:
        if eqn.primitive.name == "dot_general":
            found |= {v.aval.dtype.name for v in eqn.invars}
        for inner in jaxprs_inside(eqn):
            found |= products(inner.jaxpr)
    return found


@some_of("core", CORES, period=3)
def test_only_the_network_is_rounded(core):
    network, single = both(core)
    y0s, h = states(20), 0.2
    exact, rounded = (jax.jit(jax.vmap(lambda y, f=f: f(y, h)))(y0s) for f in (network, single))
    assert rounded.dtype == jnp.float64
    # The network's output is multiplied by (h / Δ)² S, and here it is of order one.
    size = (h / network.max_step) ** 2 * np.asarray(network.scale)
    error = np.abs(np.asarray(exact - rounded)) / size
    assert 0 < np.max(error) < 32 * EPS32
    assert products(jax.make_jaxpr(single)(LORENZ.y0, h).jaxpr) == {"float32"}
    np.testing.assert_array_equal(single(LORENZ.y0, 0.0), LORENZ.y0)


# ---- Flow maps of a family of equations, which take `args` as inputs ----

BOX = dfc.learned.Box(
    {"w": 0.5, "b": jnp.array([0.0, 0.1])}, {"w": 1.5, "b": jnp.array([0.2, 0.3])}
)
ARGS = {"w": jnp.array(0.8), "b": jnp.array([0.1, 0.2])}
OUTSIDE = {**ARGS, "w": jnp.array(1.6)}
STATES = jr.uniform(jr.key(0), (50, 2), minval=-1, maxval=1)
Y0 = jnp.array([0.5, -0.3])


def spring(t, y, args):
    force = -args["w"] * y[0] - args["b"][0] * y[1] - args["b"][1] * y[0] ** 3
    return jnp.stack([y[1], force])


TERM, END = dfx.ODETerm(spring), dfx.SaveAt(t1=True)


def family(order=0, args_domain=BOX, **options):
    taylor = dfc.learned.Taylor(spring, order) if order else None
    options = dict(width=16, depth=2, core="concatenated", taylor=taylor) | options
    return dfc.DeepONet(STATES, 0.5, args_domain=args_domain, key=jr.key(1), **options)


def sample(key):
    return jr.uniform(key, (2,), minval=-1, maxval=1)


def fit(**options):
    return dfc.fit(family(), spring, key=jr.key(0), **(dict(sample=sample) | options))


@eqx.filter_jit
def solved(flow_map, args, check_field=False, term=TERM, saveat=END, **options):
    solver = dfc.DeepONetSolver(flow_map, check_field=check_field, **options)
    options = dict(saveat=saveat, max_steps=8, throw=False)
    return dfx.diffeqsolve(term, solver, 0.0, 2.0, 0.5, Y0, args, **options)


@KINDS
def test_it_starts_at_its_state_and_sees_all_args(core):
    flow_map = family(core=core)

    @jax.jit
    def found(h):
        slopes = jax.jacfwd(lambda args: flow_map(Y0, args, h))(ARGS)
        return flow_map(Y0, ARGS, h), flow_map(Y0, h, args=ARGS), slopes

    np.testing.assert_array_equal(found(0.0)[0], Y0)
    one, other, slopes = found(0.3)
    np.testing.assert_array_equal(one, other)
    assert all(np.all(np.abs(leaf) > 0) for leaf in jax.tree.leaves(slopes))


def test_its_polynomial_has_the_args_of_the_call():
    slope = jax.jit(jax.jacfwd(lambda h: family(1)(Y0, ARGS, h)))(0.0)
    np.testing.assert_allclose(slope, spring(0.0, Y0, ARGS), rtol=1e-14)


def test_a_repeated_flow_map_hands_args_on():
    outer = dfc.learned.Repeated(family(), 2)
    inner, twice = eqx.filter_jit(outer.flow_map), eqx.filter_jit(outer)
    expected = inner(inner(Y0, ARGS, 0.2), ARGS, 0.2)
    np.testing.assert_allclose(twice(Y0, ARGS, 0.4), expected, rtol=1e-13)
    y = Y0
    for _ in range(4):
        y = twice(y, ARGS, 0.5)
    np.testing.assert_allclose(solved(outer, ARGS).ys[0], y, rtol=1e-12)


@pytest.mark.slow
def test_derivatives_by_args_are_those_of_differences():
    dct.assert_gradients(lambda a: solved(family(), a).ys[0], ARGS, rtol=1e-7, forward=False)


def test_draws_are_in_the_box_and_everywhere():
    drawn = jax.vmap(BOX.sample)(jr.split(jr.key(3), 1000))
    assert jnp.all(jax.vmap(BOX.contains)(drawn))
    unit = jax.vmap(BOX.centred)(drawn)
    for leaf in jax.tree.leaves(unit):
        np.testing.assert_allclose(jnp.std(leaf, axis=0), 1 / np.sqrt(3), rtol=0.1)
        np.testing.assert_allclose(jnp.mean(leaf, axis=0), 0, rtol=0, atol=0.1)


def test_args_outside_their_domain_are_steps_outside():
    state = dfx.SaveAt(t1=True, solver_state=True)
    inside, outside = (solved(family(), args, saveat=state) for args in (ARGS, OUTSIDE))
    assert dfc.learned.steps_outside(inside).number < 4
    assert dfc.learned.steps_outside(outside).number == 4


def test_the_slope_is_compared_for_the_args_of_the_solve():
    assert dfx.is_okay(solved(family(1), ARGS, check_field=True).result)
    other = dfx.ODETerm(lambda t, y, args: 1.2 * spring(t, y, args))
    found = solved(family(1), ARGS, check_field=True, term=other)
    assert "not trained for this vector field" in dfx.RESULTS[found.result]


class Unbounded(Still):
    args_domain: float = 1.0


LAYER = dfc.learned.ConservativeLayer(dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2)))
OWN_ARGS = dfc.learned.Taylor(spring, args=ARGS)


test_mistakes_with_args_are_named = refused(
    (lambda: family(args_domain=(0, 1)), "args_domain"),
    (lambda: dfc.DeepONetSolver(Unbounded()), "args_domain"),
    (lambda: family()(Y0, 0.1), r"called as `\(y0, args, h\)`"),
    (lambda: family(args_domain=None)(Y0, ARGS, 0.1), r"called as `\(y0, h\)`"),
    (lambda: family()(Y0, jnp.ones(3), 0.1), "takes `args` of the structure"),
    (lambda: solved(family(), ARGS | {"b": jnp.ones(3)}), "takes `args` of the structure"),
    (lambda: family(layer=LAYER), "cannot have a `layer`"),
    (lambda: family(taylor=OWN_ARGS), "`taylor` has `args` of its own"),
    (lambda: fit(args=ARGS), "draws them from its `args_domain`"),
)
