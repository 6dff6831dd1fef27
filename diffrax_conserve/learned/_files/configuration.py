"""The header of a file: the configuration from which a network is rebuilt."""

import math
import types
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import equinox as eqx
import jax
import jax.random as jr
import jax.tree_util as jtu

from ... import systems
from ..._manifold import is_entry
from ...systems import AbstractSystem
from .._networks.cores import Concatenated, Gated, Product
from .._networks.deeponet import DeepONet
from .._networks.domain import Box
from .._networks.frame import MakeFrame
from .._networks.layer import ConservativeLayer
from .._networks.mlp import activation_name
from .._networks.pinn import PINN
from .._networks.taylor import Taylor

_CORES = {core.__name__: core for core in (Product, Concatenated, Gated)}
# The parts that contain functions. A file stores the name of the system to which they belong.
PARTS = ("layer", "taylor", "frame")


# ---- Writing ----


def describe(model: Any) -> dict[str, Any]:
    """The configuration of a network, without its weights."""
    if not isinstance(model, PINN | DeepONet):
        raise TypeError(
            "`save` writes a `PINN` or a `DeepONet`, also `Transformed` by a `BoxCox`, and in a "
            f"`Repeated`, but was given a {type(model).__name__}. For other Modules use "
            "`equinox.tree_serialise_leaves`."
        )
    width, depth, latent, function = model.sizes
    activation = activation_name(function)
    if activation is None:
        raise ValueError(
            "The activation function of this network has no name that a file could hold. Build the "
            'network with a named one, for example `activation="tanh"`.'
        )
    config = {"width": width, "depth": depth, "activation": activation}
    config |= {"normalise": model.normalise}
    if isinstance(model, PINN):
        config |= {"t0": model.t0, "t1": model.t1, "windows": _describe_windows(model)}
        config |= {"state": _describe_state(model.y0)}
    else:
        core = type(model.core)
        if _CORES.get(core.__name__) is not core:
            raise ValueError(f"A file cannot hold a core of the user's own, `{core.__name__}`.")
        config |= {"latent": latent, "core": core.__name__, "max_step": model.max_step}
        config |= {"state": _describe_state(model.state)}
        if model.args_domain is not None:
            config |= {"args": _describe_state(model.args_domain.lower)}
    return {"kind": type(model).__name__, "config": config, **_describe_parts(model)}


def _describe_windows(pinn: PINN) -> int | list[float]:
    """The number of windows, or their interior boundaries if they are not of equal length."""
    same = PINN(pinn.y0, pinn.t0, pinn.t1, windows=pinn.windows, width=1, depth=1, key=jr.key(0))
    return pinn.windows if same.edges == pinn.edges else list(pinn.edges[1:-1])


def _describe_parts(model: PINN | DeepONet) -> dict[str, Any]:
    owners = part_systems(model)
    found = {name: getattr(model, name, None) for name in PARTS}
    options = {
        "layer": lambda layer: {"steps": layer.steps},
        "taylor": lambda taylor: {"order": taylor.order},
        "frame": lambda frame: {},
    }
    return {
        name: None
        if part is None
        else options[name](part) | {"system": _describe_system(owners.get(name))}
        for name, part in found.items()
    }


def _describe_system(system: AbstractSystem | None) -> dict[str, Any] | None:
    if system is None:
        return None
    return {"name": system.name, "shapes": [x.shape for x in jtu.tree_leaves(system)]}


def part_systems(model: PINN | DeepONet) -> dict[str, AbstractSystem]:
    """For each part of a network, the system of the catalogue to which it belongs."""
    layer, taylor, frame = (getattr(model, name, None) for name in PARTS)
    found = {
        "layer": None if layer is None else _layer_system(layer),
        "taylor": None if taylor is None else _taylor_system(taylor),
        "frame": None if frame is None else _owner(frame),
    }
    return {name: system for name, system in found.items() if system is not None}


def _layer_system(layer: ConservativeLayer) -> AbstractSystem | None:
    """The system to whose manifold the layer projects."""
    entries = jtu.tree_leaves(layer.manifold, is_leaf=is_entry)
    owner = _owner(entries[0].fn)
    if owner is None or layer.args is not None:
        return None
    return owner if bool(eqx.tree_equal(layer.manifold, owner.manifold)) else None


