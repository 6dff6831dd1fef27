"""Files of networks: `save`, `load` and `read_info`. No pickle.

A file is a line `diffrax-conserve network <version> <SHA-256 of all that follows>`, a line of JSON
with the description of the network, and the bytes of its arrays.

In a description numbers, strings and `None` are themselves. Everything else is an object with one
entry: a container (`tuple`, `list`, `dict`), an `array` with its dtype and shape, an `activation`
by name, a `method` of a system of the catalogue, a part that must be `given` again, or a class of
this package with its fields. So reading calls no function but the checks of these classes. A field
that is renamed is another format.
"""

import dataclasses
import hashlib
import json
import math
import os
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._manifold import Constraint, FirstIntegral
from .._replace_file import replace_file
from ..systems import AbstractSystem
from ..systems._registry import CLASSES
from ._networks.cores import ACTIVATIONS, MLP, Concatenated, Gated, Product
from ._networks.deeponet import DeepONet
from ._networks.domain import Box, FramedBox, MakeFrame
from ._networks.layer import ConservativeLayer
from ._networks.pinn import PINN
from ._networks.taylor import Taylor
from ._networks.wrappers import BoxCox, Repeated, Transformed

PathLike = str | os.PathLike[str]
Network = PINN | DeepONet | Transformed | Repeated

_MAGIC, _VERSION = b"diffrax-conserve network ", 4
_NETWORKS = (PINN, DeepONet, Repeated, Transformed, BoxCox, Product, Concatenated, Gated, MLP)
_PARTS = (Box, FramedBox, ConservativeLayer, Taylor, FirstIntegral, Constraint)
_CLASSES: dict[str, Any] = {kind.__name__: kind for kind in (*_NETWORKS, *_PARTS, *CLASSES)}
_DTYPES = ("float64", "float32", "float16", "bfloat16", "int64", "int32", "bool")
# No network needs more. They limit what a small file can make this package allocate.
_ARRAYS_MAX, _INTEGER_MAX = 1000, 100_000

# The fields with functions, of which `load` can be given the whole part: for each, the attribute
# that must agree, and the argument of `load`.
_GIVEN = {
    "layer": ("steps", "layer=ConservativeLayer(manifold, steps={})"),
    "taylor": ("order", "taylor=Taylor(vector_field, {})"),
    "make": ("", "frame=frame"),
}


def save(path: PathLike, model: Network, *, info: dict[str, Any] | None = None) -> None:
    """Writes a network with its configuration into one file, which is replaced atomically.

    **Arguments:**

    - `path`: where to write.
    - `model`: a [`diffrax_conserve.PINN`][] or a [`diffrax_conserve.DeepONet`][]; the latter also
        in a [`diffrax_conserve.learned.Transformed`][] with a
        [`diffrax_conserve.learned.BoxCox`][], and in a [`diffrax_conserve.learned.Repeated`][]. A
        conservative layer, a Taylor polynomial and a frame contain functions. Those of a system of
        the catalogue are stored by name; others must be passed to [`diffrax_conserve.load`][]
        again.
    - `info`: further information that JSON can express, such as the recipe and the measured errors,
        for [`diffrax_conserve.learned.read_info`][].

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
    network = _describe(model, arrays)
    _check(model)
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
    - `layer`, `taylor`, `frame`: the conservative layer, the Taylor polynomial, and the function
        that finds the frame, if they are not stored in the file: see [`diffrax_conserve.save`][].

    **Returns:**

    The network, in the precision of the file; in float32 if `jax_enable_x64` is off.

    **Raises:**

    `ValueError` if the file was not written by `save`, is truncated or damaged, was written by
    another version, or needs a `layer`, `taylor` or `frame`; `OSError` if it cannot be read.
    """
    header, body = _read(path)
    given = {"layer": layer, "taylor": taylor, "make": frame}
    reader = _Reader(body, {name: part for name, part in given.items() if part is not None})
    try:
        model = reader.build(header["network"])
        if reader.used != len(body):
            raise ValueError("it has data after the last array")
        _check(model)
    except _NotGiven as error:
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
    folder = Path(__file__).parents[1] / "pretrained"
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
    `robertson` are flow maps of stiff chemistry. [`diffrax_conserve.learned.read_info`][] returns
    the command that made the network and its measured errors.

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


# ---- The file ----


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


# ---- The description ----


class _NotGiven(ValueError):
    """A part of the network is neither in the file nor passed to `load`."""


def _describe(x: Any, arrays: list[np.ndarray]) -> Any:
    """The description of `x`, whose arrays are appended to `arrays`."""
    if x is None or type(x) in (bool, int, float, str):
        return x
    if type(x) in (list, tuple):
        return {type(x).__name__: [_describe(item, arrays) for item in x]}
    if type(x) is dict and all(isinstance(key, str) for key in x):
        return {"dict": {key: _describe(x[key], arrays) for key in x}}
    if isinstance(x, jax.Array) and x.dtype.name in _DTYPES:
        arrays.append(np.asarray(x))
        return {"array": [x.dtype.name, *x.shape]}
    if names := [name for name, function in ACTIVATIONS.items() if function is x]:
        return {"activation": names[0]}
    owner, name = getattr(x, "__self__", None), getattr(x, "__name__", "")
    if isinstance(owner, AbstractSystem) and _method(owner, name) == x:
        return {"method": [name, _describe(owner, arrays)]}
    kind = type(x)
    if _CLASSES.get(kind.__name__) is kind:
        return {kind.__name__: {f: _describe_field(x, f, arrays) for f in _fields(kind)}}
    raise TypeError(
        f"The network holds {x!r:.200}, which a file cannot describe. It can hold a `PINN` or a "
        "`DeepONet`, also `Transformed` by a `BoxCox` or `Repeated`, with an activation function "
        'that has a name, such as `activation="tanh"`, and a state of tuples, lists, and '
        "dictionaries with strings as keys. For others use `equinox.tree_serialise_leaves`."
    )


