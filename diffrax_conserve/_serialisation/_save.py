"""`save`, `load` and `read_info`."""

import operator
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np

from .. import systems
from .._network import PINN, ConservativeLayer, DeepONet, MakeFrame, Repeated, Taylor
from ._file import PathLike, read, split, write
from ._header import describe, layer_system, owning_system, skeleton, taylor_system, versions


def save(
    path: PathLike, model: PINN | DeepONet | Repeated, *, info: dict[str, Any] | None = None
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
    header = {**describe(inner), "repeats": model.count if repeated else 1}
    header |= {"versions": versions(), "info": info or {}}
    write(path, header, [np.asarray(x) for x in _arrays(inner)])


def load(
    path: PathLike,
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
    header, raw = read(path)
    arrays = split(header["arrays"], raw)
    # The parts that hold functions come last. A network cannot be built without its frame.
    given = {"layer": layer, "taylor": taylor, "frame": frame}
    count = len(arrays) - sum(_system_size(header.get(part)) for part in given)
    rest = iter(arrays[count:])
    parts = {name: _part(path, name, header.get(name), x, rest) for name, x in given.items()}
    own, static = eqx.partition(_without(skeleton(header, parts["frame"])), eqx.is_array)
    model = eqx.combine(jtu.tree_unflatten(jtu.tree_structure(own), arrays[:count]), static)
    for name, part in parts.items():
        if part is not None:
            where = operator.attrgetter(_PLACES[name])
            model = eqx.tree_at(where, model, part, is_leaf=lambda x: x is None)
    repeats = header.get("repeats", 1)
    return model if repeats == 1 else Repeated(model, repeats)


def read_info(path: PathLike) -> dict[str, Any]:
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
    header, _ = read(path)
    return header


def _system_size(found: Any) -> int:
    """How many arrays the system of a part has."""
    if found is None or found["system"] is None:
        return 0
    return len(jtu.tree_leaves(systems.get(found["system"])))


def _part(path: PathLike, name: str, found: Any, given: Any, arrays: Iterator[jax.Array]) -> Any:
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


def _arrays(model: PINN | DeepONet) -> list[Any]:
    """Those of the network itself, then the parameters of the systems of its layer, of its Taylor
    polynomial and of its frame."""
    layer, taylor, frame = (getattr(model, name, None) for name in _PARTS)
    owners = [
        None if layer is None else layer_system(layer),
        None if taylor is None else taylor_system(taylor),
        None if frame is None else owning_system(frame),
    ]
    own = jtu.tree_leaves(eqx.filter(_without(model), eqx.is_array))
    return [*own, *(x for owner in owners for x in jtu.tree_leaves(owner))]


def _without(model: PINN | DeepONet) -> Any:
    """The network without those parts that hold functions."""
    names = [name for name in _PARTS if getattr(model, name, None) is not None]

    def where(model: Any) -> list[Any]:
        return [operator.attrgetter(_PLACES[name])(model) for name in names]

    return eqx.tree_at(where, model, [None] * len(names)) if names else model
