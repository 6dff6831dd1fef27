"""Executes the code of the README, docs and docstrings; checks that the reference is complete."""

import importlib
import operator
import re
import runpy
import shlex
import subprocess
import sys
import types

import jax
import nbformat
import pytest

from .pages import FIGURES, PACKAGE, PAGES, ROOT, Block, agree, blocks, example_pages, roundoff, run

# What `make examples` runs; the other pages take minutes, and are run by `make slow`.
FIRST = ("README.md", "docs/index.md", "docs/getting-started.md", "docs/api/", "diffrax_conserve/")
EXAMPLES = [
    pytest.param(page, marks=() if page.name.startswith(FIRST) else pytest.mark.slow, id=page.name)
    for page in example_pages()
    if page.blocks
]
NOTEBOOKS = runpy.run_path(str(ROOT / "docs" / "notebooks.py"))
GALLERY = {f"docs/{name}" for name in NOTEBOOKS["NAMES"]}


def from_notebook(page):
    """The page with the code cells of its notebook as its blocks."""
    made = NOTEBOOKS["notebook"](page.file.read_text(encoding="utf-8"))
    nbformat.validate(made)
    cells = [cell for cell in made["cells"] if cell["cell_type"] == "code"]
    shown = ["".join(out.get("text", "") for out in cell["outputs"]) for cell in cells]
    pairs = zip(page.blocks, cells, shown, strict=True)
    return page._replace(blocks=[Block(b.line, c["source"], text) for b, c, text in pairs])


@pytest.fixture
def new_interpreter(tmp_path, monkeypatch):
    """A new folder, and JAX as it is in a new interpreter."""
    monkeypatch.chdir(tmp_path)
    x64 = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", False)
    yield tmp_path
    jax.config.update("jax_enable_x64", x64)


@pytest.mark.examples
@pytest.mark.parametrize("page", EXAMPLES)
def test_python_examples_run_and_print_what_is_shown(page, new_interpreter):
    if page.name in GALLERY:
        page = from_notebook(page)
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


TEXTS = [*PAGES, *(ROOT / name for name in ("CONTRIBUTING.md", "CHANGELOG.md"))]
TEXTS += [ROOT / "benchmarks" / "README.md", *(ROOT / "docs" / "appendix").glob("*.md")]


@pytest.mark.parametrize("file", TEXTS, ids=lambda file: file.relative_to(ROOT).as_posix())
def test_links_lead_to_files(file):
    """Of those on the site `make docs` follows the anchors too."""
    paths = re.findall(r"\]\((?!\w+:|#)([^)#]+)[^)]*\)", file.read_text(encoding="utf-8"))
    assert [path for path in paths if not (file.parent / path).exists()] == []


def test_names_of_ours_exist():
    """What pages and docstrings write as `dfc.X` or `diffrax_conserve.X`."""
    texts = [file.read_text(encoding="utf-8") for file in [*PAGES, *PACKAGE.rglob("*.py")]]
    paths = set(re.findall(r"\b(?:dfc|diffrax_conserve)((?:\.[A-Za-z]\w*)+)", "\n".join(texts)))
    missing = {path for path in paths if found(f"diffrax_conserve{path}") is None}
    assert missing == set()


def test_figures_are_shown():
    """Every figure in `docs/images` is on a page, and every page shows figures that there are."""
    files = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    text = "\n".join(file.read_text(encoding="utf-8") for file in files)
    used = {name for name in re.findall(r"images/((?:pages/)?[\w-]+\.(?:svg|png))", text)}
    folder = ROOT / "docs" / "images"
    kept = {file.relative_to(folder).as_posix() for file in folder.rglob("*.*")}
    assert used <= kept
    assert kept - used == set()


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


MODULES = ["diffrax_conserve"] + [
    f"diffrax_conserve.{name}" for name in ("learned", "systems", "testing")
]


def found(path):
    """What is called `path` here, or `None`."""
    if path in MODULES:
        return importlib.import_module(path)
    module = max((m for m in MODULES if path.startswith(f"{m}.")), key=len)
    try:
        return operator.attrgetter(path.removeprefix(f"{module}."))(importlib.import_module(module))
    except AttributeError:
        return None


def documented():
    pages = "\n".join(f.read_text(encoding="utf-8") for f in (ROOT / "docs" / "api").glob("*.md"))
    return re.findall(r"^::: ([\w.]+)$", pages, re.MULTILINE)


@pytest.mark.parametrize("module", MODULES)
def test_every_public_name_is_in_the_api_reference(module):
    there = [found(path) for path in documented()]
    public = {
        name: x
        for name, x in vars(importlib.import_module(module)).items()
        if not (name.startswith("_") or isinstance(x, types.ModuleType))
    }
    missing = sorted(name for name, x in public.items() if not any(x is y for y in there))
    assert not missing, f"add `::: NAME` to a page in docs/api for {missing}"


def test_the_reference_has_only_public_names_and_what_they_return_and_each_once():
    """A type that users only receive is not exported: its name is that in its module."""
    paths = documented()
    received = {path for path in paths if "._" in path and isinstance(found(path), type)}
    public = {path for path in paths if "._" not in path and found(path) is not None}
    private = sorted({*paths} - public - received)
    assert not private, f"these are not public: remove their `:::` lines, {private}"
    things = [id(found(path)) for path in paths]
    assert len(things) == len(set(things)), "something is documented twice"
