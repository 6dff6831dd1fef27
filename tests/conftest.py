"""Double precision, a cache of what is compiled, and hypothesis profiles for the whole suite."""

import atexit
import gc
import importlib
import itertools
import os
import shutil
import threading
from pathlib import Path

import jax
import pytest
from hypothesis import HealthCheck, settings
from jaxtyping import install_import_hook

# Most of the time goes into compilation, which takes a fifth as long with XLA's older emitters and
# without LLVM's optimisations. A third of the rest goes into what XLA does to the loops of a solve,
# and into pieces for several threads. `make slow` compiles as users do.
QUICKLY_COMPILED = (Path(__file__).parent / "xla_flags.txt").read_text(encoding="utf-8").split()
os.environ.setdefault("XLA_FLAGS", " ".join(QUICKLY_COMPILED))
jax.config.update("jax_enable_x64", True)
# The random numbers of today's JAX also with the oldest one that is supported.
jax.config.update("jax_threefry_partitionable", True)
# Threads of a small factorisation wait for each other: on a busy machine up to 200 times as long.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# What one run compiled the next one reads, and one worker what the other compiled.
CACHE = Path(__file__).parents[1] / ".pytest_cache" / "compiled"
CACHE_BYTES_MAX = 2**30
jax.config.update("jax_compilation_cache_dir", str(CACHE))
# To compile even one operation takes twice as long as to read it.
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
# The interpreters that tests start share it.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

# JAX 0.10 makes a context of MLIR, with all its dialects, for each program that it lowers: a tenth
# of the time of these small ones. As in 0.12, ten programs of a thread share one here.
_mlir = importlib.import_module("jax._src.interpreters.mlir")
_make_ir_context, _of_thread = _mlir.make_ir_context, threading.local()


def _shared_ir_context():
    if _mlir.ir.Context.current is not None:  # one program inside of another
        return _make_ir_context()
    uses = getattr(_of_thread, "uses", 0)
    if uses % 10 == 0:
        _of_thread.context = _make_ir_context()
    _of_thread.uses = uses + 1
    return _of_thread.context


if not hasattr(_mlir, "_thread_local_context"):
    _mlir.make_ir_context = _shared_ir_context
# Another twentieth.
jax.config.update("jax_include_full_tracebacks_in_locations", False)

# A failure makes the outputs NaN, which no test accepts. To raise it takes a callback, and jax does
# not keep programs with callbacks in its cache.
_equinox_errors = importlib.import_module("equinox._errors")
_equinox_errors.EQX_ON_ERROR = os.environ.get("EQX_ON_ERROR", "nan")


@pytest.fixture
def errors_raise(monkeypatch):
    """Failures raise, as they do for users."""
    monkeypatch.setattr(_equinox_errors, "EQX_ON_ERROR", "raise")
    # A setting without an effect on a CPU, so that a function is compiled again.
    with jax.default_matmul_precision("highest"):
        yield


# Annotations are checked at every call in `make shapes` alone: it takes an eighth of the time.
if os.environ.get("SHAPES"):
    # Before the first import of the package.
    install_import_hook("diffrax_conserve", "beartype.beartype")

# Tracing makes many small objects, of which few are garbage: a tenth of its time.
gc.set_threshold(50_000, 20, 100)


def pytest_sessionfinish():
    """What is left ends with the process: pytest would look through it five times, in 5 to 10 s,
    and JAX would take it apart."""
    gc.freeze()
    atexit.unregister(importlib.import_module("jax._src.api").clean_up)


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
