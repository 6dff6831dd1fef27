"""A lane of a batch is that lane alone, in value and derivative, however many steps it takes.

While the longest lane of a batch goes on, diffrax evaluates steps of no length in the lanes that
have arrived, and discards the results. In reverse mode their cotangents are zero, and zero times a
derivative that is infinite is NaN.
"""

import diffrax as dfx
import jax.numpy as jnp

import diffrax_conserve as dfc

from ..learned import Rotation

ENERGY = dfc.FirstIntegral(lambda t, y, p: y[1] ** 2 / 2 - p * jnp.cos(y[0]))
LOSSES = dfc.FirstIntegral(ENERGY.fn, rate=lambda t, y, p: -0.1 * y[1] ** 2)
PENDULUM = dfx.ODETerm(lambda t, y, p: jnp.stack([y[1], -p * jnp.sin(y[0])]))
DAMPED = dfx.ODETerm(lambda t, y, p: jnp.stack([y[1], -p * jnp.sin(y[0]) - 0.1 * y[1]]))
SPLIT = dfx.ODETerm(lambda t, v, p: v), dfx.ODETerm(lambda t, q, p: -p * jnp.stack([0 * t, 1.0]))
CIRCLE = dfc.Constraint(lambda t, q, p: jnp.sum(q**2) - 1)
TURN = dfx.ODETerm(lambda t, y, p: p * jnp.stack([-y[1], y[0]]))
# Five rotors, each of unit length.
ROTORS = dfc.Constraint(lambda t, y, p: jnp.sum(y**2, axis=1) - 1)
TURNS = dfx.ODETerm(lambda t, y, p: p * jnp.stack([-y[:, 1], y[:, 0]], axis=1))
SHARES = dfc.Constraint(lambda t, y, p: jnp.sum(y) - 1)
DECAY = dfx.ODETerm(lambda t, y, p: p * jnp.stack([-y[0], y[0] - y[1], y[1]]))
BEAD = dfc.DAE(
    lambda t, x, z, p: jnp.stack([x[2], x[3], z * x[0], z * x[1] - p]),
    algebraic=lambda t, x, z, p: x[0] ** 2 + x[1] ** 2 - 1,
)
INDEX_1 = dfc.DAE(lambda t, x, z, p: -p * z, algebraic=lambda t, x, z, p: z + z**3 - x)
ROTATION = Rotation(max_step=1.0, args_domain=None)

BEGIN = jnp.array([1.0, 0.5])
EAST = jnp.array([1.0, 0.0])
BEAD0 = jnp.array([1.0, 0.0, 0.0, 0.2]), jnp.array(-0.04)
wrap = dfc.ManifoldProjection


def nearby(**options):
    return wrap(dfx.Tsit5(), ENERGY, **options)


# Terms, solver, initial state.
CASES = {
    "Dopri5 of diffrax": (PENDULUM, dfx.Dopri5(), BEGIN),
    "projected Dopri5": (PENDULUM, wrap(dfx.Dopri5(), ENERGY), BEGIN),
    "projected Kvaerno5": (PENDULUM, wrap(dfx.Kvaerno5(), ENERGY), BEGIN),
    "constraint": (TURN, wrap(dfx.Bosh3(), CIRCLE), EAST),
    "many constraints": (TURNS, wrap(dfx.Heun(), ROTORS), jnp.tile(EAST, (5, 1))),
    "Newton": (PENDULUM, nearby(projection=dfc.Newton()), BEGIN),
    "along error": (PENDULUM, nearby(projection=dfc.AlongLine(direction="error")), BEGIN),
    "along step": (PENDULUM, nearby(projection=dfc.AlongLine(direction="step")), BEGIN),
    "staged": (
        PENDULUM,
        wrap(dfx.Tsit5(), {"energy": ENERGY}, projection=dfc.Staged(("energy", dfc.Newton()))),
        BEGIN,
    ),
    "bounds": (
        DECAY,
        wrap(dfx.Heun(), SHARES, projection=dfc.SimplifiedNewton(lower=0.0)),
        jnp.array([1.0, 0.0, 0.0]),
    ),
    "balance": (DAMPED, wrap(dfx.Tsit5(), LOSSES), BEGIN),
    "keep linear": (PENDULUM, nearby(keep_linear=True), BEGIN),
    "longest correction": (PENDULUM, nearby(max_correction=0.5), BEGIN),
    "metric": (PENDULUM, nearby(projection=dfc.SimplifiedNewton(metric=1.0)), BEGIN),
    "RK4": (PENDULUM, wrap(dfc.RK4(), ENERGY), BEGIN),
    "ImplicitMidpoint": (PENDULUM, dfc.ImplicitMidpoint(), BEGIN),
    "SymmetricProjection": (
        PENDULUM,
        dfc.SymmetricProjection(dfc.ImplicitMidpoint(), ENERGY),
        BEGIN,
    ),
    "RATTLE": (SPLIT, dfc.RATTLE(CIRCLE, masses=1.0), (EAST, 0.2 * EAST[::-1])),
    "Radau": (PENDULUM, dfc.Radau(), BEGIN),
    "projected Radau": (PENDULUM, wrap(dfc.Radau(), ENERGY), BEGIN),
    "DAE of index 1": (INDEX_1.term, INDEX_1.wrap(dfc.Radau()), (jnp.array(2.0), jnp.array(1.0))),
    "DAE of index 3": (BEAD.term, BEAD.wrap(dfc.Radau()), BEAD0),
    "DAE by Tsit5": (BEAD.term, BEAD.wrap(dfx.Tsit5()), BEAD0),
}