def _taylor_system(taylor: Taylor) -> AbstractSystem | None:
    """The system whose vector field the polynomial uses."""
    return _owner(taylor.vector_field) if taylor.args is None else None


def _owner(function: Any) -> AbstractSystem | None:
    """The system of the catalogue of which `function` is a method."""
    owner = getattr(function, "__self__", None)
    if not isinstance(owner, AbstractSystem):
        return None
    # Only a system that `systems.get` can rebuild.
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


def versions() -> dict[str, str]:
    """The versions of the packages on which a file depends."""
    return {name: _version(name) for name in ("diffrax-conserve", "diffrax", "equinox", "jax")}


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:  # imported from a folder that is not installed
        return "unknown"


# ---- Reading ----

# Limits on what a malicious or damaged file can make this package compute and allocate. They are
# larger than needed for any network.
_COUNT_MAX, _DEPTH_MAX, _NESTING_MAX, _LEAVES_MAX = 100_000, 200, 20, 300
_DTYPES = ("float64", "float32", "float16", "bfloat16")


def check_header(header: Any) -> None:
    """Raises `ValueError` unless this is a header that `save` can write."""
    optional = {"boxcox": _is_exponent} if isinstance(header, dict) and "boxcox" in header else {}
    _check(header, "the header", _HEADER | optional)
    known = {"args": object} if "args" in header["config"] and header["kind"] == "DeepONet" else {}
    _check(header["config"], "`config`", _CONFIG[header["kind"]] | known)
    for name in PARTS:
        if header[name] is not None:
            _check(header[name], f"`{name}`", _PART[name])
            if header[name]["system"] is not None:
                _check(header[name]["system"], "`system`", _SYSTEM)


def check_sizes(header: dict[str, Any], size: int) -> None:
    """Raises `ValueError` unless the arrays are described correctly and each fits into `size`
    bytes."""
    leaves = _state_leaves(header["config"]["state"])
    leaves += _state_leaves(header["config"].get("args"))
    for name in PARTS:
        system = None if header[name] is None else header[name]["system"]
        if system is not None:
            leaves += [{"shape": shape, "dtype": "float64"} for shape in system["shapes"]]
    if len(leaves) > _LEAVES_MAX:
        raise ValueError(f"it has {len(leaves)} arrays, but at most {_LEAVES_MAX} are allowed")
    for leaf in leaves:
        _check(leaf, "an array", _LEAF)
        if math.prod(leaf["shape"]) > size:
            raise ValueError(f"an array of shape {leaf['shape']} is larger than the file")


def _check(found: Any, name: str, entries: dict[str, Any]) -> None:
    """Raises unless `found` has exactly these entries, each of the given type or accepted by the
    given function."""
    if not isinstance(found, dict) or set(found) != set(entries):
        raise ValueError(f"{name} must be an object with the entries {', '.join(entries)}")
    for key, kind in entries.items():
        is_type = isinstance(kind, type | types.UnionType)
        if not (isinstance(found[key], kind) if is_type else kind(found[key])):
            raise ValueError(f"`{key}` in {name} is wrong")


def _is_count(x: Any, largest: int = _COUNT_MAX) -> bool:
    return type(x) is int and 1 <= x <= largest


def _is_depth(x: Any) -> bool:
    return _is_count(x, _DEPTH_MAX)


def _is_number(x: Any) -> bool:
    return type(x) in (int, float) and abs(x) < 1e300


def _is_exponent(x: Any) -> bool:
    return _is_number(x) and 0 <= x <= 1


def _is_windows(x: Any) -> bool:
    if isinstance(x, list):
        return 1 <= len(x) < _COUNT_MAX and all(map(_is_number, x))
    return _is_count(x)


def _is_shape(x: Any) -> bool:
    return isinstance(x, list) and len(x) <= 8 and all(type(n) is int and 0 <= n < 2**31 for n in x)


def _is_system(x: Any) -> bool:
    return isinstance(x, str) and x in systems.names()


