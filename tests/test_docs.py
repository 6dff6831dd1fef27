"""Executes the code of the README, docs and docstrings; checks that the reference is complete."""

import ast
import re
import runpy
import shlex
import subprocess
import sys
import types

import jax
import pytest

from .pages import FIGURES, PAGES, ROOT, agree, blocks, example_pages, roundoff, run

EXAMPLES = [page for page in example_pages() if page.blocks]


@pytest.fixture
def new_interpreter(tmp_path, monkeypatch):
    """A new folder, and JAX as it is in a new interpreter."""
    monkeypatch.chdir(tmp_path)
    x64 = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", False)
    yield tmp_path
    jax.config.update("jax_enable_x64", x64)


@pytest.mark.examples
@pytest.mark.parametrize("page", EXAMPLES, ids=lambda page: page.name)
def test_python_examples_run_and_print_what_is_shown(page, new_interpreter):
    write = f"`python -m tests.pages {page.file.relative_to(ROOT)}` writes it"
    for block, printed in run(page):
        assert agree(printed, block.shown, roundoff(page)), (
            f"below the code of line {block.line} the page shows\n{block.shown}\n"
            f"but this was printed ({write}):\n{printed}"
        )
    text = page.file.read_text(encoding="utf-8")
    for figure in new_interpreter.glob("*.svg"):
        assert (FIGURES / figure.name).exists(), f"the figure is not kept: {write}"
        assert f"images/pages/{figure.name})" in text, f"{figure.name} is not on the page"


GUIDES = sorted((ROOT / "docs").glob("*.md"))
SHOWN_EXAMPLES = [page for page in EXAMPLES if page.file.parent.name == "examples"]


@pytest.mark.parametrize("file", GUIDES, ids=lambda file: file.stem)
def test_guides_are_short(file):
    assert len(file.read_text(encoding="utf-8").split()) <= 1500


@pytest.mark.parametrize("file", PAGES, ids=lambda file: file.relative_to(ROOT).as_posix())
def test_tables_fit_on_a_screen(file):
    heads = re.findall(r"^(\|.*\|)\n\|[-|: ]+\|$", file.read_text(encoding="utf-8"), re.MULTILINE)
    assert [head for head in heads if head.count("|") - 1 > 7] == []


def test_there_are_ten_examples():
    assert len(SHOWN_EXAMPLES) >= 10


@pytest.mark.parametrize("page", SHOWN_EXAMPLES, ids=lambda page: page.file.stem)
def test_an_example_is_short_and_has_a_figure_and_output(page):
    lines = [line for block in page.blocks for line in block.code.splitlines() if line.strip()]
    assert len(lines) <= 60
    assert any(block.shown for block in page.blocks)
    assert (FIGURES / f"{page.file.stem}.svg").exists()
    assert f"images/pages/{page.file.stem}.svg)" in page.file.read_text(encoding="utf-8")


def commands() -> list[str]:
    """The `python -m diffrax_conserve ...` lines of the shell blocks."""
    lines = [
        line.strip().removeprefix("$ ")
        for file in PAGES
        for block in blocks(file.read_text(encoding="utf-8"), 1, "bash", "console", "sh")
        for line in block.code.splitlines()
    ]
    return sorted({line for line in lines if line.startswith("python -m diffrax_conserve")})


@pytest.mark.examples
@pytest.mark.parametrize("command", commands())
def test_shell_examples_run(command, tmp_path):
    _, *arguments = shlex.split(command, comments=True)
    done = subprocess.run(
        [sys.executable, *arguments], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def exported(module: str) -> list[str]:
    """The public names that the `__init__.py` of `module` imports, without its subpackages."""
    tree = ast.parse((ROOT / module.replace(".", "/") / "__init__.py").read_text(encoding="utf-8"))
    names = [
        alias.asname or alias.name
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and node.module is not None
        for alias in node.names
    ]
    return [f"{module}.{name}" for name in names if not name.startswith("_")]


def modules_with_reference() -> list[str]:
    modules = ["diffrax_conserve", "diffrax_conserve.systems", "diffrax_conserve.testing"]
    return [m for m in modules if (ROOT / m.replace(".", "/") / "__init__.py").exists()]


@pytest.mark.parametrize("module", modules_with_reference())
def test_every_public_name_is_in_the_api_reference(module):
    pages = "\n".join(f.read_text(encoding="utf-8") for f in (ROOT / "docs" / "api").glob("*.md"))
    documented = re.findall(r"^::: ([\w.]+)$", pages, re.MULTILINE)
    missing = set(exported(module)) - set(documented)
    assert not missing, f"add `::: NAME` to a page in docs/api for {sorted(missing)}"
    assert len(documented) == len(set(documented)), "a name is documented twice"


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
