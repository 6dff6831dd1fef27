"""The benchmark runs, checks what it times, and refuses a wrong answer."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent.parent / "benchmarks"


def benchmark(name):
    """The benchmark as a module, loaded by its path; it finds its neighbours as a script does."""
    (file,) = FOLDER.glob(f"*/{name}.py")
    if str(file.parent) not in sys.path:
        sys.path.append(str(file.parent))
    spec = importlib.util.spec_from_file_location(name, file)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


# A benchmark, the page that shows its lines, and the function that makes them of its results.
TABLES = {
    "worth": ("../zoo", "table"),
    "zoo": ("zoo", "tables"),
    "paper": ("paper", "table"),
}


@pytest.mark.parametrize("name", TABLES)
def test_a_table_is_that_of_the_results(name, monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    (page, table), run = TABLES[name], benchmark(name)
    read = benchmark("trained").read_results
    results = read(run.RESULTS) if name in ("zoo", "paper") else json.loads(run.RESULTS.read_text())
    text = (FOLDER.parent / "docs" / "appendix" / f"{page}.md").read_text(encoding="utf-8")
    lines = getattr(run, table)(results)
    lines = lines.splitlines() if isinstance(lines, str) else list(lines)
    assert len(lines) > 2
    assert [line for line in lines if line not in text] == []


@pytest.mark.parametrize("name", ["report", "tables", "clients"])
def test_the_results_are_what_the_pages_show(name):
    module = benchmark(name)
    results = module.read_results()
    pages = [page.read_text(encoding="utf-8") for page in module.PAGES]
    assert [page for page in pages if module.filled(page, results) != page] == []
    for table in module.tables(results):
        assert any(f"<!-- begin: {table} -->" in page for page in pages)


SMOKE = {
    "zoo": lambda pinn, flow_map: (
        pinn["errors"]["projected"]["relative_l2_error"] < 1
        and flow_map["errors"]["RK4"]["one_step_rms"] < flow_map["errors"]["plain"]["one_step_rms"]
    ),
    "paper": lambda standard, conservative: (
        standard["plain"]["drift"] > 1e-6
        and all(x["projected"]["drift"] < 1e-14 for x in (standard, conservative))
    ),
    "worth": lambda cheap, dear: dear["batches"]["4"]["ratio"] > cheap["batches"]["4"]["ratio"] > 0,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SMOKE)
def test_a_smoke_run_is_plausible(name, monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    found = benchmark(name).main(["--smoke"])
    found = found if isinstance(found, tuple | list) else (found,)
    assert SMOKE[name](*found)
