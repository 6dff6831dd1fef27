"""The XLA option that makes single trajectories fast on a CPU."""

import importlib
import os

_OPTION = "xla_cpu_small_while_loop_byte_threshold"
_LIST = "--xla_backend_extra_options="


def fast_cpu() -> None:
    """Sets the XLA option that compiles a loop over small steps into one kernel.

    By default XLA does so only if a step reads and writes less than 1 kB. A projected RK4 step of
    the rigid body, one trajectory on a CPU, then takes about 80 ns instead of 350 to 520. Plain
    solves gain as well; batches do not.

    XLA reads its options once, when the first array is made. Call this before that, for example
    right below the imports. It appends to the environment variable `XLA_FLAGS`, and changes nothing
    if the option is already set there. Accelerators are not affected.

    **Raises:**

    `RuntimeError` if jax has already started, so that the option would have no effect.

    !!! example

        ```python
        import diffrax_conserve as dfc

        try:
            dfc.fast_cpu()
        except RuntimeError as error:  # in a notebook: something has made an array before
            assert "too late" in str(error)
        ```
    """
    flags = os.environ.get("XLA_FLAGS", "").split()
    if any(_OPTION in flag for flag in flags):
        return
    if _has_started():
        raise RuntimeError(
            "It is too late for `fast_cpu`: jax has started, and XLA has read its options. Call it "
            "before the first array is made, or set the environment variable "
            f"XLA_FLAGS={_LIST}{_OPTION}=65536 before Python starts."
        )
    others = [flag for flag in flags if not flag.startswith(_LIST)]
    lists = [flag.removeprefix(_LIST) for flag in flags if flag.startswith(_LIST)]
    options = ",".join([*lists, f"{_OPTION}=65536"])
    os.environ["XLA_FLAGS"] = " ".join([*others, _LIST + options])


def _has_started() -> bool:
    """Whether jax has initialised a backend. jax has no public function for this."""
    bridge = importlib.import_module("jax._src.xla_bridge")
    started = getattr(bridge, "backends_are_initialized", None)
    return started is not None and started()
