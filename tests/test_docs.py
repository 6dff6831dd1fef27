"""Executes the code of the README, docs and docstrings, and checks that the reference is complete.

The ```` ```python ```` blocks of one page, or of one docstring, run in order in one namespace, in a
new folder and in the state of a new interpreter: float32 unless the page enables float64.
"""

import ast
import re
import runpy
import shlex
import subprocess
import sys
import textwrap
import types
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "diffrax_conserve"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
FENCE = re.compile(
    r"^(?P<indent>[ ]*)```[ ]*(?P<language>\w+)[^\n]*\n(?P<code>.*?)^(?P=indent)```[ ]*$",
    re.DOTALL | re.MULTILINE,
)


class Block(NamedTuple):
    line: int  # of the first line of code, from 1
    code: str


class Page(NamedTuple):
    name: str
    file: Path
    blocks: list[Block]


def blocks(text: str, first_line: int, *languages: str) -> list[Block]:
    """The code blocks of `text`, which starts at `first_line` of its file."""
    return [
        Block(first_line + text.count("\n", 0, m.start("code")), textwrap.dedent(m["code"]))
        for m in FENCE.finditer(text)
        if m["language"] in languages
    ]


def docstrings(tree: ast.Module) -> Iterator[tuple[str, ast.Constant]]:
    """Every docstring with the name of what it documents; `X.__init__.__doc__ = ...` included."""

    def visit(node: ast.AST, name: str) -> Iterator[tuple[str, ast.Constant]]:
        for child in getattr(node, "body", []):
            match child:
                case ast.Expr(value=ast.Constant(value=str()) as doc) if child is node.body[0]:
                    yield name, doc
                case ast.Assign(
                    targets=[ast.Attribute(attr="__doc__") as target],
                    value=ast.Constant(value=str()) as doc,
                ):
                    yield ast.unparse(target.value), doc
                case ast.ClassDef() | ast.FunctionDef():
                    yield from visit(child, f"{name}.{child.name}".strip("."))

    yield from visit(tree, "")


def example_pages() -> Iterator[Page]:
    for file in PAGES:
        yield Page(
            file.relative_to(ROOT).as_posix(),
            file,
            blocks(file.read_text(encoding="utf-8"), 1, "python"),
        )
    for file in sorted(PACKAGE.rglob("*.py")):
        path = file.relative_to(ROOT).as_posix()
        for name, doc in docstrings(ast.parse(file.read_text(encoding="utf-8"))):
            yield Page(f"{path}:{name}", file, blocks(doc.value, doc.lineno, "python"))


EXAMPLES = [page for page in example_pages() if page.blocks]


@pytest.fixture
def new_interpreter(tmp_path, monkeypatch):
    """A new folder, no figure windows, and JAX as it is in a new interpreter."""
    import matplotlib.pyplot as plt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    plt.switch_backend("Agg")
    x64 = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", False)
    yield
    jax.config.update("jax_enable_x64", x64)
    plt.close("all")


@pytest.mark.examples
@pytest.mark.parametrize("page", EXAMPLES, ids=lambda page: page.name)
def test_python_examples_run(page, new_interpreter, monkeypatch):
    # Classes look their module up in `sys.modules` by name, so the namespace is that of a module.
    module = types.ModuleType("example")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    for block in page.blocks:
        # The empty lines make every traceback show the line of the file.
        code = compile("\n" * (block.line - 1) + block.code, str(page.file), "exec")
        try:
            exec(code, module.__dict__)
        except Exception as error:
            error.add_note(f"in the example at {page.file}:{block.line}")
            raise


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


PROBLEMS = {
    '<script src="https://elsewhere.org/x.js"></script>': "loads https://elsewhere.org/x.js",
    '<link rel="stylesheet" href="//elsewhere.org/x.css">': "loads //elsewhere.org/x.css",
    "<style>@import 'https://elsewhere.org/x.css'</style>": "loads https://elsewhere.org/x.css",
    '<p style="background: url(https://elsewhere.org/x)">': "loads https://elsewhere.org/x",
    "<p>the energy $E$</p>": "raw LaTeX: '$E$'",
    r"<p>\(E\)</p>": "raw LaTeX",
    '<a href="https://elsewhere.org">a link</a> <code>$HOME</code>': None,
    '<img src="images/x.png"> <math><mi>E</mi></math>': None,
}


@pytest.mark.parametrize("html", PROBLEMS)
def test_what_a_page_must_not_have_fails_the_build(html, tmp_path):
    check = runpy.run_path(str(ROOT / "docs" / "self_contained.py"))["problems"]
    (tmp_path / "page.html").write_text(f"<html><body>{html}</body></html>", encoding="utf-8")
    found = check(tmp_path)
    expected = PROBLEMS[html]
    if expected is None:
        assert not found
    else:
        assert len(found) == 1
        assert expected in found[0]
