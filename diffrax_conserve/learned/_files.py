"""Files of networks: `save` and `load`. No pickle.

A file is a line `diffrax-conserve network <version> <SHA-256 of all that follows>`, a line of JSON
with the description of the network and the `info` of whoever saved it, and the bytes of its arrays.

There numbers, strings and `None` are themselves. All else is an object with one entry: a container
(`tuple`, `list`, `dict`), an `array` with its dtype and shape, an `activation` by name, a `method`
of a system of the catalogue, a part that must be `given` again, or a class of this package with its
fields. Reading calls only the checks of these classes.
"""

import dataclasses
import hashlib
import io
import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._manifold import Constraint, FirstIntegral, at_full_precision, evaluate
from .._tree import eps_of, ravel, tree_shapes, unravel
from ..systems._registry import CLASSES
from ._networks.cores import ACTIVATIONS, MLP, Concatenated, Gated, Product
from ._networks.deeponet import DeepONet
from ._networks.domain import Box, FramedBox, MakeFrame
from ._networks.flat import flatten
from ._networks.layer import ConservativeLayer
from ._networks.pinn import PINN
from ._networks.taylor import Taylor
from ._networks.wrappers import BoxCox, Repeated, Transformed
from ._replace_file import replace_file

PathLike = str | os.PathLike[str]
Network = PINN | DeepONet | Transformed | Repeated

_MAGIC, _VERSION = b"diffrax-conserve network ", 4
_NETWORKS = (PINN, DeepONet, Repeated, Transformed, BoxCox, Product, Concatenated, Gated, MLP)
_PARTS = (Box, FramedBox, ConservativeLayer, Taylor, FirstIntegral, Constraint)
_CLASSES: dict[str, Any] = {kind.__name__: kind for kind in (*_NETWORKS, *_PARTS, *CLASSES)}
_DTYPES = ("float64", "float32", "float16", "bfloat16", "int64", "int32", "bool")
# No network needs more. It limits what a small file can make this package compute.
_INTEGER_MAX = 100_000
# Fields that must be of a certain class, because a network is built without its `__init__`.
_KINDS = {"layer": ConservativeLayer | None, "taylor": Taylor | None, "transformation": BoxCox}
# The fields with functions, of which `load` can be given the whole part: for each, the attribute
# that must agree, and the argument of `load`.
_GIVEN = {
    "layer": ("steps", "layer=ConservativeLayer(manifold, steps={})"),
    "taylor": ("order", "taylor=Taylor(vector_field, {})"),
    "make": ("", "frame=frame"),
}


