"""How a law is stated and run: `law(system, y, displacement) -> (applies, got, expected)`.

A law is one compiled program per system, called with drawn arrays. To compile every law for every
system takes minutes: the default run compiles each law for one small system, another one for the
next law, and the slow run all the others.
"""

import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from hypothesis import assume

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

SYSTEMS = {name: dfc.systems.get(name) for name in dfc.systems.names()}


# Quick to compile, and with more than one constraint.
SMALL = ("rigid-body", "kepler", "conservative-lorenz", "cartesian-pendulum")

# A soliton has the least energy for its mass and momentum: gradients are parallel there, and the
# derivative is NaN.
PARALLEL = "korteweg-de-vries"


def every_law_on_every_system(laws, skip=()):
    """Parametrises a test by `law` and `name`; a law does not hold for the pairs in `skip`."""
    params = []
    for i, law in enumerate(laws):
        names = [name for name in SYSTEMS if (law.__name__, name) not in skip]
        default = [name for name in SMALL if name in names][i % len(SMALL) - 1]
        for name in names:
            marks = () if name == default else pytest.mark.slow
            params.append(pytest.param(law, name, marks=marks, id=f"{law.__name__}-{name}"))
    return pytest.mark.parametrize(("law", "name"), params)


def inputs(system):
    """A state of the system, and a displacement in units of its size."""
    return st.tuples(dct.system_states(system), dct.states(system.y0))


def displaced(y, displacement, size=1e-3):
    """A candidate near `y`: as far away as a step of an integrator errs."""

    def move(a, d):
        return a + size * jnp.mean(jnp.abs(a)) * jnp.asarray(d, a.dtype)

    return jax.tree.map(move, y, displacement)


def values_at(manifold, y):
    """The conserved values at `y`, as `project` takes them."""
    return jax.tree.map(
        lambda entry: entry.fn(0.0, y, None) if isinstance(entry, dfc.FirstIntegral) else None,
        manifold,
        is_leaf=is_entry,
    )


def is_entry(x):
    return isinstance(x, dfc.FirstIntegral | dfc.Constraint)


def project(manifold, candidate, y, projection=None):
    """`candidate` projected to the level set of `y`, and whether that succeeded."""
    projection = dfc.SimplifiedNewton() if projection is None else projection
    out, info = dfc.project(
        manifold, candidate, value=values_at(manifold, y), projection=projection
    )
    return out, info.result == optx.RESULTS.successful


@eqx.filter_jit
def evaluate(law, system, y, displacement):
    return law(system, y, displacement)


def check(law, system, drawn, tolerance=None):
    """Draws nothing: `drawn` is passed to the compiled law."""
    y, displacement = drawn
    applies, got, expected = evaluate(law, system, y, displacement)
    # A projection may fail near a point where gradients are parallel, as long as it says so.
    assume(bool(np.all(applies)))
    assert_close(got, expected, getattr(law, "tolerance", 1e-8) if tolerance is None else tolerance)


def assert_close(got, expected, tolerance):
    """Relative to the largest component of each leaf's tree."""
    size = max(1e-300, *(float(np.max(np.abs(x))) for x in jax.tree.leaves(expected)))
    assert jax.tree.structure(got) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * size)


def within(tolerance):
    """Marks a law that holds to another tolerance than 1e-8 of the state."""

    def mark(law):
        law.tolerance = tolerance
        return law

    return mark
