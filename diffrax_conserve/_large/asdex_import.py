"""The package that finds sparsity patterns by abstract interpretation, if it can be imported.

asdex imports private names of jax, so a new version of jax can break it. What is known to work
stands in the extra `sparse` of `pyproject.toml`.
"""

import functools as ft
import importlib.metadata
from typing import Any

import jax
import jax._src.core as private
import jax.extend.core as jex


@ft.cache
def asdex() -> Any:
    """The package. Whatever its import raises is raised.

    asdex 0.5.2 imports `ClosedJaxpr` from `jax._src.core`, where jax 0.12 does not have it. It is
    lent under its public name in `jax.extend.core` for as long as the import takes.
    """
    lent = not hasattr(private, "ClosedJaxpr")
    if lent:
        private.ClosedJaxpr = jex.ClosedJaxpr  # pyright: ignore
    try:
        import asdex
    finally:
        if lent:
            del private.ClosedJaxpr  # pyright: ignore
    return asdex


def reason(error: Exception) -> str:
    """Why asdex could not be imported, and what to do."""
    install = "`pip install '.[sparse]'` in the folder of diffrax-conserve"
    if isinstance(error, ModuleNotFoundError) and error.name == "asdex":
        return f"the package that finds sparse ones is missing: {install}."
    found = (d.version for d in importlib.metadata.distributions(name="asdex"))
    return (
        f"asdex {next(found, '')}, which finds sparse ones, cannot be imported with jax "
        f"{jax.__version__}: {type(error).__name__}: {error}. By {install} pip chooses versions of "
        "both that work together."
    )
