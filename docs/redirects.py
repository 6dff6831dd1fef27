"""Sends readers of old addresses to the page that has the text now.

A static page is written at each old address, so that it works on any server.
"""

from pathlib import Path

MOVED = {
    "bounds": "balance-laws/#bounds",
    "own-projection": "api/solvers/#your-own-projection",
    "solvers": "api/solvers/#diffraxs-solvers",
    "systems": "api/systems/",
    "multi-device": "performance/#several-devices",
    "faq": "when-it-fails/",
    "longer-trainings": "training/",
    "learning-from-data": "examples/neural-hamiltonian/",
    "examples/rods": "constrained-mechanics/",
    "examples/robertson": "chemistry/",
    "examples/learned-step": "learned-solvers/",
    "examples/learned-parameters": "training/#a-family-of-equations",
    "examples/test-suite": "testing/",
    "api/diagnostics": "api/manifold/#diagnostics",
    "api/types": "api/manifold/#types-in-signatures",
    "api/projection": "api/solvers/#projections",
    "api/networks": "api/learned/",
    "api/training": "api/learned/#training",
    "appendix/paper": "paper/",
    "appendix/performance": "performance/",
    "appendix/learned-solvers": "learned-solvers/",
    "appendix/training": "training/",
    "appendix/learning-from-data": "examples/neural-hamiltonian/",
    "appendix/zoo": "zoo/",
}
PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>Moved</title>
<meta name="robots" content="noindex">
<meta http-equiv="refresh" content="0; url={address}">
</head>
<body><p>This page has moved: <a href="{address}">go there</a>.</p></body>
</html>
"""


def on_post_build(config):
    from mkdocs.exceptions import PluginError  # the tests run without mkdocs

    site = Path(config["site_dir"])
    for old, new in MOVED.items():
        path, _, anchor = new.partition("#")
        target, here = site / path / "index.html", site / old / "index.html"
        if not target.exists() or here.exists():
            raise PluginError(f"{__file__}: {old} -> {new}: no such page, or the old one exists")
        if anchor and f'id="{anchor}"' not in target.read_text(encoding="utf-8"):
            raise PluginError(f"{__file__}: {new}: the page has no such heading")
        here.parent.mkdir(parents=True, exist_ok=True)
        up = "../" * (old.count("/") + 1)
        here.write_text(PAGE.format(address=f"{up}{new}"), encoding="utf-8")
