"""Double precision, run-time shape checks, and hypothesis profiles for the whole suite."""

import os

import jax
from hypothesis import HealthCheck, settings
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)

# Before the first import of the package: its annotations are then checked at every call.
install_import_hook("diffrax_conserve", "beartype.beartype")

settings.register_profile(
    "dev", deadline=None, max_examples=25, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("ci", settings.get_profile("dev"), derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "dev")
