"""Small problems that several test files share, written out here independently of the catalogue."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc


class Counted:
    """A function that counts its calls: inside of what is compiled, how often it is traced."""

    def __init__(self, fn):
        self.fn, self.calls = fn, 0

    def __call__(self, t, y, args):
        self.calls += 1
        return self.fn(t, y, args)


EPS = np.finfo(np.float64).eps
INERTIA = np.array([0.1, 0.2, 0.3])


def rigid_body(t, w, args):
    """Free rotation: `I ω' = (I ω) × ω`."""
    del t, args
    inertia = jnp.asarray(INERTIA, w.dtype)
    return jnp.cross(inertia * w, w) / inertia


def rotational_energy(t, w, args):
    del t, args
    return jnp.sum(jnp.asarray(INERTIA, w.dtype) * w**2) / 2


def squared_momentum(t, w, args):
    del t, args
    return jnp.sum((jnp.asarray(INERTIA, w.dtype) * w) ** 2)


RIGID_BODY = {
    "energy": dfc.FirstIntegral(rotational_energy),
    "momentum": dfc.FirstIntegral(squared_momentum),
}
OMEGA0 = jnp.ones(3)


def kepler(t, y, args):
    del t, args
    q, p = y
    return p, -q / jnp.sum(q**2) ** 1.5


def kepler_energy(t, y, args):
    del t, args
    q, p = y
    return jnp.sum(p**2) / 2 - 1 / jnp.sqrt(jnp.sum(q**2))


def kepler_momentum(t, y, args):
    del t, args
    q, p = y
    return q[0] * p[1] - q[1] * p[0]


KEPLER0 = (jnp.array([0.4, 0.0]), jnp.array([0.0, 2.0]))
KEPLER = {
    "energy": dfc.FirstIntegral(kepler_energy),
    "momentum": dfc.FirstIntegral(kepler_momentum),
}


def oscillator(t, y, args):
    del t, args
    return jnp.stack([y[1], -y[0]])


def exponential(t, y, args):
    """`u' = -e^v`, `v' = e^u`, which keeps `e^u + e^v`."""
    del t, args
    u, v = y
    return jnp.stack([-jnp.exp(v), jnp.exp(u)])


EXPONENTIAL = dfc.FirstIntegral(lambda t, y, args: jnp.sum(jnp.exp(y)))
EXPONENTIAL0 = jnp.array([1.0, 0.5])


def exponential_solution(t):
    """Separates in `s = e^u`: with `c = e^u + e^v`, `s' = -s (c - s)`, a logistic equation."""
    c = jnp.sum(jnp.exp(EXPONENTIAL0))
    ratio = jnp.exp(EXPONENTIAL0[0]) / (c - jnp.exp(EXPONENTIAL0[0])) * jnp.exp(-c * t)
    s = c * ratio / (1 + ratio)
    return jnp.stack([jnp.log(s), jnp.log(c - s)])


def solve(vector_field, solver, y0, *, t0=0.0, t1=1.0, dt0=0.1, args=None, **kwargs):
    """Compiled once for all times, which have the precision of the state."""
    dtype = jnp.finfo(jnp.result_type(*jax.tree.leaves(y0))).dtype
    times = [None if t is None else jnp.asarray(t, dtype) for t in (t0, t1, dt0)]
    return _solve(vector_field, solver, *times, y0, args, kwargs)


@eqx.filter_jit
def _solve(vector_field, solver, t0, t1, dt0, y0, args, kwargs):
    """All in one program: outside of one, diffrax compiles each of some forty operations."""
    terms = dfx.ODETerm(vector_field) if callable(vector_field) else vector_field
    return dfx.diffeqsolve(terms, solver, t0, t1, dt0, y0, args, **kwargs)


# Of solves by which nothing is differentiated in reverse: a failure is a result.
TO_THE_END = dict(max_steps=None, throw=False, adjoint=dfx.ForwardMode())


@eqx.filter_jit
def drift_of(sol, manifold, args=None):
    """`dfc.drift` in one program; NaN if the solve failed, of which here the times are NaN too."""
    failed = jnp.any(jnp.isnan(sol.ts))
    return jax.tree.map(lambda x: jnp.where(failed, jnp.nan, x), dfc.drift(sol, manifold, args))


@eqx.filter_jit
def evaluated(sol, ts):
    """The dense output at several times, in one program."""
    return jax.vmap(sol.evaluate)(ts)


def refused(*cases):
    """The test that each `(make, error, match)`, or `(make, match)`, is refused with a message."""
    cases = [(make, error or (TypeError, ValueError), match) for make, *error, match in cases]

    @pytest.mark.parametrize(("make", "error", "match"), cases)
    def test_mistakes_are_named(make, error, match):
        with pytest.raises(tuple(error), match=match):
            make()

    return test_mistakes_are_named


def largest(tree):
    """The largest absolute value in a PyTree, or NaN if any is NaN."""
    return float(np.max([np.max(np.abs(x)) for x in jax.tree.leaves(tree)]))


def printed(record):
    """What `print` shows, without the widths of its columns."""
    return " ".join(str(record).split())


def final(sol):
    return jax.tree.map(lambda y: y[-1], sol.ys)


def difference(a, b):
    """The largest one between two PyTrees, or NaN if any is NaN."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return largest([np.subtract(x, y) for x, y in pairs])


def assert_lanes(run, lanes, tolerance):
    """That each lane of a batch is that lane alone."""
    together = jax.vmap(run)(lanes)
    for i, lane in enumerate(lanes):
        assert difference(jax.tree.map(lambda y, i=i: y[i], together), run(lane)) <= tolerance
