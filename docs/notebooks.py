"""The pages of the gallery as notebooks: a cell for each code block, with its output.

`make docs` puts them on the site and links each from its page. `make slow` runs the cells in
the place of the blocks of the page: see `tests/test_docs.py`.
"""

import posixpath
import re
import runpy
from pathlib import Path

import nbformat
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

DOCS = Path(__file__).parent
FENCE = runpy.run_path(str(DOCS.parent / "tests" / "pages.py"))["FENCE"]
GALLERY = (DOCS / "examples" / "index.md").read_text(encoding="utf-8")
LINKED = re.findall(r"\]\(([\w./-]+\.md)\)", GALLERY)
NAMES = sorted({posixpath.normpath(f"examples/{path}") for path in LINKED})

# A figure is drawn by its cell. A link to another page leads nowhere from a notebook, so its words
# stay alone.
DROPPED = re.compile(r"^(<!-- check|-->|!\[.*?\]\(.*?\)(\{.*?\})?)$\n?", re.MULTILINE)
LINK = re.compile(r"\[([^\]]+)\](?:\[[\w.]*\]|\((?!\w+:)[^)]*\))")
# The pages write names at the curves by a module that a reader does not have.
DRAWING = "from docs.drawing import label\n"
LEGEND = "label = lambda ax, places=None: ax.legend()\n"
NEEDS = "*Needs diffrax-conserve with its extra `plots`.*"


def notebook(text: str) -> nbformat.NotebookNode:
    """The notebook of a page with this text."""
    cells, end = [], 0
    for block in FENCE.finditer(text):
        if block["language"] == "python":
            cells += [_prose(text[end : block.start()]), _code(block, text)]
            end = block.end()
    cells = [cell for cell in [*cells, _prose(text[end:])] if cell.source]
    cells[0].source = cells[0].source.replace("\n", f"\n\n{NEEDS}\n", 1)
    for i, cell in enumerate(cells):
        cell.id = f"cell-{i}"
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return new_notebook(cells=cells, metadata={"kernelspec": kernel})


def _prose(text):
    return new_markdown_cell(LINK.sub(r"\1", DROPPED.sub("", text)).strip())


def _code(block, text):
    code = block["code"].replace(DRAWING, LEGEND).rstrip("\n")
    outputs = [new_output("stream", text=block["shown"])] if block["shown"] else []
    if figure := re.search(r'savefig\("([\w-]+\.svg)"\)', code):
        image = (DOCS / "images" / "pages" / figure[1]).read_text(encoding="utf-8")
        outputs.append(new_output("display_data", {"image/svg+xml": image}))
    # What the page does not show is folded.
    hidden = text.rfind("<!-- check", 0, block.start()) > text.rfind("-->", 0, block.start())
    folded = {"jupyter": {"source_hidden": True}} if hidden else {}
    return new_code_cell(code, outputs=outputs, metadata=folded)


def on_files(files, config):
    from mkdocs.structure.files import File  # the tests run without mkdocs

    for name in NAMES:
        made = notebook((DOCS / name).read_text(encoding="utf-8"))
        path = name.replace(".md", ".ipynb")
        files.append(File.generated(config, path, content=nbformat.writes(made)))
    return files


def on_page_markdown(markdown, page, **kwargs):
    del kwargs
    if page.file.src_uri not in NAMES:
        return markdown
    path = Path(page.file.src_uri).with_suffix(".ipynb").name
    title, rest = markdown.split("\n", 1)
    return f'{title}\n\n[This page as a notebook]({path}){{ download="{path}" }}\n{rest}'
