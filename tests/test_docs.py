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
import pytest

from .pages import CHECK, FIGURES, PAGES, ROOT, agree, blocks, example_pages, roundoff, run

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


SITE = [page for page in PAGES if page.name != "README.md"]


def shown(file):
    """The text of a page as a reader gets it, without the blocks that only run."""
    return CHECK.sub("", file.read_text(encoding="utf-8"))


def test_pages_are_few_and_short():
    """And tables fit on a screen; what only runs prints nothing."""
    assert len(SITE) <= 26
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 90
    for file in PAGES:
        text = file.read_text(encoding="utf-8")
        heads = re.findall(r"^(\|.*\|)\n\|[-|: ]+\|$", text, re.MULTILINE)
        assert [head for head in heads if head.count("|") - 1 > 7] == [], file
        assert [found for found in CHECK.findall(text) if "```text" in found] == [], file
        assert file.parent.name == "api" or len(shown(file).split()) <= 900, file


def test_figures_are_shown():
    """Every figure in `docs/images` is on a page, and every page shows figures that there are."""
    files = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    text = "\n".join(file.read_text(encoding="utf-8") for file in files)
    used = {name for name in re.findall(r"images/((?:pages/)?[\w-]+\.(?:svg|png))", text)}
    folder = ROOT / "docs" / "images"
    kept = {file.relative_to(folder).as_posix() for file in folder.rglob("*.*")}
    assert used <= kept
    # The benchmarks write both kinds.
    assert {name for name in kept - used if name.removesuffix(".png") + ".svg" not in used} == set()


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


def test_the_reference_has_only_public_names_and_each_once():
    paths = documented()
    private = sorted(path for path in paths if found(path) is None)
    assert not private, f"these are not public: remove their `:::` lines, {private}"
    things = [id(found(path)) for path in paths]
    assert len(things) == len(set(things)), "something is documented twice"


def test_old_addresses_lead_to_pages():
    moved = runpy.run_path(str(ROOT / "docs" / "redirects.py"))["MOVED"]
    addresses = {page.relative_to(ROOT / "docs").with_suffix("").as_posix() for page in SITE}
    assert not addresses & moved.keys()
    assert {new.partition("/")[0] for new in moved.values()} <= {a.split("/")[0] for a in addresses}
    assert {re.sub("/(#.*)?$", "", new).removesuffix("/") for new in moved.values()} <= addresses


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
