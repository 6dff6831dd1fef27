"""What the benchmarks share: a clock, turns, compilation apart from running, C programs, the
machine they ran on, and how far an answer is off its manifold.

Where jax computes on the CPU, times are CPU seconds: what else the machine does is not counted, and
everything has one core, as C and heyoka have. On an accelerator they are seconds of the clock.
Contestants take turns, and each counts with its best round, so that a machine that slows down slows
all of them alike.
"""

import argparse
import ctypes
import datetime
import importlib.metadata
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Hashable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

if Path(__file__).resolve().parents[1] in Path(sys.argv[0]).resolve().parents:  # not in a test
    # What the documentation recommends for single trajectories: XLA compiles the loop over the
    # steps into one kernel if a step accesses less than this, by default 1 kB. An `XLA_FLAGS` that
    # is set, and be it to nothing, stays.
    threshold = "xla_cpu_small_while_loop_byte_threshold=65536"
    os.environ.setdefault("XLA_FLAGS", f"--xla_backend_extra_options={threshold}")
    # One core, as C and heyoka: XLA divides the larger loops between the cores that it sees. Smoke
    # runs, whose times mean nothing, run side by side.
    if hasattr(os, "sched_setaffinity") and "--smoke" not in sys.argv:
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr

HERE = Path(__file__).parent
RESULTS = HERE.parent / "results"
PACKAGES = ("jax", "jaxlib", "diffrax", "equinox", "optimistix", "diffrax-conserve")

_Name = TypeVar("_Name", bound=Hashable)

# For float32: JAX_ENABLE_X64=0 python benchmarks/...
jax.config.update("jax_enable_x64", os.environ.get("JAX_ENABLE_X64", "1") != "0")
# The CPU time of another thread that still runs is known only up to the last tick of the system's
# clock, milliseconds ago. So jax must compute on the thread that asks for the time.
jax.config.update("jax_cpu_enable_async_dispatch", False)
EPS = float(jnp.finfo(jnp.result_type(float)).eps)


# ---- Time ----

SHORT = 0.01


class Timed(NamedTuple):
    """The best of several runs: how long it took, and what it computed."""

    seconds: float
    answer: Any


def clock() -> float:
    return time.process_time() if jax.default_backend() == "cpu" else time.perf_counter()


def timed(run: Callable[[], Any]) -> Timed:
    begin = clock()
    answer = jax.block_until_ready(run())  # which leaves what is not of jax alone
    return Timed(clock() - begin, answer)


def take_turns(
    runs: Mapping[_Name, Callable[[], Any]], rounds: int, long: float = 2.0
) -> dict[_Name, Timed]:
    """The best of `rounds` rounds; runs that take more than `long` seconds are not repeated."""
    best: dict[_Name, Timed] = {}
    for _ in range(rounds):
        for name, run in runs.items():
            seconds = best[name].seconds if name in best else None
            if seconds is not None and seconds > long:
                continue
            if seconds is not None and seconds <= SHORT:
                run()  # the caches still hold what the last contestant needed
            result = timed(run)
            if seconds is None or result.seconds < seconds:
                best[name] = result
    return best


def compiled(fn: Callable[..., Any], *args: Any) -> tuple[Any, float]:
    """`fn` compiled for arguments like `args`, and how long that took."""
    begin = clock()
    executable = jax.jit(fn).lower(*args).compile()
    return executable, clock() - begin


def print_row(row: Mapping[str, Any]) -> None:
    cells = (f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items())
    print(", ".join(cells), flush=True)


# ---- Programs in C ----

C_FLAGS = ("-O3", "-march=native", "-mprefer-vector-width=512", "-ffast-math", "-fopenmp-simd")


def c_compiler() -> str | None:
    return shutil.which(os.environ.get("CC", "cc"))


def c_library(source: Path, *options: str, libraries: tuple[str, ...] = ()) -> ctypes.CDLL | None:
    """`source`, compiled for this machine and loaded; `None` if there is no compiler, or if it
    does not find what the source includes or the `libraries`."""
    compiler = c_compiler()
    if compiler is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / f"{source.stem}.so"
        compile_ = [compiler, *C_FLAGS, "-Wno-psabi", "-c", "-fPIC", *options]
        # Linked without `-ffast-math`: a library that is linked with it flushes subnormal numbers
        # to zero in the whole process that loads it.
        link = [compiler, "-shared", f"{library}.o", "-o", str(library)]
        link += [f"-l{name}" for name in (*libraries, "m")]
        for command in ([*compile_, str(source), "-o", f"{library}.o"], link):
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode and libraries:
                return None
            if done.returncode:
                raise RuntimeError(f"{' '.join(command)}\n{done.stderr}")
        return ctypes.CDLL(str(library))


