"""Checks the site that was built: a reader fetches nothing from another host and sees no raw LaTeX.

Either fails the build.
"""

import re
from html.parser import HTMLParser
from pathlib import Path

ELSEWHERE = re.compile(r"(\w+:)?//", re.ASCII)
IN_CSS = re.compile(r"(?:url\(|@import)\s*[\"']?((?:\w+:)?//[^)\"']*)", re.ASCII)
LATEX = re.compile(r"\\[A-Za-z(\[{]|\$[^$]+\$")
# A `<link>` of these kinds is only followed when a reader clicks.
NOT_FETCHED = {"canonical", "prev", "next", "edit"}
VERBATIM = {"code", "pre", "script", "style"}


class Page(HTMLParser):
    """Collects what is wrong with a page while it is fed to it."""

    def __init__(self):
        super().__init__()
        self.wrong = []
        self._verbatim = 0

    def handle_starttag(self, tag, attrs):
        values = {name: value or "" for name, value in attrs}
        self._verbatim += tag in VERBATIM
        fetched = [values.get(name, "") for name in ("src", "srcset", "poster", "data")]
        if tag == "link" and values.get("rel") not in NOT_FETCHED:
            fetched.append(values.get("href", ""))
        # Material's script fetches the library for diagrams, and the stars of a repository.
        if "mermaid" in values.get("class", "").split():
            self.wrong.append("a mermaid diagram, which loads a library from another host")
        if values.get("data-md-component") == "source":
            self.wrong.append("a repository link, whose numbers come from another host")
        self.wrong += [f"loads {url}" for url in fetched if ELSEWHERE.match(url)]
        self.wrong += [f"loads {url}" for url in IN_CSS.findall(values.get("style", ""))]

    def handle_endtag(self, tag):
        self._verbatim -= tag in VERBATIM

    def handle_data(self, data):
        self.wrong += [f"loads {url}" for url in IN_CSS.findall(data) if self._verbatim]
        if not self._verbatim:
            self.wrong += [f"shows raw LaTeX: {found!r}" for found in LATEX.findall(data)]


def problems(site: Path) -> list[str]:
    """What is wrong with the site in this folder, one line each."""
    found = []
    for file in sorted(site.rglob("*.html")):
        page = Page()
        page.feed(file.read_text(encoding="utf-8"))
        found += [f"{file.relative_to(site)} {wrong}" for wrong in page.wrong]
    for file in sorted(site.rglob("*.css")):
        urls = IN_CSS.findall(file.read_text(encoding="utf-8"))
        found += [f"{file.relative_to(site)} loads {url}" for url in urls]
    return found


def on_post_build(config):
    from mkdocs.exceptions import PluginError  # the tests run without mkdocs

    if found := problems(Path(config["site_dir"])):
        raise PluginError("\n".join(found))
