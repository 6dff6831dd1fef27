"""Signatures in the reference name the types of `diffrax_conserve._custom_types`.

At run time these names are gone: `RealScalarLike` is a union of six types. So the annotations of
each function that is documented are written anew, from the objects.
"""

import inspect
import re
import types
import typing
from collections.abc import Callable

import griffe
import jaxtyping

from diffrax_conserve import _custom_types

NAMES = (
    "ConstraintFn", "Manifold", "BoolScalarLike", "IntScalarLike", "RealScalarLike", "Values",
    "State", "Y", "VF", "DenseInfo", "Args",
)  # fmt: skip
ALIASES = [(getattr(_custom_types, name), name) for name in NAMES]
ALIASES += [(jaxtyping.ArrayLike, "ArrayLike"), (jaxtyping.PRNGKeyArray, "PRNGKeyArray")]
UNIONS = (typing.Union, types.UnionType)


# A jaxtyping class has its union written out in its name, each of its arrays by itself.
ANY_ARRAY = re.compile(r"PyTree\[Array \| ndarray \| bool(?: \| \w+)*\]")
SHAPED = re.compile(
    r'(\w+)\[Array, ("[^"]*"|\.\.\.)\] \| \1\[ndarray, \2\]'
    r"(?: \| (?:number|bool|int|float|complex))*"
)


def text(annotation) -> str:
    """The annotation as a person would write it."""
    written = re.sub(r"\b(?:jax\.)?jaxlib\._jax\.|\bnumpy\.", "", _text(annotation))
    written = re.sub(r"\bjaxtyping\.", "", written)
    written = ANY_ARRAY.sub("PyTree[ArrayLike]", written)
    return SHAPED.sub(r"\1[ArrayLike, \2]", written)


def _text(annotation) -> str:
    for alias, name in ALIASES:
        if annotation is alias or (alias is not typing.Any and annotation == alias):
            return "Y" if name == "State" else name
    origin, args = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in UNIONS:
        return _union(list(args))
    if origin is Callable and len(args) == 2:
        taken = "..." if args[0] is ... else f"[{', '.join(map(text, args[0]))}]"
        return f"Callable[{taken}, {text(args[1])}]"
    if origin is not None and args and not isinstance(annotation, type):
        return f"{_name(origin)}[{', '.join(map(text, args))}]"
    return _name(annotation)


def _union(args: list) -> str:
    parts = []
    for alias, name in ALIASES:
        members = typing.get_args(alias) if typing.get_origin(alias) in UNIONS else ()
        if members and all(member in args for member in members):
            parts.append(name)
            args = [arg for arg in args if arg not in members]
    return " | ".join(parts + [text(arg) for arg in args])


def _name(annotation) -> str:
    if annotation is type(None) or annotation is None:
        return "None"
    if annotation is ...:
        return "..."
    if isinstance(annotation, str):
        return annotation
    if isinstance(annotation, types.GenericAlias):
        inner = ", ".join(map(text, typing.get_args(annotation)))
        return f"{_name(typing.get_origin(annotation))}[{inner}]"
    name = getattr(annotation, "__name__", None) or str(annotation)
    return name.removeprefix("typing.")


class Signatures(griffe.Extension):
    def on_function_instance(self, *, node, func, **kwargs):
        del kwargs
        try:
            signature = inspect.signature(inspect.unwrap(node.obj))
        except (TypeError, ValueError):
            return
        for parameter in func.parameters:
            found = signature.parameters.get(parameter.name)
            if str(parameter.default) == "<factory>":  # no Python, which black would not format
                parameter.default = "..."
            if found is not None and found.annotation is not inspect.Parameter.empty:
                parameter.annotation = text(found.annotation)
        if func.returns is not None and signature.return_annotation is not inspect.Parameter.empty:
            func.returns = text(signature.return_annotation)
