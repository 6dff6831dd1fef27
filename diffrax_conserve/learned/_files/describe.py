"""A network as JSON and a list of arrays.

Numbers, strings and `None` are themselves. Everything else is an object with one entry: a container
(`tuple`, `list`, `dict`), an `array` with its dtype and shape, an `activation` by name, a `method`
of a system of the catalogue, or a class of this package with its fields. Nothing else can be
described, so that reading a description calls no function but these classes. A field that is
renamed is another format.
"""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..._manifold import Constraint, FirstIntegral
from ...systems import AbstractSystem
from ...systems._registry import CLASSES
from .._networks.cores import Concatenated, Gated, Product
from .._networks.deeponet import DeepONet
from .._networks.domain import Box, FramedBox
from .._networks.layer import ConservativeLayer
from .._networks.mlp import ACTIVATIONS, MLP
from .._networks.pinn import PINN
from .._networks.taylor import Taylor
from .._networks.wrappers import BoxCox, Repeated, Transformed

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


class NotGiven(ValueError):
    """A part of the network is neither in the file nor passed to `load`."""


def describe(x: Any, arrays: list[np.ndarray]) -> Any:
    """The description of `x`, whose arrays are appended to `arrays`."""
    if x is None or type(x) in (bool, int, float, str):
        return x
    if type(x) in (list, tuple):
        return {type(x).__name__: [describe(item, arrays) for item in x]}
    if type(x) is dict and all(isinstance(key, str) for key in x):
        return {"dict": {key: describe(x[key], arrays) for key in x}}
    if isinstance(x, jax.Array) and x.dtype.name in _DTYPES:
        arrays.append(np.asarray(x))
        return {"array": [x.dtype.name, *x.shape]}
    if names := [name for name, function in ACTIVATIONS.items() if function is x]:
        return {"activation": names[0]}
    owner, name = getattr(x, "__self__", None), getattr(x, "__name__", "")
    if isinstance(owner, AbstractSystem) and _method(owner, name) == x:
        return {"method": [name, describe(owner, arrays)]}
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
        return describe(value, arrays)
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


class Reader:
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
            raise NotGiven(
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


def check(model: Any) -> None:
    """Raises unless `model` is a network whose arrays fit together. Nothing is computed."""
    while isinstance(model, Repeated | Transformed):
        if not isinstance(getattr(model, "transformation", BoxCox()), BoxCox):
            raise TypeError("it is in unknown coordinates")
        model = model.flow_map
    if isinstance(model, PINN):
        if any(len(x) != model.windows for x in jax.tree.leaves((model.nets, model.y0s))):
            raise ValueError("it has not one network for each window")
        kinds, like, arguments = {"layer": ConservativeLayer}, model.y0, (model.t0,)
    elif not isinstance(model, DeepONet):
        raise TypeError(f"`model` is a {type(model).__name__}, but must be a `PINN` or `DeepONet`")
    else:
        kinds, like = {"layer": ConservativeLayer, "taylor": Taylor}, model.state
        known = () if model.args_domain is None else (model.args_domain.lower,)
        arguments = (like, *known, model.max_step)
    for name, kind in kinds.items():
        if not isinstance(getattr(model, name), kind | None):
            raise TypeError(f"its `{name}` is something else")
    # A polynomial of high order takes long to trace.
    where = lambda m: [getattr(m, name) for name in kinds]  # noqa: E731
    bare = eqx.tree_at(where, model, [None] * len(kinds), is_leaf=lambda x: x is None)
    found = eqx.filter_eval_shape(bare, *arguments)
    if jax.tree.map(jnp.shape, found) != jax.tree.map(jnp.shape, like):
        raise ValueError("the output is not of the shape of a state")
