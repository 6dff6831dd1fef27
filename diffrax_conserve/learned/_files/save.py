"""Saving and loading networks: `save`, `load` and `read_info`."""

import io
import math
import operator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.tree_util as jtu

from .._networks.deeponet import DeepONet
from .._networks.frame import MakeFrame
from .._networks.layer import ConservativeLayer
from .._networks.pinn import PINN
from .._networks.repeated import Repeated
from .._networks.taylor import Taylor
from .._networks.transformed import BoxCox, Transformed
from .configuration import (
    PARTS,
    check_header,
    check_sizes,
    describe,
    network_struct,
    part_systems,
    system_structs,
    versions,
)
from .file import PathLike, read, read_leaf, refuse, unpack, unpacked_size, write


def save(
    path: PathLike,
    model: PINN | DeepONet | Transformed | Repeated,
    *,
    info: dict[str, Any] | None = None,
) -> None:
    """Writes a network with its configuration into one file.

    The file is replaced atomically: a reader sees either the old or the new one. Its mode is kept,
    and so is a symbolic link to it.

    **Arguments:**

    - `path`: where to write.
    - `model`: a [`diffrax_conserve.PINN`][] or a [`diffrax_conserve.DeepONet`][]. A `DeepONet` may
        be wrapped in a [`diffrax_conserve.learned.Transformed`][] with a
        [`diffrax_conserve.learned.BoxCox`][], and in a [`diffrax_conserve.learned.Repeated`][]. A
        conservative layer, a Taylor polynomial and a frame contain functions, which cannot be
        stored. If they belong to a system of the catalogue, its name is stored; otherwise pass them
        again to [`diffrax_conserve.load`][].
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
    repeated = isinstance(model, Repeated)
    inner = model.flow_map if repeated else model
    boxcox = {}
    if isinstance(inner, Transformed) and isinstance(inner.transformation, BoxCox):
        boxcox = {"boxcox": inner.transformation.exponent}
        inner = inner.flow_map
    header = {**describe(inner), **boxcox, "repeats": model.count if repeated else 1}
    assert isinstance(inner, PINN | DeepONet)
    arrays = _Contents(eqx.filter(_without(inner), eqx.is_array), part_systems(inner))
    header["dtypes"] = [x.dtype.name for x in jtu.tree_leaves(arrays)]
    header |= {"versions": versions(), "info": info or {}}
    if _shapes(_like(header, inner.frame if isinstance(inner, DeepONet) else None)[0]) != _shapes(
        arrays
    ):
        raise ValueError(
            "The arrays of this network are not those that its constructor makes, so that a file "
            "cannot describe it. Use `equinox.tree_serialise_leaves`."
        )
    body = io.BytesIO()
    eqx.tree_serialise_leaves(body, arrays)
    write(path, header, body.getvalue())


def load(
    path: PathLike,
    *,
    layer: ConservativeLayer | None = None,
    taylor: Taylor | None = None,
    frame: MakeFrame | None = None,
) -> PINN | DeepONet | Transformed | Repeated:
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
    given = {"layer": layer, "taylor": taylor, "frame": frame}
    for name, part in given.items():
        _check_part(path, name, header[name], part)
    try:
        like, static = _like(header, frame)
        needed = sum(math.prod(x.shape) * x.dtype.itemsize for x in jtu.tree_leaves(like))
        if needed > unpacked_size(header, body):
            raise ValueError("its arrays are larger than the file")
        file = io.BytesIO(unpack(header, body))
        found = eqx.tree_deserialise_leaves(file, like, read_leaf)
        if file.read(1):
            raise ValueError("it has data after the last array")
    except Exception as error:
        refuse(path, error)
    model = eqx.combine(found.network, static)
    for name, part in given.items():
        if header[name] is not None:
            part = _part(header[name], name, found.systems) if part is None else part
            where = operator.attrgetter(_PLACES[name])
            model = eqx.tree_at(where, model, part, is_leaf=lambda x: x is None)
    if "boxcox" in header:
        model = Transformed(model, BoxCox(header["boxcox"]))
    return model if header["repeats"] == 1 else Repeated(model, header["repeats"])


def read_info(path: PathLike) -> dict[str, Any]:
    """The header of a file, without building its network.

    **Arguments:**

    - `path`: the file.

    **Returns:**

    A dictionary with the `kind` and `config` of the network, its parts (`layer`, `taylor`,
    `frame`), the `versions` of the packages that wrote it, the `info` that was given to
    [`diffrax_conserve.save`][], and the entries that describe its arrays.

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
    header, _ = _read(path)
    return header


def _read(path: PathLike) -> tuple[Any, bytes]:
    header, body = read(path)
    try:
        check_header(header)
        check_sizes(header, unpacked_size(header, body))
    except ValueError as error:
        refuse(path, error)
    return header, body


class _Contents(NamedTuple):
    """The arrays of a file, in this order."""

    network: Any
    systems: dict[str, Any]  # to which the parts of the network belong


def _like(header: Any, frame: MakeFrame | None) -> tuple[_Contents, Any]:
    """The shapes and dtypes of the arrays of a file, and the static part of its network."""
    structs = system_structs(header)

    def make_frame(system: Any) -> MakeFrame | None:
        return frame if frame is not None or system is None else system.frame

    network = _without(network_struct(header, make_frame, structs.get("frame")))
    own, static = eqx.partition(network, lambda x: isinstance(x, jax.ShapeDtypeStruct))
    leaves, treedef = jtu.tree_flatten(_Contents(own, structs))
    dtypes = [jax.dtypes.canonicalize_dtype(name) for name in header["dtypes"]]
    pairs = zip(leaves, dtypes, strict=True)
    return treedef.unflatten([jax.ShapeDtypeStruct(x.shape, d) for x, d in pairs]), static


def _shapes(contents: _Contents) -> Any:
    return jtu.tree_map(lambda x: (x.shape, x.dtype), contents)


def _check_part(path: PathLike, name: str, found: Any, given: Any) -> None:
    """Raises if a part is given that the network does not have, or a required part is not given."""
    what, example = _PARTS[name]
    if found is None and given is not None:
        raise ValueError(f"The network in {path} has no {what}: leave `{name}` out.")
    if found is not None and found["system"] is None and given is None:
        raise ValueError(
            f"The network in {path} has a {what}, whose functions no file can hold. Give it "
            f"again: `load(path, {name}={example.format(**found)})`."
        )


def _part(found: Any, name: str, systems: dict[str, Any]) -> Any:
    """The layer, Taylor polynomial or frame of a system."""
    if name == "layer":
        return ConservativeLayer(systems[name].manifold, steps=found["steps"])
    if name == "taylor":
        return Taylor(systems[name].vector_field, found["order"])
    return systems[name].frame


# For each part that contains functions: its name in messages, and an expression that builds it.
_PARTS = {
    "layer": ("conservative layer", "ConservativeLayer(manifold, steps={steps})"),
    "taylor": ("Taylor polynomial", "Taylor(vector_field, {order})"),
    "frame": ("frame", "frame"),
}
# The attribute path of each part in a network.
_PLACES = {"layer": "layer", "taylor": "taylor", "frame": "domain.make"}


def _without(model: PINN | DeepONet) -> Any:
    """The network without the parts that contain functions."""
    names = [name for name in PARTS if getattr(model, name, None) is not None]

    def where(model: Any) -> list[Any]:
        return [operator.attrgetter(_PLACES[name])(model) for name in names]

    return eqx.tree_at(where, model, [None] * len(names)) if names else model
