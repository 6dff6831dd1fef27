"""Networks in files: a line that names the format, a JSON header, and the arrays. No pickle.

diffrax-conserve network <version of the format> <SHA-256 of all that follows>
{"kind": "DeepONet", "config": {...}, "arrays": [{"shape": ..., "dtype": ...}, ...], ...}
<the arrays, little-endian, one after the other, compressed by zlib>
"""

import hashlib
import json
import math
import operator
import os
import zlib
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np

from . import systems
from ._files import replace_file
from ._manifold import is_entry
from ._network import (
    PINN,
    Concatenated,
    ConservativeLayer,
    DeepONet,
    Gated,
    MakeFrame,
    Product,
    Repeated,
    Taylor,
    activation_name,
    output_layer,
)
from .systems import AbstractSystem

_MAGIC = b"diffrax-conserve network"
_VERSION = 2
_SUFFIX = ".network"

_PathLike = str | os.PathLike[str]


def save(
    path: _PathLike, model: PINN | DeepONet | Repeated, *, info: dict[str, Any] | None = None
) -> None:
    """Writes a network with its configuration into one file.

    The file is replaced as a whole: whoever reads it sees the old one or the new one.

    **Arguments:**

    - `path`: where to write.
    - `model`: a [`diffrax_conserve.PINN`][] or a [`diffrax_conserve.DeepONet`][], the latter
        perhaps in a [`diffrax_conserve.Repeated`][]. Of a conservative layer whose manifold is that
        of a system of the catalogue, the system is written, and likewise of a Taylor polynomial and
        of a frame; other manifolds, vector fields and frames are functions, which no file can hold:
        give the layer, the polynomial or the frame again to [`diffrax_conserve.load`][].
    - `info`: what else to note, such as the system, the sampling domain, the recipe and the
        measured errors: anything that JSON can express. [`diffrax_conserve.read_info`][] reads it.

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
    repeated = isinstance(model, Repeated)
    inner = model.flow_map if repeated else model
    header = {**_describe(inner), "repeats": model.count if repeated else 1}
    header |= {"versions": _versions(), "info": info or {}}
    arrays = [np.asarray(x) for x in _arrays(inner)]
    header["arrays"] = [{"shape": list(x.shape), "dtype": x.dtype.name} for x in arrays]
    try:
        text = json.dumps(header, allow_nan=False).encode()
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"`info` must hold only what JSON can express, but {error}. Convert arrays by "
            "`.tolist()`, and leave NaN and infinity out."
        ) from error
    raw = b"".join(x.astype(x.dtype.newbyteorder("<")).tobytes() for x in arrays)
    rest = text + b"\n" + zlib.compress(raw, 9)
    first = b"%s %d %s\n" % (_MAGIC, _VERSION, hashlib.sha256(rest).hexdigest().encode())
    replace_file(Path(path), lambda temporary: temporary.write_bytes(first + rest))


def load(
    path: _PathLike,
    *,
    layer: ConservativeLayer | None = None,
    taylor: Taylor | None = None,
    frame: MakeFrame | None = None,
) -> PINN | DeepONet | Repeated:
    """Reads a network that [`diffrax_conserve.save`][] wrote.

    **Arguments:**

    - `path`: the file.
    - `layer`: the conservative layer, where the file cannot hold it: see
        [`diffrax_conserve.save`][].
    - `taylor`, `frame`: likewise the Taylor polynomial, and the function that finds the frame.

    **Returns:**

    The network, in the precision of the file; in float32 if `jax_enable_x64` is off.

    **Raises:**

    `ValueError` if the file is not one of ours, is truncated or damaged, was written by another
    version, or needs a `layer`, `taylor` or `frame`; `OSError` if it cannot be read.
    """
    header, raw = _read(Path(path))
    arrays = _split(header["arrays"], raw)
    # The parts that hold functions come last. A network cannot be built without its frame.
    given = {"layer": layer, "taylor": taylor, "frame": frame}
    count = len(arrays) - sum(_system_size(header.get(part)) for part in given)
    rest = iter(arrays[count:])
    parts = {name: _part(path, name, header.get(name), x, rest) for name, x in given.items()}
    own, static = eqx.partition(_without(_skeleton(header, parts["frame"])), eqx.is_array)
    model = eqx.combine(jtu.tree_unflatten(jtu.tree_structure(own), arrays[:count]), static)
    for name, part in parts.items():
        if part is not None:
            where = operator.attrgetter(_PLACES[name])
            model = eqx.tree_at(where, model, part, is_leaf=lambda x: x is None)
    repeats = header.get("repeats", 1)
    return model if repeats == 1 else Repeated(model, repeats)


def _system_size(found: Any) -> int:
    """How many arrays the system of a part has."""
    if found is None or found["system"] is None:
        return 0
    return len(jtu.tree_leaves(systems.get(found["system"])))


def _part(path: _PathLike, name: str, found: Any, given: Any, arrays: Iterator[jax.Array]) -> Any:
    """The layer, Taylor polynomial or frame: the one that was given, or that of a system."""
    what, example = _PARTS[name]
    if found is None:
        if given is not None:
            raise ValueError(f"The network in {path} has no {what}: leave `{name}` out.")
        return None
    if found["system"] is None:
        if given is None:
            raise ValueError(
                f"The network in {path} has a {what}, whose functions no file can hold. Give it "
                f"again: `load(path, {name}={example.format(**found)})`."
            )
        return given
    leaves, treedef = jtu.tree_flatten(systems.get(found["system"]))
    system = jtu.tree_unflatten(treedef, [next(arrays) for _ in leaves])
    if given is not None:
        return given
    if name == "layer":
        return ConservativeLayer(system.manifold, steps=found["steps"])
    if name == "frame":
        return system.frame  # pyright: ignore[reportAttributeAccessIssue]
    return Taylor(system.vector_field, found["order"])


# What the parts that hold functions are called, and how to build them again.
_PARTS = {
    "layer": ("conservative layer", "ConservativeLayer(manifold, steps={steps})"),
    "taylor": ("Taylor polynomial", "Taylor(vector_field, {order})"),
    "frame": ("frame", "frame"),
}
# Where in a network they are.
_PLACES = {"layer": "layer", "taylor": "taylor", "frame": "domain.frame"}


def read_info(path: _PathLike) -> dict[str, Any]:
    """What a file says about its network, without building it.

    **Arguments:**

    - `path`: the file.

    **Returns:**

    A dictionary: `kind` and `config` of the network, its `layer`, the `versions` that wrote it, and
    the `info` that was given to [`diffrax_conserve.save`][].

    **Raises:**

    As [`diffrax_conserve.load`][].

    !!! example

        ```python
        import diffrax_conserve as dfc

        found = dfc.read_info(dfc.pretrained_path("rigid-body-conservative"))
        print(found["info"]["command"])
        ```
    """
    header, _ = _read(Path(path))
    return header


def pretrained_path(name: str) -> Path:
    """The file of a network that comes with the package.

    **Arguments:**

    - `name`: as of [`diffrax_conserve.load_pretrained`][].

    **Raises:**

    `ValueError` for an unknown name, naming those that there are.
    """
    folder = Path(str(resources.files("diffrax_conserve"))) / "pretrained"
    path = folder / f"{name}{_SUFFIX}"
    if not path.is_file():
        known = sorted(file.stem for file in folder.glob(f"*{_SUFFIX}"))
        raise ValueError(
            f"There is no pretrained network called {name!r}. There are: {', '.join(known)}."
        )
    return path


def load_pretrained(name: str) -> PINN | DeepONet | Repeated:
    """A network that comes with the package.

    For each of the paper's five systems there are `SYSTEM-standard` and `SYSTEM-conservative`,
    trained by the paper's recipe, the latter with a conservative layer; and `SYSTEM`, small and
    trained by [`diffrax_conserve.second_order`][].
    [`diffrax_conserve.read_info`][] tells the command that made it and its measured errors.

    **Arguments:**

    - `name`: such as `"rigid-body"` or `"rigid-body-conservative"`.

    **Raises:**

    `ValueError` for an unknown name, naming those that there are.

    !!! example

        ```python
        import diffrax_conserve as dfc

        pinn = dfc.load_pretrained("rigid-body")
        pinn(1.0)
        ```
    """
    return load(pretrained_path(name))


# ---- The header ----


def _describe(model: PINN | DeepONet) -> dict[str, Any]:
    if isinstance(model, PINN):
        net = model.window(0).net
        config = {
            "t0": model.t0,
            "t1": model.t1,
            "state": _describe_state(model.y0),
            "windows": model.windows,
            "width": net.weights[0].shape[1],
            "depth": len(net.weights) - 1,
        }
    elif isinstance(model, DeepONet):
        net = output_layer(model.core)
        config = {
            "max_step": model.max_step,
            "state": _describe_state(model.state),
            **_describe_core(model),
        }
    else:
        raise TypeError(
            "`save` writes a `PINN` or a `DeepONet`, also in a `Repeated`, but was given a "
            f"{type(model).__name__}. For other Modules use `equinox.tree_serialise_leaves`."
        )
    activation = activation_name(net.activation)
    if activation is None:
        raise ValueError(
            "The activation function of this network has no name that a file could hold. Build the "
            'network with a named one, for example `activation="tanh"`.'
        )
    config |= {"activation": activation, "normalise": model.normalise}
    return {
        "kind": type(model).__name__,
        "config": config,
        "layer": _describe_layer(model.layer),
        "taylor": _describe_taylor(getattr(model, "taylor", None)),
        "frame": _describe_frame(getattr(model, "frame", None)),
    }


def _describe_core(model: DeepONet) -> dict[str, Any]:
    match model.core:
        case Product(branch=net):
            latent = net.weights[-1].shape[1] // model.core.size
            sizes = {"inputs": "product", "depth": len(net.weights) - 1, "latent": latent}
        case Concatenated(net=net):
            sizes = {"inputs": "concatenated", "depth": len(net.weights) - 1}
        case Gated(hidden=hidden):
            net = hidden[0]
            sizes = {"inputs": "gated", "depth": len(hidden)}
    return {"width": net.weights[0].shape[1], **sizes}


def _describe_taylor(taylor: Taylor | None) -> dict[str, Any] | None:
    if taylor is None:
        return None
    system = _field_system(taylor)
    return {"order": taylor.order, "system": None if system is None else system.name}


def _describe_frame(frame: MakeFrame | None) -> dict[str, Any] | None:
    if frame is None:
        return None
    system = _owner(frame)
    return {"system": None if system is None else system.name}


def _describe_layer(layer: ConservativeLayer | None) -> dict[str, Any] | None:
    if layer is None:
        return None
    system = _system_of(layer)
    return {"steps": layer.steps, "system": None if system is None else system.name}


def _system_of(layer: ConservativeLayer) -> AbstractSystem | None:
    """The system of the catalogue whose manifold the layer has."""
    entries = jtu.tree_leaves(layer.manifold, is_leaf=is_entry)
    owner = _owner(entries[0].fn)
    if owner is None or layer.args is not None:
        return None
    return owner if bool(eqx.tree_equal(layer.manifold, owner.manifold)) else None


def _field_system(taylor: Taylor) -> AbstractSystem | None:
    """The system of the catalogue whose vector field the polynomial has."""
    return _owner(taylor.vector_field) if taylor.args is None else None


def _owner(function: Any) -> AbstractSystem | None:
    """The system of the catalogue that `function` is a method of."""
    owner = getattr(function, "__self__", None)
    if not isinstance(owner, AbstractSystem):
        return None
    # Only what `systems.get` builds again.
    known = owner.name in systems.names() and type(systems.get(owner.name)) is type(owner)
    return owner if known else None


def _describe_state(y: Any) -> Any:
    match y:
        case None:
            return None
        case dict() if all(isinstance(key, str) for key in y):
            return {"dict": {key: _describe_state(value) for key, value in y.items()}}
        case list():
            return {"list": [_describe_state(value) for value in y]}
        case tuple() if type(y) is tuple:
            return {"tuple": [_describe_state(value) for value in y]}
        case jax.Array():
            return {"shape": list(y.shape), "dtype": y.dtype.name}
    raise TypeError(
        f"The state holds a {type(y).__name__}, which a file cannot describe. Use tuples, lists "
        "and dictionaries with strings as keys."
    )


def _build_state(description: Any) -> Any:
    match description:
        case None:
            return None
        case {"dict": items}:
            return {key: _build_state(value) for key, value in items.items()}
        case {"list": items}:
            return [_build_state(value) for value in items]
        case {"tuple": items}:
            return tuple(_build_state(value) for value in items)
    dtype = jax.dtypes.canonicalize_dtype(description["dtype"])
    return jnp.zeros(description["shape"], dtype)


def _skeleton(header: dict[str, Any], frame: MakeFrame | None) -> PINN | DeepONet:
    """A network of the right shape, with other weights, and without what holds functions but for
    the frame."""
    config = dict(header["config"])
    key = jr.key(0)
    if header["kind"] == "PINN":
        y0, t0, t1 = _build_state(config.pop("state")), config.pop("t0"), config.pop("t1")
        return PINN(y0, t0, t1, key=key, **config)
    if header["kind"] == "DeepONet":
        states = jtu.tree_map(lambda x: x[None], _build_state(config.pop("state")))
        return DeepONet(states, config.pop("max_step"), frame=frame, key=key, **config)
    raise ValueError(f"The file holds a network of the unknown kind {header['kind']!r}.")


def _versions() -> dict[str, str]:
    return {name: _version(name) for name in ("diffrax-conserve", "diffrax", "equinox", "jax")}


def _version(name: str) -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(name)
    except PackageNotFoundError:  # imported from a folder that is not installed
        return "unknown"


# ---- The arrays ----


def _arrays(model: PINN | DeepONet) -> list[Any]:
    """Those of the network itself, then the parameters of the systems of its layer, of its Taylor
    polynomial and of its frame."""
    layer, taylor, frame = (getattr(model, name, None) for name in _PARTS)
    owners = [
        None if layer is None else _system_of(layer),
        None if taylor is None else _field_system(taylor),
        None if frame is None else _owner(frame),
    ]
    own = jtu.tree_leaves(eqx.filter(_without(model), eqx.is_array))
    return [*own, *(x for owner in owners for x in jtu.tree_leaves(owner))]


def _without(model: PINN | DeepONet) -> Any:
    """The network without those parts that hold functions."""
    names = [name for name in _PARTS if getattr(model, name, None) is not None]

    def where(model: Any) -> list[Any]:
        return [operator.attrgetter(_PLACES[name])(model) for name in names]

    return eqx.tree_at(where, model, [None] * len(names)) if names else model


class _Entry(NamedTuple):
    shape: tuple[int, ...]
    dtype: np.dtype

    @property
    def size(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize


def _split(entries: list[dict[str, Any]], raw: bytes) -> list[jax.Array]:
    arrays, start = [], 0
    for item in entries:
        entry = _Entry(tuple(item["shape"]), np.dtype(item["dtype"]).newbyteorder("<"))
        piece = raw[start : start + entry.size]
        arrays.append(jnp.asarray(np.frombuffer(piece, entry.dtype).reshape(entry.shape)))
        start += entry.size
    return arrays


# ---- The file ----


def _read(path: Path) -> tuple[dict[str, Any], bytes]:
    content = path.read_bytes()
    first, _, rest = content.partition(b"\n")
    words = first[len(_MAGIC) :].split()
    if not content.startswith(_MAGIC + b" ") or len(words) != 2 or not words[0].isdigit():
        if content and (_MAGIC + b" ").startswith(content[: len(_MAGIC) + 1]):
            raise ValueError(f"The file {path} is truncated: it ends in its first line.")
        raise ValueError(
            f"The file {path} does not hold a network that `diffrax_conserve.save` wrote."
        )
    version, digest = int(words[0]), words[1].decode(errors="replace")
    if version > _VERSION:
        raise ValueError(
            f"The file {path} was written by a newer version of diffrax-conserve: its format is "
            f"{version}, and this version reads up to {_VERSION}. Upgrade diffrax-conserve."
        )
    if version < _VERSION:
        raise ValueError(
            f"The file {path} was written by a version of diffrax-conserve before the first "
            "release, which this version does not read. Train the network again."
        )
    if hashlib.sha256(rest).hexdigest() != digest:
        raise ValueError(
            f"The file {path} is truncated or damaged: its contents do not match its checksum. "
            "Copy or train it again."
        )
    text, _, compressed = rest.partition(b"\n")
    return json.loads(text), zlib.decompress(compressed)
