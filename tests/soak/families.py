"""Families of manifold functions for candidates from anywhere: `fn(xp, y, a)`, see `oracle`."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from .oracle import Function, log_uniform


def _normal(rng: Any, n: int, lanes: int) -> np.ndarray:
    return rng.normal(size=(n, lanes)) * log_uniform(rng, 0.1, 5, lanes)


def _positive(rng: Any, n: int, lanes: int) -> np.ndarray:
    return log_uniform(rng, 0.2, 4, (n, lanes))


def _orbit(rng: Any, n: int, lanes: int) -> np.ndarray:
    """Positions of size 1, spread so that no two coincide, and velocities of size 1."""
    y = 0.3 * rng.normal(size=(n, lanes))
    y[0] += 1
    y[n - 1] += 1
    return y


def _satellite(rng: Any, n: int, lanes: int) -> np.ndarray:
    return _orbit(rng, n, lanes) * np.array([7e6, 7e6, 7.5e3, 7.5e3])[:, None]


def _unit(rng: Any, n: int, lanes: int) -> np.ndarray:
    y = rng.normal(size=(n, lanes))
    return y / np.linalg.norm(y, axis=0)


class Family(NamedTuple):
    fn: Function
    n: int  # unknowns
    state: Callable[..., np.ndarray] = _normal
    # The range of each parameter.
    a: tuple[tuple[float, float], ...] = ()
    constraint: bool = False
    # Its gradients do not show all that is added: it has more roundoff than the oracle allows.
    hides: bool = False

    def draw(self, rng: Any, lanes: int) -> tuple[np.ndarray, np.ndarray]:
        """States and parameters."""
        y = self.state(rng, self.n, lanes)
        return y, np.stack([log_uniform(rng, *r, lanes) for r in (*self.a, (0.5, 2))])


def _small(rng: Any, n: int, lanes: int) -> np.ndarray:
    return rng.normal(size=(n, lanes)) * log_uniform(rng, 1e-4, 0.3, lanes)


def _network(seed: int, gain: float) -> Any:
    rng = np.random.default_rng(seed)
    layers = [
        (rng.normal(size=(m, n)) / np.sqrt(n), rng.normal(size=m))
        for n, m in ((2, 32), (32, 32), (32, 1))
    ]

    def fn(xp: Any, y: Any, a: Any) -> list[Any]:
        x = gain * xp.stack([y[0], y[1]])
        for w, b in layers:
            x = xp.tensordot(w, x, 1) + b.reshape(-1, *[1] * (x.ndim - 1))
            x = xp.tanh(x) if len(b) > 1 else x
        return [a[0] * x[0]]

    return fn


def _square(y: Any) -> Any:
    return sum(x * x for x in y)


def _r(xp: Any, y: Any, i: int, j: int) -> Any:
    return xp.sqrt((y[2 * i] - y[2 * j]) ** 2 + (y[2 * i + 1] - y[2 * j + 1]) ** 2)


def _kepler(xp: Any, y: Any, a: Any) -> list[Any]:
    h = 0.5 * (y[2] * y[2] + y[3] * y[3]) - a[0] / xp.sqrt(y[0] * y[0] + y[1] * y[1])
    return [h, y[0] * y[3] - y[1] * y[2]]


def _vortices(xp: Any, y: Any, a: Any) -> list[Any]:
    g = (1, a[0], a[1])
    h = sum(g[i] * g[j] * xp.log(_r(xp, y, i, j)) for i, j in ((0, 1), (0, 2), (1, 2)))
    # The angular impulse and one of the linear ones.
    return [h, sum(g[i] * _square(y[2 * i : 2 * i + 2]) for i in range(3)), y[0] + a[0] * y[2]]


def _satellite_energy(xp: Any, y: Any, a: Any) -> list[Any]:
    r = xp.sqrt(y[0] * y[0] + y[1] * y[1])
    return [a[0] * (0.5 * (y[2] * y[2] + y[3] * y[3]) - 3.986e14 / r)]


FAMILIES: dict[str, Family] = {
    "exponential": Family(lambda xp, y, a: [y[0] + xp.exp(y[1]), y[1] - a[0]], 2, a=((0.01, 200),)),
    "quartic": Family(lambda xp, y, a: [sum(x**4 for x in y)], 2),
    "powers": Family(
        lambda xp, y, a: [xp.exp(0.5 * a[0] * xp.log(y[0] * y[0])) + a[1] * y[1] ** 2],
        2,
        _positive,
        ((0.2, 15), (1e-3, 1e3)),
    ),
    "pendulum": Family(
        lambda xp, y, a: [0.5 * y[1] ** 2 - a[0] * xp.cos(y[0])], 2, a=((1e-2, 1e2),)
    ),
    "waves": Family(
        lambda xp, y, a: [xp.sin(a[0] * y[0]) + y[1], y[0] * xp.cos(y[2])], 3, a=((0.1, 300),)
    ),
    "kepler": Family(_kepler, 4, _orbit, ((0.3, 3),)),
    "vortices": Family(_vortices, 6, _orbit, ((0.3, 3), (0.3, 3))),
    "toda": Family(
        lambda xp, y, a: [
            0.5 * _square(y[3:]) + xp.exp(y[0] - y[1]) + xp.exp(y[1] - y[2]) + xp.exp(y[2] - y[0]),
            y[3] + y[4] + y[5],
        ],
        6,
    ),
    "populations": Family(
        lambda xp, y, a: [a[0] * y[0] - xp.log(y[0]) + y[1] - a[1] * xp.log(y[1])],
        2,
        _positive,
        ((0.2, 5), (0.2, 5)),
    ),
    "relativistic": Family(
        lambda xp, y, a: [xp.sqrt(1 + y[2] ** 2 + y[3] ** 2) - a[0] / xp.sqrt(_square(y[:2]))],
        4,
        _orbit,
        ((0.05, 2),),
    ),
    "rows": Family(
        lambda xp, y, a: [1e12 * (y[0] ** 2 + y[1] ** 2), 1e-12 * a[0] * y[2] * y[0]],
        3,
        a=((1e-3, 1e3),),
    ),
    "satellite": Family(_satellite_energy, 4, _satellite, ((5.97e24, 6e24),)),
    "atom": Family(
        lambda xp, y, a: [0.5 * a[0] * _square(y[2:]) + a[0] * 1e4 * _square(y[:2])],
        4,
        lambda rng, n, lanes: 300 * _normal(rng, n, lanes),
        ((1e-27, 1e-25),),
    ),
    "nearly parallel": Family(
        lambda xp, y, a: [_square(y), y[0] ** 2 + y[1] ** 2 + (1 + a[0]) * y[2] ** 2],
        3,
        a=((1e-13, 0.1),),
    ),
    "sphere": Family(lambda xp, y, a: [_square(y) - 1], 3, _unit, constraint=True),
    "big sphere": Family(
        lambda xp, y, a: [1e8 * (_square(y) - 1), 1e8 * (_square(y) - 1)], 4, _unit, constraint=True
    ),
    "rest": Family(
        lambda xp, y, a: [0.5 * y[1] ** 2 + a[0] * (1 - xp.cos(y[0]))], 2, _small, hides=True
    ),
    "offset": Family(
        lambda xp, y, a: [a[0] + 0.5 * y[1] ** 2 - xp.cos(y[0])], 2, _small, ((1, 100),), hides=True
    ),
    "network": Family(_network(0, 1.0), 2, a=((0.1, 10),), hides=True),
    "steep network": Family(_network(1, 4.0), 2, a=((0.1, 10),), hides=True),
    "molecule": Family(
        lambda xp, y, a: [y[1] ** 2 + a[0] * (1 - xp.exp(-1.9 * (y[0] - 1.4))) ** 2],
        2,
        lambda rng, n, lanes: np.stack(
            [np.full(lanes, 1.4), rng.normal(size=lanes) * log_uniform(rng, 1e-3, 0.3, lanes)]
        ),
        ((0.1, 0.3),),
        hides=True,
    ),
}
