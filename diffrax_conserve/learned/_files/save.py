"""Saving and loading networks: `save`, `load` and `read_info`. No pickle.

A file is a line `diffrax-conserve network <version> <SHA-256 of all that follows>`, a line of JSON
with the description of the network, and the bytes of its arrays.
"""

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from ..._replace_file import replace_file
from .._networks.deeponet import DeepONet
from .._networks.frame import MakeFrame
from .._networks.layer import ConservativeLayer
from .._networks.pinn import PINN
from .._networks.taylor import Taylor
from .._networks.wrappers import Repeated, Transformed
from .describe import NotGiven, Reader, check, describe

PathLike = str | os.PathLike[str]
Network = PINN | DeepONet | Transformed | Repeated

_MAGIC, _VERSION = b"diffrax-conserve network ", 4


def save(path: PathLike, model: Network, *, info: dict[str, Any] | None = None) -> None:
    """Writes a network with its configuration into one file.

    The file is replaced atomically: a reader sees either the old or the new one. Its mode is kept,
    and so is a symbolic link to it.

    **Arguments:**

    - `path`: where to write.
    - `model`: a [`diffrax_conserve.PINN`][] or a [`diffrax_conserve.DeepONet`][]. A `DeepONet` may
        be wrapped in a [`diffrax_conserve.learned.Transformed`][] with a
        [`diffrax_conserve.learned.BoxCox`][], and in a [`diffrax_conserve.learned.Repeated`][]. A
        conservative layer, a Taylor polynomial and a frame contain functions. Those of a system of
        the catalogue are stored by name; otherwise pass the part again to
        [`diffrax_conserve.load`][].
    - `info`: further information that JSON can express, such as the system, the sampling domain,
        the recipe and the measured errors. [`diffrax_conserve.learned.read_info`][] returns it.

    **Raises:**

    `TypeError` or `ValueError` if `model` is another kind of network, has an activation function
    without a name, a state of custom PyTree nodes, or `info` is not expressible in JSON.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax
        import jax.numpy as jnp

        pinn = dfc.PINN(jnp.array([1.0, 0.0]), 0.0, 3.0, key=jax.random.key(0))
        dfc.save("pinn.network", pinn, info={"made by": "an example"})
        assert dfc.load("pinn.network")(2.0)[0] == pinn(2.0)[0]
        ```
    """
    path, arrays = _file(path), []
    network = describe(model, arrays)
    check(model)
    try:
        text = json.dumps({"network": network, "info": info or {}}, allow_nan=False).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(
            f"`info` must hold only what JSON can express, but {error}. Convert arrays by "
            "`.tolist()`, and leave NaN and infinity out."
        ) from error
    rest = b"".join([text, b"\n", *(x.tobytes() for x in arrays)])
    first = b"%s%d %s\n" % (_MAGIC, _VERSION, hashlib.sha256(rest).hexdigest().encode())
    replace_file(path, lambda temporary: temporary.write_bytes(first + rest))


def load(
    path: PathLike,
    *,
    layer: ConservativeLayer | None = None,
    taylor: Taylor | None = None,
    frame: MakeFrame | None = None,
) -> Network:
    """Reads a network that [`diffrax_conserve.save`][] wrote.

    **Arguments:**

    - `path`: the file.
    - `layer`: the conservative layer, if it is not stored in the file: see
        [`diffrax_conserve.save`][].
    - `taylor`, `frame`: likewise the Taylor polynomial, and the function that finds the frame.

    **Returns:**

    The network, in the precision of the file; in float32 if `jax_enable_x64` is off.

    **Raises:**

    `ValueError` if the file was not written by `save`, is truncated or damaged, was written by
    another version, or needs a `layer`, `taylor` or `frame`; `OSError` if it cannot be read.
    """
    header, body = _read(path)
    given = {"layer": layer, "taylor": taylor, "make": frame}
    reader = Reader(body, {name: part for name, part in given.items() if part is not None})
    try:
        model = reader.build(header["network"])
        if reader.used != len(body):
            raise ValueError("it has data after the last array")
        check(model)
    except NotGiven as error:
        raise ValueError(f"The network in {path} {error}") from None
    except Exception as error:
        raise _malformed(path, error) from error
    for name in reader.given:
        argument = "frame" if name == "make" else name
        raise ValueError(f"The file {path} needs no {argument}: leave `{argument}` out.")
    return model


def read_info(path: PathLike) -> dict[str, Any]:
    """What a file says about its network, without building it.

    **Arguments:**

    - `path`: the file.

    **Returns:**

    A dictionary with the `info` that was given to [`diffrax_conserve.save`][], and the description
    of the `network`.

    **Raises:**

    As [`diffrax_conserve.load`][].

    !!! example

        ```python
        import diffrax_conserve as dfc

        found = dfc.learned.read_info(dfc.learned.pretrained_path("rigid-body-conservative"))
        print(found["info"]["command"])
        ```

        ```text
        python benchmarks/learned/paper.py --system rigid-body --seed 0 --ship
        ```
    """
    return _read(path)[0]


def pretrained_path(name: str) -> Path:
    """The file of a network that comes with the package.

    **Arguments:**

    - `name`: as for [`diffrax_conserve.load_pretrained`][].

    **Raises:**

    `ValueError` for an unknown name; the message lists the known names.
    """
    folder = Path(__file__).parents[2] / "pretrained"
    known = {file.stem: file for file in sorted(folder.glob("*.network"))}
    if name not in known:
        raise ValueError(
            f"There is no pretrained network called {name!r}. There are: {', '.join(known)}."
        )
    return known[name]


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


def _read(path: PathLike) -> tuple[Any, bytes]:
    """The header of a file, and the bytes of the arrays."""
    first, _, rest = _file(path).read_bytes().partition(b"\n")
    version, _, digest = first.removeprefix(_MAGIC).partition(b" ")
    if not first.startswith(_MAGIC) or not version.isdigit():
        raise ValueError(
            f"{path} does not hold a network that `diffrax_conserve.save` wrote, or is truncated."
        )
    if version != b"%d" % _VERSION:
        raise ValueError(
            f"The file {path} has format {version.decode()[:9]}, but this version of "
            f"diffrax-conserve reads {_VERSION}. For a newer one upgrade diffrax-conserve; how to "
            "convert an older one is in the changelog."
        )
    if hashlib.sha256(rest).hexdigest().encode() != digest:
        raise ValueError(
            f"The file {path} is truncated or damaged: its contents do not match its checksum. "
            "Copy or train it again."
        )
    text, _, body = rest.partition(b"\n")
    try:
        header = json.loads(text)
        if set(header) != {"network", "info"}:
            raise ValueError("its second line does not describe a network")
    except (ValueError, TypeError, RecursionError) as error:
        raise _malformed(path, error) from error
    return header, body


def _malformed(path: PathLike, error: Exception) -> ValueError:
    return ValueError(
        f"The file {path} is malformed, though its checksum is right: "
        f"{type(error).__name__}, {str(error)[:300]}. `diffrax_conserve.save` does not write such "
        "files."
    )


def _file(path: Any) -> Path:
    if not isinstance(path, str | os.PathLike):
        raise TypeError(f"`path` is {path!r}, but it must be the name of a file.")
    path = Path(path)
    if path.exists() and not path.is_file():
        raise ValueError(f"{path} is a folder or a device, but it must be a file.")
    return path
