"""What the package says of its place on the web, from one variable in `pyproject.toml`.

`place` is the address of the repository, without a slash at the end. While it is empty there are no
links, and the description of the package has no figures, because it cannot show relative ones.
"""

import re
from pathlib import Path

from hatchling.metadata.plugin.interface import MetadataHookInterface

RELATIVE = re.compile(r'(?P<before>\]\(|src=")(?!https?:|#)(?P<path>[^)"]+)')
FIGURES = re.compile(r"<p>\s*(<img [^>]*>\s*)+</p>\n*")


def urls(place: str) -> dict[str, str]:
    if not place:
        return {}
    return {
        "Repository": place,
        "Issues": f"{place}/issues",
        "Changelog": f"{place}/blob/main/CHANGELOG.md",
    }


def readme(text: str, place: str) -> str:
    """The README with links and figures that also work elsewhere."""
    if not place:
        return FIGURES.sub("", text)
    return RELATIVE.sub(rf"\g<before>{place}/raw/main/\g<path>", text)


class Place(MetadataHookInterface):
    """Called by hatchling: fills in the fields that are dynamic."""

    PLUGIN_NAME = "custom"

    def update(self, metadata: dict) -> None:
        place = self.config["place"].rstrip("/")
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        metadata["urls"] = urls(place)
        metadata["readme"] = {"content-type": "text/markdown", "text": readme(text, place)}
