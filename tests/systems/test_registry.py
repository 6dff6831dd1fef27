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
    [
        ("keplar", "Did you mean .*'kepler'"),
        ("Rigid_Body", "Did you mean .*'rigid-body'"),
        ("zzz", "The catalogue holds: harmonic-oscillator, rigid-body"),
    ],
)
def test_an_unknown_name_is_answered_with_the_close_ones(wrong, right):
    with pytest.raises(ValueError, match=right):
        systems.get(wrong)
