"""Other programs that solve the same equations, for work_precision.py: scipy, homproj, heyoka and
CVODE. None of them takes functions of jax, so the equations stand here once more, in Python.

homproj and heyoka are optional: `pip install '.[bench]'`. CVODE needs a C compiler and the headers
of SUNDIALS (Debian: libsundials-dev). What is not there is left out, and named by `missing`.
"""

import ctypes
import functools as ft
import importlib.util
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import measuring
import numpy as np
import scipy.integrate
from curves import Solve

CVODE = ("sundials_cvode", "sundials_nvecserial", "sundials_sunnonlinsolfixedpoint")


class Equations(NamedTuple):
    """Of one system: the vector field, of numbers or of heyoka's expressions; the integrals and
    their gradients, of separate numbers as homproj has it; the name that the C program knows."""

    size: int
    vector_field: Callable[[float, Sequence[Any]], list[Any]]
    integrals: tuple[Callable[..., float], ...]
    gradients: tuple[Callable[..., np.ndarray], ...]
    define: str


def _rigid_body() -> Equations:
    inertia = np.array([0.1, 0.2, 0.3])
    i, j, k = inertia.tolist()
    a, b, c = (j - k) / (j * k), (k - i) / (k * i), (i - j) / (i * j)
    return Equations(
        3,
        lambda t, w: [a * w[1] * w[2], b * w[2] * w[0], c * w[0] * w[1]],
        (
            lambda x, y, z: (x * x / i + y * y / j + z * z / k) / 2,
            lambda x, y, z: (x * x + y * y + z * z) / 2,
        ),
        (lambda *w: np.array(w) / inertia, lambda *w: np.array(w)),
        "-DRIGID_BODY",
    )


def _kepler() -> Equations:
    def vector_field(t: float, y: Sequence[Any]) -> list[Any]:
        x, y, u, v = y
        inverse = (x * x + y * y) ** -1.5
        return [u, v, -x * inverse, -y * inverse]

    def energy_gradient(x: float, y: float, u: float, v: float) -> np.ndarray:
        inverse = (x * x + y * y) ** -1.5
        return np.array([x * inverse, y * inverse, u, v])

    return Equations(
        4,
        vector_field,
        (
            lambda x, y, u, v: (u * u + v * v) / 2 - 1 / math.hypot(x, y),
            lambda x, y, u, v: x * v - y * u,
        ),
        (energy_gradient, lambda x, y, u, v: np.array([v, -u, -y, x])),
        "-DKEPLER",
    )


EQUATIONS = {"rigid-body": _rigid_body(), "kepler": _kepler()}


def _each(solve: Solve) -> Solve:
    """One trajectory after the other."""
    return lambda tolerance, start: np.stack([solve(tolerance, y0) for y0 in start])


def scipy_dop853(equations: Equations, t1: float) -> Solve:
    def solve(tolerance: float, y0: np.ndarray) -> np.ndarray:
        found = scipy.integrate.solve_ivp(
            equations.vector_field, (0.0, t1), y0, "DOP853", [t1], rtol=tolerance, atol=tolerance
        )
        return found.y[:, -1]

    return _each(solve)


def homproj(equations: Equations, t1: float) -> Solve | None:
    """DOP853 with the homogeneous projection of B. K. Tapley, arXiv:2511.02131."""
    if importlib.util.find_spec("homproj") is None:
        return None
    import homproj

    def solve(tolerance: float, y0: np.ndarray) -> np.ndarray:
        found = homproj.solve_ivp(
            equations.vector_field,
            (0.0, t1),
            y0,
            method="DOP853",
            rtol=tolerance,
            atol=tolerance,
            invariants=list(equations.integrals),
            gradients=list(equations.gradients),
            integrator="rk2",
            itol=1e-14,
            max_iterations=10,
        )
        return found.y[:, -1]

    return _each(solve)


def cvode(equations: Equations, t1: float, *, projected: bool) -> Solve | None:
    """Adams' formulas, or BDF with CVODE's projection, for which it takes no other."""
    source = measuring.HERE / "cvode_projection.c"
    library = measuring.c_library(source, equations.define, libraries=CVODE)
    if library is None:
        return None
    integrate = library.integrate
    pointer = np.ctypeslib.ndpointer(np.float64, flags="C_CONTIGUOUS")
    integrate.argtypes = [pointer, *[ctypes.c_double] * 2, *[ctypes.c_int] * 2]

    def solve(tolerance: float, y0: np.ndarray) -> np.ndarray:
        y = y0.copy()
        if integrate(y, t1, tolerance, 2 if projected else 1, projected) < 0:
            raise RuntimeError(f"CVODE failed at tolerance {tolerance}")
        return y

    return _each(solve)


def heyoka(
    equations: Equations, t1: float, tolerances: Sequence[float], width: int = 1
) -> Solve | None:
    """Taylor series, `width` trajectories side by side in vector registers.

    One integrator for each tolerance, compiled here. `fast_math` is the faster
    setting here, and so are series whose loops are written out, the default.
    """
    if importlib.util.find_spec("heyoka") is None:
        return None
    import heyoka

    variables = heyoka.make_vars(*[f"y{i}" for i in range(equations.size)])
    system = list(zip(variables, equations.vector_field(0.0, variables), strict=True))
    make = heyoka.taylor_adaptive if width == 1 else heyoka.taylor_adaptive_batch
    shape = (equations.size,) if width == 1 else (equations.size, width)
    integrators = {x: make(system, np.ones(shape), tol=x, fast_math=True) for x in tolerances}

    def solve(tolerance: float, start: np.ndarray) -> np.ndarray:
        integrator, end = integrators[tolerance], np.empty_like(start)
        set_time = integrator.set_time if width > 1 else ft.partial(setattr, integrator, "time")
        for first in range(0, len(start), width):
            chunk = start[first : first + width]
            set_time(0.0)
            integrator.state[:] = np.resize(chunk, (width, equations.size)).T.reshape(shape)
            integrator.propagate_until(t1)
            end[first : first + width] = integrator.state.reshape(-1, width).T[: len(chunk)]
        return end

    return solve


def missing() -> list[str]:
    """What is not installed."""
    found = {
        "homproj (pip)": homproj(EQUATIONS["kepler"], 1.0),
        "heyoka (pip)": heyoka(EQUATIONS["kepler"], 1.0, [1e-6]),
        "CVODE (a C compiler and libsundials-dev)": cvode(EQUATIONS["kepler"], 1.0, projected=True),
    }
    return [name for name, solve in found.items() if solve is None]
