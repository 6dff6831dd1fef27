"""Programs that run once, such as the search for a structure: compiled quickly, not well."""

import functools as ft
from collections.abc import Callable
from typing import Any

import jax
import jax._src.core as private

# XLA's older emitters, and none of LLVM's optimisations: a third to a fifth of the time to compile.
_QUICKLY = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 0}


def run_once(jit: Callable[..., Any]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """A decorator: the function under this `jit`, compiled quickly where that is possible. JAX
    takes options for the outermost `jit` alone."""

    def decorate(fn: Callable[..., Any]) -> Callable[..., Any]:
        usual, quick = jit(fn), jit(fn, compiler_options=_QUICKLY)

        @ft.wraps(fn)
        def call(*args: Any) -> Any:
            return (quick if _is_outermost() and _knows_options() else usual)(*args)

        return call

    return decorate


def _is_outermost() -> bool:
    """Whether JAX traces nothing here. There is no public name for that."""
    return getattr(private, "trace_state_clean", lambda: False)()


@ft.cache
def _knows_options() -> bool:
    if jax.default_backend() != "cpu":
        return False
    try:
        jax.jit(lambda x: x, compiler_options=_QUICKLY)(0.0)
    except Exception:  # of another version of XLA
        return False
    return True
