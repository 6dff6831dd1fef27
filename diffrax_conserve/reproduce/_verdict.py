"""The verdict for projections of a system of the catalogue, on the command line."""

import argparse
from typing import Any

import diffrax as dfx
import jax
import jax.random as jr

from .._diagnostics.compare import compare
from .._solver.unrolled import RK4
from ..learned._replace_file import replace_file
from ..systems import AbstractSystem
from ..systems._chemistry import AbstractChemistry
from ._job import SetupError, import_plot, make_writable

# The relative tolerance for stiff systems if none is given, and for their concentrations, which are
# small, the absolute one over it.
_STIFF, _SMALL = 1e-6, 1e-4


def verdict(system: AbstractSystem, options: argparse.Namespace) -> None:
    """Prints the verdict for `system`, and draws the errors into the folder `--out`.

    Raises `SetupError` before the work starts.
    """
    dt, tol, starts, out = options.dt, options.tol, options.starts, options.out
    if tol is not None and dt is not None:
        raise SetupError("--tol and --dt are adaptive steps and fixed ones: give one of them")
    if starts is not None and starts < 1:
        raise SetupError(f"--starts must be positive, but is {starts}")
    for name, value in {"--t1": options.t1, "--dt": dt, "--tol": tol}.items():
        if value is not None and not 0 < value < float("inf"):
            raise SetupError(f"{name} must be positive, but is {value:g}")
    plot = None
    if out is not None:
        plot = import_plot()
        if plot is None:
            raise SetupError(
                "--out needs matplotlib: pip install '.[plots]' in the folder of diffrax-conserve"
            )
        make_writable(out)
    y0 = system.y0
    if starts is not None:
        y0 = jax.vmap(system.sample)(jr.split(jr.key(options.seed), starts))
    solver, how = _solver(system, dt, tol)
    t1 = system.t1 if options.t1 is None else options.t1
    report = compare(
        system.vector_field, solver, system.manifold, y0, t1=t1, batch=starts is not None,
        metric=system.metric, **how,
    )  # fmt: skip
    if plot is not None and out is not None:
        for suffix in ("png", "pdf"):
            figure = plot.verdict(report)
            replace_file(out / f"verdict.{suffix}", lambda path, f=figure: plot.save(f, path))
        print(f"\nWhat is written is in {out}")


def _solver(
    system: AbstractSystem, dt: float | None, tol: float | None
) -> tuple[dfx.AbstractSolver, dict[str, Any]]:
    """The solver, and options of `compare` that go with it."""
    if isinstance(system, AbstractChemistry):
        if dt is not None:
            raise SetupError(f"--dt: {system.name} is stiff, and needs adaptive steps: give --tol")
        tol = _STIFF if tol is None else tol
        projection = system.mechanism.positive_projection()
        return dfx.Kvaerno5(), {"rtol": tol, "atol": _SMALL * tol, "projection": projection}
    if tol is None:
        return RK4(), {"dt0": system.dt if dt is None else dt}
    return dfx.Tsit5(), {"rtol": tol, "atol": tol}
