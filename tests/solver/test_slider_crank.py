"""A slider crank from its equations of index 3, beside the equation of its angle."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc

from ..problems import largest

EPS = np.finfo(np.float64).eps

# Of B. Simeon, *Modelling a flexible slider crank mechanism by a mixed system of DAEs and PDEs*,
# 1996, with a rigid rod: lengths, masses, moments of inertia of the crank and of the rod, gravity.
L1, L2, M1, M2, M3, J1, J2, G = 0.15, 0.3, 0.36, 0.151104, 0.075552, 0.002727, 0.0045339259, 9.81
COUPLED = M2 * L1 * L2 / 2


def slider_crank(t, y, dy, args):
    ((a, b, x), (da, db, dx), (up, along)), (dq, (dda, ddb, ddx), _) = y, dy
    loop = L1 * jnp.sin(a) + L2 * jnp.sin(b), x - L1 * jnp.cos(a) - L2 * jnp.cos(b)
    forces = (
        (J1 + M2 * L1**2) * dda + COUPLED * (jnp.cos(a - b) * ddb + jnp.sin(a - b) * db**2)
        + G * (M1 / 2 + M2) * L1 * jnp.cos(a) - L1 * (up * jnp.cos(a) + along * jnp.sin(a)),
        J2 * ddb + COUPLED * (jnp.cos(a - b) * dda - jnp.sin(a - b) * da**2)
        + G * M2 / 2 * L2 * jnp.cos(b) - L2 * (up * jnp.cos(b) + along * jnp.sin(b)),
        M3 * ddx - along,
    )  # fmt: skip
    return dq[0] - da, dq[1] - db, dq[2] - dx, forces, loop


def minimal(t, y, args):
    """Lagrange's equation in the angle of the crank, with the others by trigonometry."""

    def place(a):
        b = -jnp.arcsin(L1 / L2 * jnp.sin(a))
        return jnp.stack([a, b, L1 * jnp.cos(a) + L2 * jnp.cos(b)])

    def inertia(a):
        da, db, dx = jax.jacfwd(place)(a)
        mixed = COUPLED * jnp.cos(a - place(a)[1]) * da * db
        return (J1 + M2 * L1**2) * da**2 + 2 * mixed + J2 * db**2 + M3 * dx**2

    def potential(a):
        return G * ((M1 / 2 + M2) * L1 * jnp.sin(a) + M2 / 2 * L2 * jnp.sin(place(a)[1]))

    a, w = y
    slope = jax.grad(inertia)(a) * w**2 / 2 + jax.grad(potential)(a)
    return jnp.stack([w, -slope / inertia(a)])


def loop_residuals(q, v, force):
    """Of the loop, its first and its second derivative, in units of roundoff of their terms."""
    (a, b, x), (da, db, dx), (up, along) = (np.asarray(part).T for part in (q, v, force))
    sa, ca, sb, cb = np.sin(a), np.cos(a), np.sin(b), np.cos(b)
    cos, sin, zero = COUPLED * np.cos(a - b), COUPLED * np.sin(a - b), 0 * a
    mass = [[J1 + M2 * L1**2 + zero, cos, zero], [cos, J2 + zero, zero], [zero, zero, M3 + zero]]
    right = [
        -sin * db**2 - G * (M1 / 2 + M2) * L1 * ca + L1 * (up * ca + along * sa),
        sin * da**2 - G * M2 / 2 * L2 * cb + L2 * (up * cb + along * sb),
        along,
    ]
    matrix = np.moveaxis(np.array(mass), -1, 0)
    dda, ddb, ddx = np.linalg.solve(matrix, np.array(right).T[..., None])[..., 0].T
    terms = [
        [L1 * sa, L2 * sb], [x, -L1 * ca, -L2 * cb],
        [L1 * ca * da, L2 * cb * db], [dx, L1 * sa * da, L2 * sb * db],
        [L1 * ca * dda, L2 * cb * ddb, -L1 * sa * da**2, -L2 * sb * db**2],
        [ddx, L1 * sa * dda, L2 * sb * ddb, L1 * ca * da**2, L2 * cb * db**2],
    ]  # fmt: skip
    sums = [(np.abs(sum(x)), np.max(sum(map(np.abs, x)))) for x in terms]
    return [np.max(off) / (EPS * size) for off, size in sums]


@pytest.mark.slow
def test_a_slider_crank():
    """What is hidden holds too, at saved times inside steps."""
    dae = dfc.DAE(residual=slider_crank)
    guess = (0.0, 0.0, 0.4), (150.0, -75.0, 0.0), (0.0, 0.0)
    y0 = dae.consistent(tuple(map(jnp.array, guess)))
    report = dae.report(y0)
    assert (report.index, report.freedom, report.algebraic) == (3, 2, ("y[2][0]", "y[2][1]"))
    saveat = dfx.SaveAt(ts=jnp.linspace(0.0, 0.1, 101))

    def solve(term, solver, y0, tol):
        controller = dfx.PIDController(rtol=tol, atol=tol)
        return dfx.diffeqsolve(
            term, solver, 0.0, 0.1, 1e-6, y0, stepsize_controller=controller, saveat=saveat,
            max_steps=4096,
        ).ys  # fmt: skip

    q, v, force = solve(dae.term, dae.wrap(dfc.Radau()), y0, 1e-9)
    assert max(loop_residuals(q, v, force)) < 16
    start = jnp.stack([y0[0][0], y0[1][0]])
    angle, speed = solve(dfx.ODETerm(minimal), dfx.Dopri8(), start, 1e-13).T
    assert largest(q[:, 0] - angle) < 1e-9
    assert largest(v[:, 0] / speed - 1) < 1e-9
