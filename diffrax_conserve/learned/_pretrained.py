"""The networks that come with the package."""

from pathlib import Path

from ._files import Network, load


def pretrained_path(name: str) -> Path:
    """The file of a network that comes with the package. Raises a `ValueError` for another name."""
    folder = Path(__file__).parents[1] / "pretrained"
    known = {file.stem: file for file in sorted(folder.glob("*.network"))}
    if str(name) not in known:
        raise ValueError(f"There is no pretrained network {name!r}. Known: {', '.join(known)}.")
    return known[name]


def load_pretrained(name: str) -> Network:
    """A network that comes with the package; raises a `ValueError` with the names for another one.

    For each of the paper's five systems there are `SYSTEM-standard` and, with a conservative layer,
    `SYSTEM-conservative`, trained by the paper's recipe; and `SYSTEM`, small and trained by
    [`diffrax_conserve.learned.second_order`][]. `kepler` is a flow map of orbits of eccentricities
    up to 0.6 and semi-major axes from 0.8; `pollu` and `robertson` are flow maps of stiff
    chemistry. The second line of each file, JSON, tells how it was made.

    !!! example

        ```python
        import diffrax_conserve as dfc

        dfc.load_pretrained("rigid-body")(1.0)
        ```
    """
    return load(pretrained_path(name))
