"""That `docs/browser.py`, which `make docs` runs, sees what is wrong with a page."""

import runpy
import sys
import types
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
BROWSER = runpy.run_path(str(ROOT / "docs" / "browser.py"))
HEAD = (
    "<!doctype html><meta name=viewport content='width=device-width'><style>body{margin:0}</style>"
)
FINE = f"{HEAD}<p>text</p><pre style='overflow-x: auto'>{'wide ' * 400}</pre>"
CODE = f"{HEAD}<pre><code style='display: block; overflow: auto'>{'wide ' * 400}</code></pre>"


def errors(found):
    return [line for line in found if "Error: no" in line]


@pytest.mark.skipif(BROWSER["chromium"]() is None, reason="there is no Chromium here")
def test_what_is_wrong_with_a_page_is_found(tmp_path):
    (tmp_path / "fine.html").write_text(FINE)
    (tmp_path / "wide.html").write_text(f"{HEAD}<div style='width: 800px'>wide</div>")
    (tmp_path / "code.html").write_text(CODE)
    (tmp_path / "old.html").write_text('<meta http-equiv="refresh"><img src="nowhere.png">')
    (tmp_path / "picture.html").write_text(f"{HEAD}<img src='nowhere.png'>")
    dark = "matchMedia('(prefers-color-scheme: dark)').matches"
    (tmp_path / "script.html").write_text(f"{HEAD}<script>if ({dark}) throw Error('no')</script>")
    found = BROWSER["problems"](tmp_path, BROWSER["chromium"]())
    assert not [line for line in found if line.startswith("fine")]
    assert "wide.html at 390 pixels: 800 pixels wide (dark)" in found
    assert "wide.html at 390 pixels: 800 pixels wide (light)" in found
    assert not [line for line in found if "1280" in line and not line.startswith("code")]
    assert "code.html at 1280 pixels: cut off: wide" in " ".join(found)
    assert not [line for line in found if line.startswith("old")]
    assert "picture.html: no picture nowhere.png (light)" in found
    thrown = errors(found)
    for _ in range(3):  # Chromium may end before it has written its log
        thrown = thrown or errors(BROWSER["problems"](tmp_path, BROWSER["chromium"]()))
    assert thrown
    assert all(line.endswith("(dark)") for line in thrown)


def test_links_and_figures_of_the_package_follow_from_its_place(monkeypatch):
    interface = types.ModuleType("hatchling.metadata.plugin.interface")
    interface.MetadataHookInterface = object
    monkeypatch.setitem(sys.modules, interface.__name__, interface)
    hook = runpy.run_path(str(ROOT / "hatch_build.py"))
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert hook["urls"]("") == {}
    assert "<img" in text
    assert "<img" not in hook["readme"](text, "")
    place = "https://elsewhere.org/us/it"
    assert hook["urls"](place)["Issues"] == f"{place}/issues"
    moved = hook["readme"](text, place)
    assert f'src="{place}/raw/main/docs/images/kepler-drift.png"' in moved
    assert f"]({place}/raw/main/docs/" in moved
    assert not hook["RELATIVE"].search(moved)
