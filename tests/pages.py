"""The code of the README, the docs and the docstrings: found, run, and its output compared.

The ```` ```python ```` blocks of one page, or of one docstring, run in order in one namespace, in a
new folder and in the state of a new interpreter: float32 unless the page enables float64. What a
block prints is shown in a ```` ```text ```` block right below it, and the figures that it saves are
in `docs/images/pages`. A block in a comment `<!-- check ... -->` runs too, and is not shown:
asserts, and the code of figures.

`python -m tests.pages FILE ...` runs the pages named and writes both anew.
"""

import ast
import contextlib
import io
import os
import re
import shutil
import sys
import tempfile
import textwrap
import types
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "diffrax_conserve"
# `docs/appendix` is not on the site, and has no code.
PAGES = [
    ROOT / "README.md",
    *(file for file in sorted((ROOT / "docs").rglob("*.md")) if file.parent.name != "appendix"),
]


FIGURES = ROOT / "docs" / "images" / "pages"
FENCE = re.compile(
    r"^(?P<indent>[ ]*)```[ ]*(?P<language>\w+)[^\n]*\n(?P<code>.*?)^(?P=indent)```[ ]*$"
    r"(?:\n\s*\n(?P=indent)```[ ]*text\n(?P<shown>.*?)^(?P=indent)```[ ]*$)?",
    re.DOTALL | re.MULTILINE,
)


class Block(NamedTuple):
    line: int  # of the first line of code, from 1
    code: str
    shown: str  # the text block right below


class Page(NamedTuple):
    name: str
    file: Path
    blocks: list[Block]


def blocks(text: str, first_line: int, *languages: str) -> list[Block]:
    """The code blocks of `text`, which starts at `first_line` of its file."""
    return [
        Block(
            first_line + text.count("\n", 0, m.start("code")),
            textwrap.dedent(m["code"]),
            textwrap.dedent(m["shown"] or ""),
        )
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
        found = blocks(file.read_text(encoding="utf-8"), 1, "python")
        yield Page(file.relative_to(ROOT).as_posix(), file, found)
    for file in sorted(PACKAGE.rglob("*.py")):
        path = file.relative_to(ROOT).as_posix()
        for name, doc in docstrings(ast.parse(file.read_text(encoding="utf-8"))):
            yield Page(f"{path}:{name}", file, blocks(doc.value, doc.lineno, "python"))


def run(page: Page) -> Iterator[tuple[Block, str]]:
    """Each block of `page` with what it printed; in the current folder."""
    import matplotlib.pyplot as plt

    plt.switch_backend("Agg")
    # Classes look their module up in `sys.modules` by name, so the namespace is that of a module.
    module = types.ModuleType("example")
    before = sys.modules.get(module.__name__)
    sys.modules[module.__name__] = module
    try:
        with plt.style.context(ROOT / "docs" / "figures.mplstyle"):
            for block in page.blocks:
                yield block, _run_one(page, block, module)
    finally:
        plt.close("all")
        del sys.modules[module.__name__]
        if before is not None:
            sys.modules[module.__name__] = before


def _run_one(page: Page, block: Block, module: types.ModuleType) -> str:
    # The empty lines make every traceback show the line of the file.
    code = compile("\n" * (block.line - 1) + block.code, str(page.file), "exec")
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        try:
            exec(code, module.__dict__)
        except Exception as error:
            error.add_note(f"in the example at {page.file}:{block.line}")
            raise
    return printed.getvalue()


NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*(?:[eE][-+]?\d+)?|\bnan\b|\binf\b)")


def roundoff(page: Page) -> float:
    """What is smaller may be roundoff, which differs between machines."""
    return 1e-12 if any("jax_enable_x64" in block.code for block in page.blocks) else 1e-5


def agree(printed: str, shown: str, roundoff: float = 1e-12) -> bool:
    """Whether what was printed is what the page shows, up to the last digit of its numbers."""
    texts = [" ".join(NUMBER.sub("#", text).split()) for text in (printed, shown)]
    pairs = zip(NUMBER.findall(printed), NUMBER.findall(shown), strict=False)
    return texts[0] == texts[1] and all(_numbers_agree(*pair, roundoff) for pair in pairs)


def _numbers_agree(printed: str, shown: str, roundoff: float) -> bool:
    if printed == shown:
        return True
    a, b = float(printed), float(shown)
    larger = max(abs(a), abs(b))
    mantissa = re.split("[eE]", shown)[0].lstrip("+-")
    if mantissa == shown.lstrip("+-") and "." not in shown:
        return abs(a - b) <= 0.01 * larger  # a number of steps
    digits = min(len(mantissa.replace(".", "").lstrip("0")), 4)
    # One digit is the size of an error, which after a training another processor changes.
    share = 0.7 if digits == 1 else 5 * 10.0**-digits
    return larger < roundoff or abs(a - b) <= share * larger


def write(file: Path) -> None:
    """Runs all that is in `file`, shows what it printed in it, and keeps its figures."""
    import jax

    lines = file.read_text(encoding="utf-8").split("\n")
    moved = 0  # by what was inserted above
    for page in (page for page in example_pages() if page.file == file and page.blocks):
        jax.config.update("jax_enable_x64", False)
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            for block, printed in run(page):
                end = block.line + block.code.count("\n") + moved  # the first line after the fence
                indent = lines[end - 1][: -len(lines[end - 1].lstrip())]
                before = 2 + 1 + block.shown.count("\n") if block.shown else 0
                new = ["", "```text", *printed.rstrip("\n").split("\n"), "```"] if printed else []
                lines[end : end + before] = [(indent + line).rstrip() for line in new]
                moved += len(new) - before
            for figure in Path(folder).glob("*.svg"):
                FIGURES.mkdir(exist_ok=True)
                shutil.copy(figure, FIGURES / figure.name)
    file.write_text("\n".join(lines), encoding="utf-8")


if __name__ == "__main__":
    os.environ.setdefault("MPLBACKEND", "Agg")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # see `tests/conftest.py`
    for name in sys.argv[1:]:
        write(Path(name).resolve())
