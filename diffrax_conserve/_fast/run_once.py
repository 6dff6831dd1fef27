"""Programs that run once, such as the search for a structure: compiled quickly, not well."""

import functools as ft
from collections.abc import Callable
from typing import Any

import jax

# XLA's older emitters, and none of LLVM's optimisations: a third to a fifth of the time to compile.
_QUICKLY = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 0}


class RunOnce:
    """A function under this `jit`, compiled quickly where that is possible. JAX takes options for
    the outermost `jit` alone: where it traces already, call `inside`."""

    def __init__(self, jit: Callable[..., Any], fn: Callable[..., Any]):
        self.inside, self._quick = jit(fn), jit(fn, compiler_options=_QUICKLY)

    def __call__(self, *args: Any) -> Any:
        return (self._quick if _knows_options() else self.inside)(*args)


@ft.cache
def _knows_options() -> bool:
    if jax.default_backend() != "cpu":
        return False
    try:
        jax.jit(lambda x: x, compiler_options=_QUICKLY)(0.0)
    except Exception:  # of another version of XLA
        return False
    return True
