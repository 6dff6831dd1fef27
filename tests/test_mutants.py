"""Every defect that `make mutants` plants still has a place in the package, and tests to notice."""

import pytest

from . import mutants


@pytest.mark.parametrize("name", mutants.MUTANTS)
def test_a_defect_can_be_planted(name, monkeypatch):
    mutants.MUTANTS[name](mutants.Package(monkeypatch))
    assert mutants.unselected(name) is None


def test_a_defect_without_a_place_is_told(monkeypatch):
    package = mutants.Package(monkeypatch)
    with pytest.raises(LookupError, match="0 functions or classes named no_such_function"):
        package.function("no_such_function", lambda old: old)
    with pytest.raises(LookupError, match="ManifoldProjection defines no no_such_method"):
        package.method("ManifoldProjection.no_such_method", lambda old: old)
