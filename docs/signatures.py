"""What griffe, which reads the source of the package, cannot know of equinox modules.

A module gets its `__init__` when its class is made, and the docstring of it after that.
"""

import inspect
import pydoc

import griffe


class Modules(griffe.Extension):
    def on_class(self, *, cls, loader, **kwargs):
        del kwargs
        made = pydoc.locate(cls.path)
        if made.__init__ is object.__init__:
            return
        written = {}  # what has an annotation: fields of the bases and of the class, or arguments
        for base in reversed([cls, *cls.mro()]):
            written |= base.members
        for name, field in getattr(made, "__dataclass_fields__", {}).items():
            if converter := field.metadata.get("converter"):
                function = loader.modules_collection[converter.__module__][converter.__qualname__]
                written[name] = function.parameters[0]
        if "__init__" in cls.members:
            written = {parameter.name: parameter for parameter in cls["__init__"].parameters}
        parameters = griffe.Parameters()
        for name, argument in inspect.signature(made.__init__).parameters.items():
            default = getattr(argument.default, "__name__", repr(argument.default))
            if argument.default is inspect.Parameter.empty:
                default = None
            elif "<" in default:  # no Python, which black would not format
                default = "..."
            kind = griffe.ParameterKind[argument.kind.name.lower()]
            annotation = getattr(written.get(name), "annotation", None)
            parameters.add(
                griffe.Parameter(name, annotation=annotation, kind=kind, default=default)
            )
        init = griffe.Function("__init__", parameters=parameters, returns="None")
        init.docstring = griffe.Docstring(made.__init__.__doc__ or "", parent=init)
        cls.set_member("__init__", init)
