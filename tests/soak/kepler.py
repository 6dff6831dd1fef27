"""Kepler orbits in long double: projections to energy and angular momentum, for `gradients`.

On a circular orbit the gradients of both are parallel. So they are replaced by the eccentricity
vector E and l: H and l are what they are to be exactly where `|E|² = 1 + 2 H l²` and l are, and
those two have good derivatives at any eccentricity. States have shape (4, lanes).
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from .oracle import derivative

Level = tuple[np.ndarray, np.ndarray]  # |E|² and l


def momentum(y: np.ndarray) -> np.ndarray:
    return y[0] * y[3] - y[1] * y[2]


def eccentricity(y: np.ndarray) -> np.ndarray:
    l, r = momentum(y), np.sqrt(y[0] ** 2 + y[1] ** 2)
    return np.stack([y[3] * l - y[0] / r, -y[2] * l - y[1] / r])


def level(y: np.ndarray) -> Level:
    e = eccentricity(y)
    return e[0] ** 2 + e[1] ** 2, momentum(y)


def orbit(e: Any, l: Any, phi: Any, omega: Any) -> np.ndarray:
    """The state at the polar angle `phi`, with the pericentre at `omega`."""
    r = l * l / (1 + e * np.cos(phi - omega))
    v = [-np.sin(phi) - e * np.sin(omega), np.cos(phi) + e * np.cos(omega)]
    return np.stack([r * np.cos(phi), r * np.sin(phi), v[0] / l, v[1] / l])


def solve2(fn: Callable[..., Any], x: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Newton's method for two equations in two unknowns: the root, and the last step's length."""
    e1, e2 = np.zeros_like(x), np.zeros_like(x)
    e1[0], e2[1] = 1, 1
    length = np.full(x.shape[1:], np.inf, np.longdouble)
    for _ in range(steps):
        f = np.stack(fn(x))
        (a, c), (b, d) = derivative(fn, x, e1), derivative(fn, x, e2)
        det = a * d - b * c
        step = np.stack([d * f[0] - b * f[1], a * f[1] - c * f[0]]) / det
        long_step = np.sqrt(step[0] ** 2 + step[1] ** 2)
        step = step * np.minimum(1, 0.3 / long_step)
        x, length = x - step, long_step
    return x, length


def nearest(z: np.ndarray, to: Level, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The point of the level nearest to `z`, by the two angles of an orbit, starting at `near`."""
    e, l = np.sqrt(np.maximum(to[0], 0)), to[1]

    def stationary(x: np.ndarray) -> list[np.ndarray]:
        phi, omega = x
        c, s = np.cos(phi - omega), np.sin(phi - omega)
        r = l * l / (1 + e * c)
        turn = r * r * s / (l * l)  # minus (1/e) dr/domega, and (1/e) dr/dphi
        gap = orbit(e, l, phi, omega) - z
        radial = gap[0] * np.cos(phi) + gap[1] * np.sin(phi)
        tangential = -gap[0] * np.sin(phi) + gap[1] * np.cos(phi)
        along = -(gap[2] * np.cos(phi) + gap[3] * np.sin(phi)) / l
        along_e = -(gap[2] * np.cos(omega) + gap[3] * np.sin(omega)) / l
        return [e * turn * radial + r * tangential + along, along_e - turn * radial]

    start = eccentricity(near)
    first = np.stack([np.arctan2(near[1], near[0]), np.arctan2(start[1], start[0])])
    # By how much the second angle is off matters as much as the eccentricity.
    angles, length = solve2(stationary, first, 12)
    return orbit(e, l, *angles), length * np.maximum(e, 1e-12)


def frozen(z: np.ndarray, to: Level, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The point of the level in the plane of the gradients at `z`, starting at `near`."""
    e = eccentricity(z)
    e = e / np.sqrt(e[0] ** 2 + e[1] ** 2)
    # Gradients of |E|² over 2 |E|, and of l; then made orthonormal.
    first, second = np.zeros_like(z), np.zeros_like(z)
    for k, unit in enumerate(np.eye(4)):
        along = unit[:, None] + 0 * z
        first[k] = (e * derivative(lambda y: list(eccentricity(y)), z, along)).sum(0)
        second[k] = derivative(lambda y: [momentum(y)], z, along)[0]
    first = first / np.sqrt((first**2).sum(0))
    second = second - first * (first * second).sum(0)
    second = second / np.sqrt((second**2).sum(0))

    def residual(s: np.ndarray) -> list[np.ndarray]:
        square, l = level(z + s[0] * first + s[1] * second)
        return [square - to[0], l - to[1]]

    start = np.stack([(first * (near - z)).sum(0), (second * (near - z)).sum(0)])
    s, length = solve2(residual, start, 12)
    return z + s[0] * first + s[1] * second, length


def rk4(y: np.ndarray, dt: np.ndarray) -> np.ndarray:
    def f(y: np.ndarray) -> np.ndarray:
        pull = (y[0] ** 2 + y[1] ** 2) ** np.longdouble(-1.5)
        return np.stack([y[2], y[3], -y[0] * pull, -y[1] * pull])

    k1 = f(y)
    k2 = f(y + dt / 2 * k1)
    k3 = f(y + dt / 2 * k2)
    k4 = f(y + dt * k3)
    return y + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