def _describe_field(x: Any, field: str, arrays: list[np.ndarray]) -> Any:
    value, count = getattr(x, field), len(arrays)
    try:
        return _describe(value, arrays)
    except TypeError:
        if field not in _GIVEN:
            raise
        del arrays[count:]
        return {"given": [field, getattr(value, _GIVEN[field][0], None)]}


def _fields(kind: Any) -> list[str]:
    return [field.name for field in dataclasses.fields(kind)]


def _method(system: Any, name: str) -> Any:
    """The public method called `name` of a system of the catalogue, or `None`."""
    known = type(system) in CLASSES and not name.startswith("_")
    return getattr(system, name) if known and callable(getattr(type(system), name, 0)) else None


class _Reader:
    """Builds what a description and the bytes after it describe. Raises if anything is wrong."""

    def __init__(self, data: bytes, given: dict[str, Any]):
        self.data, self.given = data, given
        self.used, self.arrays = 0, 0

    def build(self, described: Any) -> Any:
        if type(described) is int and abs(described) > _INTEGER_MAX:
            raise ValueError(f"the number {described:.3g} is too large")
        if described is None or type(described) in (bool, int, float, str):
            return described
        assert isinstance(described, dict)
        ((kind, content),) = described.items()
        match kind:
            case "list" | "tuple":
                items = [self.build(item) for item in content]
                return items if kind == "list" else tuple(items)
            case "dict":
                return {key: self.build(item) for key, item in content.items()}
            case "array":
                return self._array(*content)
            case "activation":
                return ACTIVATIONS[content]
            case "method":
                name, system = content
                return _method(self.build(system), name)
            case "given":
                return self._part(*content)
        return self._module(_CLASSES[kind], content)

    def _part(self, field: str, number: Any) -> Any:
        attribute, argument = _GIVEN[field]
        part = self.given.pop(field, None)
        if part is None or getattr(part, attribute, None) != number:
            raise _NotGiven(
                "has functions that no file can hold. Give them again: "
                f"`load(path, {argument.format(str(number)[:20])})`."
            )
        return part

    def _array(self, name: str, *shape: int) -> jax.Array:
        dtype, count = np.dtype(jnp.dtype(_DTYPES[_DTYPES.index(name)])), math.prod(shape)
        self.arrays += 1
        # The factors of an empty array could be of any size.
        size = math.prod(max(n, 1) for n in shape) * dtype.itemsize
        if min(shape, default=0) < 0 or size > 8 + len(self.data) or self.arrays > _ARRAYS_MAX:
            raise ValueError("its arrays are larger than the file, or too many")
        found = np.frombuffer(self.data, dtype, count, self.used).reshape(shape)
        self.used += count * dtype.itemsize
        return jnp.asarray(found)

    def _module(self, kind: Any, content: Any) -> Any:
        if list(content) != _fields(kind):
            raise ValueError(f"a {kind.__name__} has other fields")
        module = object.__new__(kind)
        for name, described in content.items():
            object.__setattr__(module, name, self.build(described))
        for parent in kind.__mro__:
            vars(parent).get("__check_init__", lambda _: None)(module)
        return module


def _check(model: Any) -> None:
    """Raises unless `model` is a network whose arrays fit together. Nothing is computed."""
    while isinstance(model, Repeated | Transformed):
        if not isinstance(getattr(model, "transformation", BoxCox()), BoxCox):
            raise TypeError("it is in unknown coordinates")
        model = model.flow_map
    if isinstance(model, PINN):
        if any(len(x) != model.windows for x in jax.tree.leaves((model.nets, model.y0s))):
            raise ValueError("it has not one network for each window")
        kinds, like, arguments = {"layer": ConservativeLayer}, model.y0, (model.t0,)
    elif isinstance(model, DeepONet):
        kinds, like = {"layer": ConservativeLayer, "taylor": Taylor}, model.state
        known = () if model.args_domain is None else (model.args_domain.lower,)
        arguments = (like, *known, model.max_step)
    else:
        raise TypeError(f"`model` is a {type(model).__name__}, but must be a `PINN` or `DeepONet`")
    for name, kind in kinds.items():
        if not isinstance(getattr(model, name), kind | None):
            raise TypeError(f"its `{name}` is something else")
    # A polynomial of high order takes long to trace.
    where = lambda m: [getattr(m, name) for name in kinds]  # noqa: E731
    bare = eqx.tree_at(where, model, [None] * len(kinds), is_leaf=lambda x: x is None)
    found = eqx.filter_eval_shape(bare, *arguments)
    if jax.tree.map(jnp.shape, found) != jax.tree.map(jnp.shape, like):
        raise ValueError("the output is not of the shape of a state")
