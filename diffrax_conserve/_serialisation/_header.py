"""What a file says of a network, and a network of that shape."""

from importlib.metadata import PackageNotFoundError, version
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu

from .. import systems
from .._manifold import is_entry
from .._network import (
    PINN,
    Concatenated,
    ConservativeLayer,
    DeepONet,
    Gated,
    MakeFrame,
    Product,
    Taylor,
    activation_name,
    output_layer,
)
from ..systems import AbstractSystem


def describe(model: PINN | DeepONet) -> dict[str, Any]:
    """All of a network but its weights."""
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
    system = taylor_system(taylor)
    return {"order": taylor.order, "system": None if system is None else system.name}


def _describe_frame(frame: MakeFrame | None) -> dict[str, Any] | None:
    if frame is None:
        return None
    system = owning_system(frame)
    return {"system": None if system is None else system.name}


def _describe_layer(layer: ConservativeLayer | None) -> dict[str, Any] | None:
    if layer is None:
        return None
    system = layer_system(layer)
    return {"steps": layer.steps, "system": None if system is None else system.name}


def layer_system(layer: ConservativeLayer) -> AbstractSystem | None:
    """The system of the catalogue whose manifold the layer has."""
    entries = jtu.tree_leaves(layer.manifold, is_leaf=is_entry)
    owner = owning_system(entries[0].fn)
    if owner is None or layer.args is not None:
        return None
    return owner if bool(eqx.tree_equal(layer.manifold, owner.manifold)) else None


def taylor_system(taylor: Taylor) -> AbstractSystem | None:
    """The system of the catalogue whose vector field the polynomial has."""
    return owning_system(taylor.vector_field) if taylor.args is None else None


def owning_system(function: Any) -> AbstractSystem | None:
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


def skeleton(header: dict[str, Any], frame: MakeFrame | None) -> PINN | DeepONet:
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


def versions() -> dict[str, str]:
    """Those of the packages that a file depends on."""
    return {name: _version(name) for name in ("diffrax-conserve", "diffrax", "equinox", "jax")}


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:  # imported from a folder that is not installed
        return "unknown"
