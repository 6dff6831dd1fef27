"""Double precision, run-time shape checks, and hypothesis profiles for the whole suite."""

import os
from pathlib import Path

import jax
from hypothesis import HealthCheck, settings
from jaxtyping import install_import_hook

# Most of the time goes into compilation, which takes half as long with XLA's older emitters.
OLDER_EMITTERS = "--xla_backend_extra_options=xla_cpu_disable_new_fusion_emitters"
os.environ.setdefault("XLA_FLAGS", OLDER_EMITTERS)
jax.config.update("jax_enable_x64", True)

# Before the first import of the package: its annotations are then checked at every call.
install_import_hook("diffrax_conserve", "beartype.beartype")

settings.register_profile(
    "dev", deadline=None, max_examples=25, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("ci", settings.get_profile("dev"), derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "dev")


# Each compiled function holds some memory maps, of which Linux allows a process 65,530. A worker
# that runs half of this suite would need more, and be killed.
_MAPS = Path("/proc/self/maps")
_MAPS_MAX = 30_000


def pytest_runtest_teardown():
    if _MAPS.exists() and _MAPS.read_bytes().count(b"\n") > _MAPS_MAX:
        jax.clear_caches()