def save(path: PathLike, model: Network, *, info: dict[str, Any] | None = None) -> None:
    """Writes a network into one file, which is replaced atomically.

    **Arguments:**

    - `path`: where to write.
    - `model`: a [`diffrax_conserve.PINN`][] or a [`diffrax_conserve.DeepONet`][], the latter also
        in [`diffrax_conserve.learned.Transformed`][] (with a `BoxCox`) or `Repeated`. Methods of a
        system of the catalogue are stored by name; a layer, polynomial or frame with other
        functions must be passed to [`diffrax_conserve.load`][] again.
    - `info`: notes for whoever reads the file, which JSON can express. They are in its second line,
        which is JSON.

    **Raises:**

    `TypeError` or `ValueError` if `model` is another network, has an activation without a name or a
    state of custom PyTree nodes, or if JSON cannot express `info`.

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
    header = {"network": _describe(model, arrays), "info": info or {}}
    _check(model)
    network: Any = _unwrapped(model)
    if "given" in (_describe_field("layer", network.layer, []) or ()):
        header["gradients"] = _finite(_gradients(network))
    if isinstance(network, DeepONet) and network.taylor is not None:
        header["slope"] = _finite(_slope(network))
    text = json.dumps(header, allow_nan=False).encode()
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
    """Reads a network that [`diffrax_conserve.save`][] wrote; in float32 without `jax_enable_x64`.

    **Arguments:**

    - `path`: the file.
    - `layer`, `taylor`, `frame`: the parts of the network that are not in the file.

    **Raises:**

    `ValueError` if the file is not of this version, is truncated or damaged, or needs a `layer`,
    `taylor` or `frame`, or if the vector field of `taylor` or the gradients of the functions of
    `layer` are not those of the saved network, at a state of its domain (a file of an earlier
    version does not tell gradients); `OSError` if it cannot be read.
    """
    given = {"layer": layer, "taylor": taylor, "make": frame}

    def build(header: Any, body: io.BytesIO) -> Any:
        model = _build(header["network"], body, given)
        if body.read(1):
            raise ValueError("it has data after the last array")
        _check(model)
        network: Any = _unwrapped(model)
        if taylor is not None and (slope := header.get("slope")) is not None:
            _check_same("vector field of `taylor`", _slope, network, slope, "field")
        if layer is not None and (gradients := header.get("gradients")) is not None:
            _check_same("Jacobian of `layer`", _gradients, network, gradients, "manifold")
        return model

    model = _read(path, build)
    if unused := [_GIVEN[name][1] for name, part in given.items() if part is not None]:
        raise ValueError(f"The file {path} has parts of its own: leave `{unused[0]}` out.")
    return model


def read_info(path: PathLike) -> dict[str, Any]:
    """What the file `path` says about its network, without building it: a dictionary of the `info`
    that was given to `save`, and the `network`. Raises as `load`."""
    return _read(path, lambda header, body: header)


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


def _read(path: PathLike, use: Callable[[Any, io.BytesIO], Any]) -> Any:
    """What `use` makes of the description and the bytes of the arrays."""
    first, _, rest = _file(path).read_bytes().partition(b"\n")
    version, _, digest = first.removeprefix(_MAGIC).partition(b" ")
    if not first.startswith(_MAGIC) or not version.isdigit():
        raise ValueError(f"{path} holds no network that `save` wrote, or is truncated.")
    if version != b"%d" % _VERSION:
        raise ValueError(
            f"The file {path} has format {version.decode()[:9]}, but this version reads "
            f"{_VERSION}. Upgrade diffrax-conserve, or read it with the version that wrote it."
        )
    if hashlib.sha256(rest).hexdigest().encode() != digest:
        raise ValueError(f"The file {path} is truncated or damaged: its checksum is another.")
    text, _, body = rest.partition(b"\n")
    try:
        header = json.loads(text)
        if set(header) - {"slope", "gradients"} != {"network", "info"}:
            raise ValueError("its second line does not describe a network")
        return use(header, io.BytesIO(body))
    except _NotGiven:
        raise
    except Exception as error:  # whatever it is, the contents of the file are the cause
        raise ValueError(
            f"The file {path} is malformed, though its checksum is right: "
            f"{type(error).__name__}, {str(error)[:300]}."
        ) from error


def _file(path: Any) -> Path:
    known = isinstance(path, str | os.PathLike)
    if not known or (Path(path).exists() and not Path(path).is_file()):
        raise ValueError(f"`path` is {path!r}, but it must be the path of a file.")
    return Path(path)


class _NotGiven(ValueError):
    """A part of the network is neither in the file nor passed to `load`, or is another one."""


def _describe(x: Any, arrays: list[np.ndarray]) -> Any:
    """The description of `x`, whose arrays are appended to `arrays`."""
    kind = type(x)
    if x is None or kind in (bool, int, float, str):
        return x
    if kind in (list, tuple):
        return {kind.__name__: [_describe(item, arrays) for item in x]}
    if kind is dict and all(isinstance(key, str) for key in x):
        return {"dict": {key: _describe(x[key], arrays) for key in x}}
    if isinstance(x, jax.Array) and x.dtype.name in _DTYPES:
        arrays.append(np.asarray(x))
        return {"array": [x.dtype.name, *x.shape]}
    if names := [name for name, function in ACTIVATIONS.items() if function is x]:
        return {"activation": names[0]}
    owner, name = getattr(x, "__self__", None), getattr(x, "__name__", "")
    if owner is not None and _method(owner, name) == x:
        return {"method": [name, _describe(owner, arrays)]}
    if _CLASSES.get(kind.__name__) is kind:
        names = [field.name for field in dataclasses.fields(_CLASSES[kind.__name__])]
        return {kind.__name__: {f: _describe_field(f, getattr(x, f), arrays) for f in names}}
    raise TypeError(
        f"The network holds {x!r:.200}, which a file cannot describe: neither a number, array, "
        "string, tuple, list, dictionary or named activation function, nor a part of a `PINN` or "
        "`DeepONet` of this package. Use `equinox.tree_serialise_leaves`."
    )


def _describe_field(field: str, value: Any, arrays: list[np.ndarray]) -> Any:
    count = len(arrays)
    try:
        return _describe(value, arrays)
    except TypeError:
        if field not in _GIVEN:
            raise
        del arrays[count:]
        return {"given": [field, getattr(value, _GIVEN[field][0], None)]}


def _method(system: Any, name: str) -> Any:
    """The public method called `name` of a system of the catalogue, or `None`."""
    known = type(system) in CLASSES and not name.startswith("_")
    return getattr(system, name) if known and callable(getattr(type(system), name, 0)) else None


def _build(described: Any, body: io.BytesIO, given: dict[str, Any]) -> Any:
    """What is described. Arrays are read from `body`, and used parts are taken out of `given`."""
    if described is None or type(described) in (bool, int, float, str):
        if type(described) is int and abs(described) > _INTEGER_MAX:
            raise ValueError(f"the number {described:.3g} is too large")
        return described
    ((kind, content),) = described.items()
    match kind:
        case "list" | "tuple":
            items = [_build(item, body, given) for item in content]
            return items if kind == "list" else tuple(items)
        case "dict":
            return {key: _build(item, body, given) for key, item in content.items()}
        case "array":
            return _array(body, *content)
        case "activation":
            return ACTIVATIONS[content]
        case "method":
            return _method(_build(content[1], body, given), content[0])
        case "given":
            field, number = content
            attribute, argument = _GIVEN[field]
            part, given[field] = given[field], None
            if part is None or getattr(part, attribute, None) != number:
                call = f"load(path, {argument.format(str(number)[:20])})"
                raise _NotGiven(f"A file cannot hold all functions. Give them again: `{call}`.")
            return part
    return _module(_CLASSES[kind], {f: _build(x, body, given) for f, x in content.items()})


def _array(body: io.BytesIO, name: str, *shape: int) -> jax.Array:
    dtype = np.dtype(jnp.dtype(_DTYPES[_DTYPES.index(name)]))
    # The factors of an empty array could be of any size.
    size = dtype.itemsize * math.prod(max(n, 1) for n in shape)
    if min(shape, default=0) < 0 or size > 8 + len(body.getbuffer()):
        raise ValueError("its arrays are larger than the file")
    data = body.read(dtype.itemsize * math.prod(shape))
    return jnp.asarray(np.frombuffer(data, dtype).reshape(shape))


def _module(kind: Any, fields: dict[str, Any]) -> Any:
    # Files of earlier versions tell that the inputs are normalised, as they always are, and do not
    # know the algorithm as printed.
    names = [field.name for field in dataclasses.fields(kind)]
    if kind is ConservativeLayer:
        fields.setdefault("as_printed", False)
    if fields.pop("normalise", True) is not True or list(fields) != names:
        raise ValueError(f"a {kind.__name__} has other fields")
    module = object.__new__(kind)
    for name, value in fields.items():
        if not isinstance(value, _KINDS.get(name, object)):
            raise TypeError(f"its `{name}` is something else")
        object.__setattr__(module, name, value)
    for parent in kind.__mro__:
        vars(parent).get("__check_init__", lambda _: None)(module)
    return module


def _check(model: Any) -> None:
    """Raises unless `model` is a network whose arrays fit together. Nothing is computed."""
    model = _unwrapped(model)
    if isinstance(model, PINN):
        if any(len(x) != model.windows for x in jax.tree.leaves((model.nets, model.y0s))):
            raise ValueError("it has not one network for each window")
        eqx.filter_eval_shape(lambda pinn: pinn.window(0).candidate(pinn.t0), model)
    elif isinstance(model, DeepONet):
        # A polynomial of high order takes long to trace.
        model = eqx.tree_at(lambda m: m.taylor, model, None, is_leaf=lambda x: x is None)
        known = () if model.args_domain is None else (model.args_domain.lower,)
        eqx.filter_eval_shape(DeepONet.candidate, model, model.state, *known, model.max_step)
    else:
        raise TypeError(f"`model` is a {type(model).__name__}, but must be a `PINN` or `DeepONet`")


def _unwrapped(model: Any) -> Any:
    while isinstance(model, Repeated | Transformed):
        model = model.flow_map
    return model


def _slope(network: DeepONet) -> np.ndarray:
    """The vector field of the Taylor polynomial at one state."""
    taylor, y = network.taylor, _state(network)
    assert taylor is not None
    args = taylor.args if network.args_domain is None else network.args_domain.lower
    return np.asarray(flatten(at_full_precision(taylor.vector_field, 0.0, y, args)), float)


def _gradients(network: Network) -> np.ndarray:
    """The gradients of the functions of the layer at one state."""
    layer: Any = network.layer
    y = _state(network)
    vector = ravel(y)
    values = lambda x: ravel(evaluate(layer.manifold, 0.0, unravel(x, y), layer.args))  # noqa: E731
    return np.asarray(jax.jacfwd(values)(vector), float)


def _state(network: Any) -> Any:
    """A state of the domain, not its centre, where fields often vanish; of a `PINN` its first."""
    if isinstance(network, PINN):
        return jax.tree.map(lambda y: y[0], network.y0s)
    if isinstance(domain := network.domain, Box):
        return jax.tree.map(lambda a, b: 0.6 * a + 0.4 * b, domain.lower, domain.upper)
    return network.state


def _finite(x: np.ndarray) -> list[Any] | None:
    return x.tolist() if np.all(np.isfinite(x)) else None


def _check_same(
    what: str, of: Callable[[Any], np.ndarray], network: Any, saved: Any, remedy: str
) -> None:
    passed = f"Pass the {remedy}, and its `args`, for which the network was trained."
    saved, y = np.asarray(saved, float), _state(network)
    try:
        found = of(network)
    except Exception as error:  # whatever it is, the function of the user is the cause
        raise _NotGiven(
            f"The {what} cannot be computed at a state like {tree_shapes(y)}, as the saved network "
            f"has: {type(error).__name__}, {str(error)[:300]}. {passed}"
        ) from error
    limit = eps_of(ravel(y)) ** 0.5 * np.max(np.abs(saved), initial=0)
    if found.shape != saved.shape or not np.max(np.abs(found - saved), initial=0) <= limit:
        raise _NotGiven(
            f"The {what} is {found} at a state where the saved network has {saved}. {passed}"
        )
