"""Every defect that `make mutants` plants has a place in the package, and a fast test to notice."""

import pytest

from . import mutants


@pytest.mark.parametrize("name", mutants.MUTANTS)
def test_a_defect_can_be_planted(name, monkeypatch):
    mutants.MUTANTS[name](mutants.Package(monkeypatch))
    assert mutants.is_fast(mutants.finder(name))
