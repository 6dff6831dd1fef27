"""The catalogue by name."""

import pytest

from diffrax_conserve import systems


def test_every_system_is_found_by_its_own_name():
    for name in (*systems.names(), *systems.names(stiff=True)):
        assert systems.get(name).name == name


def test_every_exported_system_is_listed():
    exported = {
        x.name
        for x in vars(systems).values()
        if isinstance(x, type)
        and issubclass(x, systems.AbstractSystem)
        and not x.__name__.startswith("Abstract")
    }
    assert exported == {*systems.names(), *systems.names(stiff=True)}
    assert len(exported) == 15


@pytest.mark.parametrize(
    ("wrong", "right"),
    [("keplar", "kepler"), ("Rigid_Body", "rigid-body"), ("lorenz", "conservative-lorenz")],
)
def test_an_unknown_name_is_answered_with_the_close_ones(wrong, right):
    with pytest.raises(ValueError, match=f"Did you mean .*'{right}'"):
        systems.get(wrong)


def test_a_name_like_no_other_is_answered_with_the_catalogue():
    with pytest.raises(ValueError, match="The catalogue holds: harmonic-oscillator, rigid-body"):
        systems.get("zzz")
