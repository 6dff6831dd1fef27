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
from hypothesis import assume, given, settings

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

from ..problems import difference, largest

SYSTEMS = {name: dfc.systems.get(name) for name in dfc.systems.names()}


# Quick to compile, and with more than one constraint.
SMALL = ("rigid-body", "kepler", "conservative-lorenz", "cartesian-pendulum")

# A soliton has the least energy for its mass and momentum: gradients are parallel there, and the
# derivative is NaN.
PARALLEL = "korteweg-de-vries"


def every_law_on_every_system(laws, skip=(), max_examples=6):
    """The test of laws, which do not hold for the pairs of a law and a system in `skip`."""
    params = []
    for i, law in enumerate(laws):
        names = [name for name in SYSTEMS if (law.__name__, name) not in skip]
        default = [name for name in SMALL if name in names][i % len(SMALL) - 1]
        for name in names:
            marks = () if name == default else pytest.mark.slow
            params.append(pytest.param(law, name, marks=marks, id=f"{law.__name__}-{name}"))

    @pytest.mark.parametrize(("law", "name"), params)
    @settings(max_examples=max_examples)
    @given(data=st.data())
    def test_law(law, name, data):
        """At a drawn state, for a displacement in units of its size."""
        system = SYSTEMS[name]
        drawn = data.draw(st.tuples(dct.system_states(system), dct.states(system.y0)))
        applies, got, expected = evaluate(law, system, *drawn)
        # A projection may fail near a point where gradients are parallel, as long as it says so.
        assume(bool(np.all(applies)))
        assert jax.tree.structure(got) == jax.tree.structure(expected)
        # Relative to the largest component of all leaves.
        limit = getattr(law, "tolerance", 1e-8) * max(1e-300, largest(expected))
        assert difference(got, expected) <= limit

    return test_law


def displaced(y, displacement, size=1e-3):
    """A candidate near `y`: as far away as a step of an integrator errs."""

    def move(a, d):
        return a + size * jnp.mean(jnp.abs(a)) * jnp.asarray(d, a.dtype)

    return jax.tree.map(move, y, displacement)


def project(manifold, candidate, y, projection=None):
    """`candidate` projected to the level set of `y`, and whether that succeeded."""
    projection = dfc.SimplifiedNewton() if projection is None else projection
    value = jax.tree.map(
        lambda entry: entry.fn(0.0, y, None) if isinstance(entry, dfc.FirstIntegral) else None,
        manifold,
        is_leaf=lambda x: isinstance(x, dfc.FirstIntegral | dfc.Constraint),
    )
    out, info = dfc.project(manifold, candidate, value=value, projection=projection)
    return out, info.result == optx.RESULTS.successful


@eqx.filter_jit
def evaluate(law, system, y, displacement):
    return law(system, y, displacement)


def within(tolerance):
    """Marks a law that holds to another tolerance than 1e-8 of the state."""

    def mark(law):
        law.tolerance = tolerance
        return law

    return mark
