"""Every defect that `make mutants` plants has a place in the package, and fast tests to notice."""

import pytest

from . import mutants


@pytest.mark.parametrize("name", mutants.MUTANTS)
def test_a_defect_can_be_planted(name, monkeypatch):
    mutants.MUTANTS[name](mutants.Package(monkeypatch))
    assert mutants.unselected(name) is None