_HEADER = {
    "kind": lambda x: isinstance(x, str) and x in _CONFIG,
    "config": dict,
    **dict.fromkeys(PARTS, dict | None),
    "repeats": _is_count,
    "size": lambda x: x is None or (type(x) is int and x >= 0),
    "dtypes": lambda x: isinstance(x, list) and all(isinstance(name, str) for name in x),
    "versions": dict,
    "info": dict,
}
_NETWORK = {
    "width": _is_count,
    "depth": _is_depth,
    "activation": str,
    "normalise": bool,
    "state": object,  # see `_state_leaves`
}
_CONFIG = {
    "PINN": _NETWORK | {"t0": _is_number, "t1": _is_number, "windows": _is_windows},
    "DeepONet": _NETWORK
    | {
        "latent": _is_count,
        "core": lambda x: isinstance(x, str) and x in _CORES,
        "max_step": _is_number,
    },
}
_SYSTEM = {"name": _is_system, "shapes": list}
_LEAF = {"shape": _is_shape, "dtype": lambda x: isinstance(x, str) and x in _DTYPES}
_PART = {
    "layer": {"steps": _is_count, "system": dict | None},
    "taylor": {"order": _is_depth, "system": dict | None},
    "frame": {"system": dict | None},
}


def _state_leaves(description: Any, nesting: int = 0) -> list[Any]:
    """The descriptions of the arrays of a state."""
    if nesting > _NESTING_MAX:
        raise ValueError(f"the state is nested more than {_NESTING_MAX} times")
    match description:
        case None:
            return []
        case {"dict": dict() as items, **rest} if not rest:
            children = list(items.values())
        case {"list": list() as items, **rest} if not rest:
            children = items
        case {"tuple": list() as items, **rest} if not rest:
            children = items
        case _:
            return [description]
    return [leaf for child in children for leaf in _state_leaves(child, nesting + 1)]


def _state_struct(description: Any) -> Any:
    """The state with `jax.ShapeDtypeStruct`s as leaves."""
    match description:
        case None:
            return None
        case {"dict": items}:
            return {key: _state_struct(value) for key, value in items.items()}
        case {"list": items}:
            return [_state_struct(value) for value in items]
        case {"tuple": items}:
            return tuple(_state_struct(value) for value in items)
    dtype = jax.dtypes.canonicalize_dtype(description["dtype"])
    return jax.ShapeDtypeStruct(tuple(description["shape"]), dtype)


def system_structs(header: Any) -> dict[str, AbstractSystem]:
    """The systems to which the parts belong, with `jax.ShapeDtypeStruct`s as parameters."""
    found = {}
    for name in PARTS:
        described = None if header[name] is None else header[name]["system"]
        if described is not None:
            leaves, treedef = jtu.tree_flatten(systems.get(described["name"]))
            pairs = zip(described["shapes"], leaves, strict=True)
            structs = [jax.ShapeDtypeStruct(tuple(s), x.dtype) for s, x in pairs]
            found[name] = jtu.tree_unflatten(treedef, structs)
    return found


def network_struct(header: Any, make_frame: Callable[[Any], MakeFrame | None], system: Any) -> Any:
    """The network with `jax.ShapeDtypeStruct`s in the place of arrays, without layer and
    polynomial.

    Nothing is computed or allocated. `make_frame` is called with `system`.
    """

    def build(state: Any, args: Any, system: Any) -> PINN | DeepONet:
        config = {k: v for k, v in header["config"].items() if k not in ("state", "args")}
        key = jr.key(0)
        if header["kind"] == "PINN":
            return PINN(state, config.pop("t0"), config.pop("t1"), key=key, **config)
        states = jtu.tree_map(lambda x: x[None], state)
        max_step, core = config.pop("max_step"), _CORES[config.pop("core")]
        frame = make_frame(system)
        config |= {} if args is None else {"args_domain": Box(args, args)}
        return DeepONet(states, max_step, frame=frame, core=core, key=key, **config)

    state, args = (_state_struct(header["config"].get(name)) for name in ("state", "args"))
    return eqx.filter_eval_shape(build, state, args, system)
