"""The networks that come with the package."""

from importlib import resources
from pathlib import Path

from .save import Network, load

_SUFFIX = ".network"


def pretrained_path(name: str) -> Path:
    """The file of a network that comes with the package.

    **Arguments:**

    - `name`: as for [`diffrax_conserve.load_pretrained`][].

    **Raises:**

    `ValueError` for an unknown name; the message lists the known names.
    """
    folder = Path(str(resources.files("diffrax_conserve"))) / "pretrained"
    known = sorted(file.stem for file in folder.glob(f"*{_SUFFIX}"))
    if name not in known:
        raise ValueError(
            f"There is no pretrained network called {name!r}. There are: {', '.join(known)}."
        )
    return folder / f"{name}{_SUFFIX}"


def load_pretrained(name: str) -> Network:
    """A network that comes with the package.

    For each of the paper's five systems there are `SYSTEM-standard` and `SYSTEM-conservative`,
    trained by the paper's recipe, the latter with a conservative layer; and `SYSTEM`, small and
    trained by [`diffrax_conserve.learned.second_order`][]. `kepler` is a flow map of orbits of
    eccentricities up to 0.6 and semi-major axes from 0.8, for steps of up to 0.5; `pollu` and
    `robertson` are flow maps of stiff chemistry.
    [`diffrax_conserve.learned.read_info`][] returns the command that made the network and its
    measured errors.

    **Arguments:**

    - `name`: such as `"rigid-body"` or `"rigid-body-conservative"`.

    **Raises:**

    `ValueError` for an unknown name; the message lists the known names.

    !!! example

        ```python
        import diffrax_conserve as dfc

        pinn = dfc.load_pretrained("rigid-body")
        pinn(1.0)
        ```
    """
    return load(pretrained_path(name))
