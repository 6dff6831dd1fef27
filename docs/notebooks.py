"""The pages of the gallery as notebooks: a cell for each code block, with its output.

    python docs/notebooks.py out/notebooks

`make docs` puts them on the site and links each from its page. `make slow` runs the cells in
the place of the blocks of the page: see `tests/test_docs.py`.
"""

import json
import re
import runpy
import sys
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parent
FENCE = runpy.run_path(str(DOCS.parent / "tests" / "pages.py"))["FENCE"]
GALLERY = (DOCS / "examples" / "index.md").read_text(encoding="utf-8")
NAMES = sorted(
    {
        (DOCS / "examples" / path).resolve().relative_to(DOCS.resolve()).as_posix()
        for path in re.findall(r"\]\(([\w./-]+\.md)\)", GALLERY)
    }
)

# A figure is drawn by its cell. A link to another page leads nowhere from a notebook, so its words
# stay alone.
DROPPED = re.compile(r"^(<!-- check|-->|!\[.*?\]\(.*?\)(\{.*?\})?)$\n?", re.MULTILINE)
LINK = re.compile(r"\[([^\]]+)\](?:\[[\w.]*\]|\((?!\w+:)[^)]*\))")
# The pages write names at the curves by a module that a reader does not have.
DRAWING = "from docs.drawing import label\n"
LEGEND = "label = lambda ax, places=None: ax.legend()\n"
NEEDS = "*Needs diffrax-conserve with its extra `plots`.*"


def notebook(text: str) -> dict[str, Any]:
    """The notebook of a page with this text, in version 4.5 of the format."""
    cells, end = [], 0
    for block in FENCE.finditer(text):
        if block["language"] == "python":
            cells += [_prose(text[end : block.start()]), _code(block, text)]
            end = block.end()
    cells.append(_prose(text[end:]))
    cells = [cell for cell in cells if cell["source"]]
    cells[0]["source"] = cells[0]["source"].replace("\n", f"\n\n{NEEDS}\n", 1)
    for i, cell in enumerate(cells):
        cell["id"] = f"cell-{i}"
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return {"cells": cells, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5}


def _prose(text: str) -> dict[str, Any]:
    source = LINK.sub(r"\1", DROPPED.sub("", text)).strip()
    return {"cell_type": "markdown", "metadata": {}, "source": source}


def _code(block: re.Match[str], text: str) -> dict[str, Any]:
    figure = re.search(r'savefig\("([\w-]+\.svg)"\)', block["code"])
    outputs: list[dict[str, Any]] = []
    if block["shown"]:
        outputs.append({"output_type": "stream", "name": "stdout", "text": block["shown"]})
    if figure is not None:
        image = (DOCS / "images" / "pages" / figure[1]).read_text(encoding="utf-8")
        data = {"image/svg+xml": image}
        outputs.append({"output_type": "display_data", "metadata": {}, "data": data})
    # What the page does not show is folded.
    hidden = text.rfind("<!-- check", 0, block.start()) > text.rfind("-->", 0, block.start())
    return {
        "cell_type": "code",
        "execution_count": None,
        "metadata": {"jupyter": {"source_hidden": True}} if hidden else {},
        "source": block["code"].replace(DRAWING, LEGEND).rstrip("\n"),
        "outputs": outputs,
    }


def made(name: str) -> str:
    text = (DOCS / name).read_text(encoding="utf-8")
    return json.dumps(notebook(text), ensure_ascii=False, indent=1) + "\n"


def on_files(files, config):
    from mkdocs.structure.files import File  # the tests run without mkdocs

    for name in NAMES:
        path = name.replace(".md", ".ipynb")
        files.append(File.generated(config, path, content=made(name)))
    return files


def on_page_markdown(markdown, page, **kwargs):
    del kwargs
    name = page.file.src_uri
    if name not in NAMES:
        return markdown
    path = Path(name).with_suffix(".ipynb").name
    title, rest = markdown.split("\n", 1)
    return f'{title}\n\n[This page as a notebook]({path}){{ download="{path}" }}\n{rest}'


if __name__ == "__main__":
    out = Path(sys.argv[1])
    out.mkdir(parents=True, exist_ok=True)
    for name in NAMES:
        (out / Path(name).with_suffix(".ipynb").name).write_text(made(name), encoding="utf-8")