# ---- Initial states, and how well they are kept ----


def initial_states(system: Any, batch: int) -> Any:
    """`y0` alone, with a leading axis of one, or perturbed by 5 %, so that the lanes need about as
    many steps and iterations as `y0`."""

    def lanes(leaf: jax.Array) -> jax.Array:
        return leaf * (1 + 0.05 * jr.normal(jr.key(0), (batch, *leaf.shape), leaf.dtype))

    return jax.tree.map(lanes if batch > 1 else lambda leaf: leaf[None], system.y0)


def largest_drift(system: Any, start: Any, end: Any) -> float:
    """The largest change of an integral over all lanes, relative to its value and the terms that
    it sums."""
    return float(jnp.max(jax.jit(jax.vmap(lambda a, b: _drift(system, a, b)))(start, end)))


def _drift(system: Any, start: Any, end: Any) -> jax.Array:
    flat, unravel = jfu.ravel_pytree(start)

    def conserved(flat: jax.Array) -> jax.Array:
        y = unravel(flat)
        entries = system.manifold.items()
        return jfu.ravel_pytree({name: entry.fn(0.0, y, None) for name, entry in entries})[0]

    value, gradient = conserved(flat), jax.jacfwd(conserved)(flat)
    scale = jnp.abs(value) + jnp.abs(gradient) @ jnp.abs(flat)
    return jnp.max(jnp.abs(conserved(jfu.ravel_pytree(end)[0]) - value) / scale)


# ---- The command line, and results ----


def parser(description: str, name: str) -> argparse.ArgumentParser:
    """With the options that all benchmarks have; `name` is that of the JSON."""
    parser = argparse.ArgumentParser(description=description.split("\n\n")[0])
    parser.add_argument("--smoke", action="store_true", help="tiny sizes, the same code paths")
    parser.add_argument("--only", default="", metavar="TEXT", help="parts whose name holds TEXT")
    help_ = f"JSON (default: benchmarks/results/{name}.json, none with --smoke or --only)"
    parser.add_argument("--out", type=Path, help=help_)
    parser.set_defaults(name=name)
    return parser


def suffix() -> str:
    """Of the results that are not those of float64 on the CPU."""
    device = jax.devices()[0]
    kind = "" if device.platform == "cpu" else "-" + device.device_kind.replace(" ", "-").lower()
    return kind + ("" if jax.config.jax_enable_x64 else "-float32")


def write(options: argparse.Namespace, about: dict[str, Any], **results: Any) -> None:
    out = options.out
    if out is None and not (options.smoke or options.only):
        out = RESULTS / f"{options.name}{suffix()}.json"
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps(dict(machine=about, **results), indent=1) + "\n")
        print(f"\nwrote {out}")


def read(name: str) -> dict[str, Any]:
    return json.loads((RESULTS / f"{name}.json").read_text())


def machine(*more_packages: str) -> dict[str, Any]:
    """What ran, on what and when; of `more_packages`, those that are installed."""
    device = jax.devices()[0]
    return dict(
        date=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        cpu=_cpu_model(),
        cores=os.cpu_count(),
        load=round(os.getloadavg()[0], 1),
        precision="float64" if jax.config.jax_enable_x64 else "float32",
        device=device.platform if device.platform == "cpu" else device.device_kind,
        python=platform.python_version(),
        versions={name: version(name) for name in (*PACKAGES, *more_packages) if version(name)},
        compiler=_compiler_version(),
    )


def version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((x.split(":")[1].strip() for x in lines if "model name" in x), platform.machine())


def _compiler_version() -> str:
    compiler = c_compiler()
    if compiler is None:
        return "not available: no figures for C"
    done = subprocess.run([compiler, "--version"], capture_output=True, text=True)
    return done.stdout.split("\n")[0]


def print_machine(about: dict[str, Any]) -> None:
    print("\n".join(f"{key}: {value}" for key, value in about.items()), flush=True)


def filled(text: str, tables: dict[str, list[str]]) -> str:
    """The text of a page with the lines of each table between its two markers."""
    for name, lines in tables.items():
        begin, end = f"<!-- begin: {name} -->", f"<!-- end: {name} -->"
        new = "\n".join([begin, *lines, end])
        pattern = f"{re.escape(begin)}.*?{re.escape(end)}"
        text = re.sub(pattern, lambda _, x=new: x, text, flags=re.DOTALL)
    return text
