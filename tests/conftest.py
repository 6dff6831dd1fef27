"""Double precision, run-time shape checks, and hypothesis profiles for the whole suite."""

import contextlib
import gc
import importlib
import itertools
import os
import shutil
from pathlib import Path
from typing import Any

import jax
from beartype.door import is_bearable
from hypothesis import HealthCheck, settings
from jaxtyping import install_import_hook

# Most of the time goes into compilation, which takes a fifth as long with XLA's older emitters and
# without LLVM's optimisations. A third of the rest goes into what XLA does to the loops of a solve,
# and into pieces for several threads. `make examples` has all that but the unoptimised code, and
# `make slow` compiles as users do.
QUICKLY_COMPILED = (Path(__file__).parent / "xla_flags.txt").read_text(encoding="utf-8").split()
os.environ.setdefault("XLA_FLAGS", " ".join(QUICKLY_COMPILED))
jax.config.update("jax_enable_x64", True)

# What one run compiled the next one reads, and one worker what the other compiled.
CACHE = Path(__file__).parents[1] / ".pytest_cache" / "compiled"
CACHE_BYTES_MAX = 2**30
jax.config.update("jax_compilation_cache_dir", str(CACHE))
# To compile even one operation takes twice as long as to read it.
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
# The interpreters that tests start share it.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

# Before the first import of the package: its annotations are then checked at every call.
install_import_hook("diffrax_conserve", "beartype.beartype")


def _checked_by_beartype(accepts):
    """In place of jaxtyping's `typechecked`, for its function of a leaf of a `PyTree[...]`."""
    (hint,) = accepts.__annotations__.values()

    def check(x):
        if not is_bearable(x, hint):
            raise TypeError

    return check


# jaxtyping looks up the signature of that function anew for every leaf, which was a fifth of the
# time of tracing. `test_typeguards.py` holds that leaves are checked as before.
with contextlib.suppress(ImportError):
    importlib.import_module("jaxtyping._typeguard").typechecked = _checked_by_beartype


def _only_what_is_returned(make):
    """In place of jaxtyping's `_make_fn_with_signature`, for what checks a call after its return.

    It checks the arguments once more, though their shapes are still known from the check before.
    """

    def made(name, qualname, module, signature, output):
        if output:
            unchecked = [p.replace(annotation=Any) for p in signature.parameters.values()]
            signature = signature.replace(parameters=unchecked)
        return make(name, qualname, module, signature, output)

    return made


with contextlib.suppress(ImportError, AttributeError):
    decorator = importlib.import_module("jaxtyping._decorator")
    decorator._make_fn_with_signature = _only_what_is_returned(decorator._make_fn_with_signature)

# Tracing makes many small objects, of which few are garbage: a tenth of its time.
gc.set_threshold(50_000, 20, 100)


def pytest_sessionfinish():
    """What is left ends with the process: pytest would look through it five times, in 5 to 10 s."""
    gc.freeze()


settings.register_profile(
    "dev", deadline=None, max_examples=25, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("ci", settings.get_profile("dev"), derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "dev")


def pytest_configure():
    """Empties the cache of compiled functions once it has grown large; not in a worker."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        size = sum(file.stat().st_size for file in CACHE.glob("*"))
        if size > CACHE_BYTES_MAX:
            shutil.rmtree(CACHE, ignore_errors=True)


# Each compiled function holds some memory maps, of which Linux allows a process 65,530. A worker
# that runs half of this suite would need more, and be killed.
_MAPS = Path("/proc/self/maps")
_MAPS_MAX = 30_000
# Counting them takes up to a tenth of a second.
_TESTS_PER_COUNT = 16
_tests = itertools.count(1)


def pytest_runtest_teardown():
    if next(_tests) % _TESTS_PER_COUNT or not _MAPS.exists():
        return
    if _MAPS.read_bytes().count(b"\n") > _MAPS_MAX:
        jax.clear_caches()
