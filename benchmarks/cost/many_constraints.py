"""Projection with many constraints, and with many bodies.

1. A hanging chain of rigid bonds, bond lengths and relative velocities along the bonds kept: twice
   as many constraints as bonds; and with bond lengths alone.
2. Spins on a line that turn about their neighbours (Landau and Lifshitz): the length of each,
   and the energy.
3. Rigid molecules of water in a periodic field: three bonds each, and the energy.
4. Kepler orbits that know nothing of each other, in one state: the energy of each.
5. Gravitating bodies with the ten classical integrals: energy, momentum, the motion of the centre
   of mass, angular momentum.

For each size: seconds per step of RK4, or of the method in its name, plain and projected, the
memory that the compiled step needs besides its arguments (in multiples of the state: constant if
memory is linear), and the residuals.
"""

import functools as ft

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import measuring
import numpy as np

import diffrax_conserve as dfc

GRAVITY = jnp.array([0.0, 0.0, -9.81])


# ---- A chain: q has shape (bonds, 3), the first bond hangs from the origin ----


def differences(x):
    return jnp.diff(x, axis=0, prepend=jnp.zeros((1, 3)))


def chain_vector_field(t, y, args):
    """Unit masses; the tensions solve the tridiagonal system that keeps `d·d` constant twice
    differentiated."""
    q, v = y
    d, w = differences(q), differences(v)
    # The acceleration of bead i is g + T_{i+1} d_{i+1} - T_i d_i.
    diagonal = 2 * jnp.sum(d * d, -1)
    diagonal = diagonal.at[0].divide(2)
    off = -jnp.sum(d[1:] * d[:-1], -1)
    zero = jnp.zeros(1)
    free = jnp.zeros_like(d).at[0].set(GRAVITY)  # relative accelerations without tensions
    rhs = jnp.sum(w * w, -1) + jnp.sum(free * d, -1)
    tension = jax.lax.linalg.tridiagonal_solve(
        jnp.concatenate([zero, off]), diagonal, jnp.concatenate([off, zero]), rhs[:, None]
    )[:, 0]
    pull = tension[:, None] * d
    return v, GRAVITY - pull + jnp.concatenate([pull[1:], jnp.zeros((1, 3))])


def bond_lengths(t, y, args):
    d = differences(y[0])
    return jnp.sum(d * d, -1) - 1


def bond_velocities(t, y, args):
    return jnp.sum(differences(y[0]) * differences(y[1]), -1)


CHAIN = {"length": dfc.Constraint(bond_lengths), "velocity": dfc.Constraint(bond_velocities)}


def chain(bonds):
    """Hanging, and bent by random angles."""
    angles = np.random.default_rng(0).normal(scale=0.3, size=(bonds, 2))
    d = np.stack([np.sin(angles[:, 0]), np.sin(angles[:, 1]) * np.cos(angles[:, 0])], -1)
    d = np.concatenate([d, -np.sqrt(1 - np.sum(d**2, -1, keepdims=True))], -1)
    return jnp.cumsum(jnp.asarray(d), axis=0), jnp.zeros((bonds, 3))


# ---- Spins: s has shape (spins, 3) ----


def spin_energy(t, y, args):
    return -jnp.sum(y[1:] * y[:-1]) - jnp.sum(y[:, 2] ** 2) / 2


def spin_vector_field(t, y, args):
    zero = jnp.zeros((1, 3))
    field = jnp.concatenate([y[1:], zero]) + jnp.concatenate([zero, y[:-1]])
    field = field + y * jnp.array([0.0, 0.0, 1.0])
    (a, b, c), (u, v, w) = y.T, field.T
    return jnp.stack([b * w - c * v, c * u - a * w, a * v - b * u], axis=1)


SPINS = {
    "length": dfc.Constraint(lambda t, y, args: jnp.sum(y**2, axis=1) - 1),
    "energy": dfc.FirstIntegral(spin_energy),
}


def spins(count):
    y = np.random.default_rng(0).normal(size=(count, 3))
    return jnp.asarray(y / np.linalg.norm(y, axis=1, keepdims=True))


# ---- Molecules: q and v have shape (molecules, atoms, 3) ----

MASSES = np.array([16.0, 1.0, 1.0])
BONDS = np.array([[0, 1], [0, 2], [1, 2]])
WATER = np.array([[0.0, 0.0, 0.0], [0.9572, 0.0, 0.0], [-0.24, 0.9266, 0.0]])
LENGTHS = np.sum((WATER[BONDS[:, 0]] - WATER[BONDS[:, 1]]) ** 2, axis=1)
# The atoms at the ends of each bond, with signs.
ENDS = (np.eye(3)[BONDS[:, 0]] - np.eye(3)[BONDS[:, 1]]).T


def apart(x):
    return x[:, BONDS[:, 0]] - x[:, BONDS[:, 1]]


def molecule_lengths(t, y, args):
    return jnp.sum(apart(y[0]) ** 2, axis=2) - LENGTHS


def molecule_energy(t, y, args):
    q, v = y
    return jnp.sum(MASSES[:, None] * v**2) / 2 + jnp.sum(1 - jnp.cos(q))


def molecule_vector_field(t, y, args):
    """The tensions of the three bonds solve a system of their own in each molecule."""
    q, v = y
    pull = -jnp.sin(q) / MASSES[:, None]
    d, w = apart(q), apart(v)
    (a, b, c), r = jnp.moveaxis(d, 1, 0), -jnp.sum(w * w, 2) - jnp.sum(d * apart(pull), 2)
    coupling = (ENDS.T / MASSES) @ ENDS
    m = [
        [coupling[i, j] * jnp.sum(x * z, 1) for j, z in enumerate((a, b, c))]
        for i, x in enumerate((a, b, c))
    ]
    minor = lambda i, j, k, l: m[i][k] * m[j][l] - m[i][l] * m[j][k]  # noqa: E731
    c0, c1, c2 = minor(1, 2, 1, 2), minor(1, 2, 0, 2), minor(1, 2, 0, 1)
    determinant = m[0][0] * c0 - m[0][1] * c1 + m[0][2] * c2
    inverse = [
        [c0, -minor(0, 2, 1, 2), minor(0, 1, 1, 2)],
        [-c1, minor(0, 2, 0, 2), -minor(0, 1, 0, 2)],
        [c2, -minor(0, 2, 0, 1), minor(0, 1, 0, 1)],
    ]
    tension = jnp.stack([sum(x * r[:, j] for j, x in enumerate(row)) for row in inverse], 1)
    forces = (tension / determinant[:, None])[..., None] * d
    return v, pull + jnp.stack(
        [forces[:, 0] + forces[:, 1], -forces[:, 0] + forces[:, 2], -forces[:, 1] - forces[:, 2]], 1
    ) / MASSES[:, None]


MOLECULES = {
    "length": dfc.Constraint(molecule_lengths),
    "energy": dfc.FirstIntegral(molecule_energy),
}


def molecules(count):
    rng = np.random.default_rng(0)
    q = WATER + rng.uniform(0, 100, size=(count, 1, 3))
    centre = np.sum(MASSES[:, None] * q, 1, keepdims=True) / np.sum(MASSES)
    v = rng.normal(size=(count, 1, 3)) + np.cross(rng.normal(size=(count, 1, 3)), q - centre)
    return jnp.asarray(q), jnp.asarray(v)


# ---- Orbits: q and v have shape (orbits, 2) ----


def orbits_vector_field(t, y, args):
    q, v = y
    return v, -q / jnp.sum(q * q, -1, keepdims=True) ** 1.5


def orbit_energies(t, y, args):
    q, v = y
    return jnp.sum(v * v, -1) / 2 - 1 / jnp.sqrt(jnp.sum(q * q, -1))


ORBITS = {"energy": dfc.FirstIntegral(orbit_energies)}


def orbits(count):
    """At their pericentres, with eccentricities up to 0.6."""
    e = np.random.default_rng(0).uniform(0, 0.6, count)
    q = np.stack([1 - e, 0 * e], 1)
    return jnp.asarray(q), jnp.asarray(np.stack([0 * e, np.sqrt((1 + e) / (1 - e))], 1))


# ---- Gravitating bodies; the sums over pairs go row by row, so that memory is linear ----

SOFTENING = 1e-2
CHUNK = 100


def over_rows(fn, q):
    return jax.lax.map(jax.checkpoint(fn), q.reshape(-1, min(CHUNK, len(q)), 3))


def inverse_distances(rows, q):
    d = rows[:, None] - q[None]
    return d, jax.lax.rsqrt(jnp.sum(d * d, -1) + SOFTENING**2)


def pair_sums(q):
    """The accelerations and the potential energy."""

    def of_rows(rows):
        d, inverse = inverse_distances(rows, q)
        return -jnp.einsum("ij,ijk->ik", inverse**3, d), jnp.sum(inverse)

    pulls, sums = over_rows(of_rows, q)
    return pulls.reshape(q.shape) / len(q), -(jnp.sum(sums) - len(q) / SOFTENING) / (2 * len(q))


def bodies_vector_field(t, y, args):
    q, v = y
    return v, pair_sums(q)[0]


@jax.custom_jvp
def potential(q):
    return pair_sums(q)[1]


@potential.defjvp
def _(primals, tangents):
    # The gradient is minus the acceleration, whose pairs are those of the energy.
    (q,), (dq,) = primals, tangents
    acceleration, energy = pair_sums(q)
    return energy, -jnp.sum(acceleration * dq)


def energy(t, y, args):
    q, v = y
    return jnp.sum(v * v) / 2 + potential(q)


def momentum(t, y, args):
    return jnp.sum(y[1], 0)


def centre_of_mass(t, y, args):
    return jnp.sum(y[0], 0) - t * jnp.sum(y[1], 0)


def angular_momentum(t, y, args):
    return jnp.sum(jnp.cross(*y), 0)


BODIES = {
    f.__name__: dfc.FirstIntegral(f) for f in (energy, momentum, centre_of_mass, angular_momentum)
}


def bodies(count):
    rng = np.random.default_rng(0)
    return jnp.asarray(rng.normal(size=(count, 3))), jnp.asarray(0.5 * rng.normal(size=(count, 3)))


# ---- Measuring ----


def measure(name, vector_field, manifold, y0, dt, steps, plain_steps, method=None, rounds=3):
    state_bytes = sum(x.nbytes for x in jax.tree.leaves(y0))
    row = {"problem": name, "unknowns": sum(x.size for x in jax.tree.leaves(y0))}
    plain = method or dfc.RK4()
    solvers = {"plain": plain, "projected": dfc.ManifoldProjection(plain, manifold)}
    for label, solver in solvers.items():

        @eqx.filter_jit
        def solve(y0, t1, solver=solver):
            return dfx.diffeqsolve(
                dfx.ODETerm(vector_field), solver, 0.0, t1, dt, y0, max_steps=None, throw=False
            )

        # The difference of two solves: without what is done once.
        count = steps if label == "projected" else plain_steps
        t1s = [jnp.asarray(dt), jnp.asarray((1 + count) * dt)]
        begin = measuring.clock()
        compiled = solve.lower(y0, t1s[0]).compile()
        row[f"{label} compile seconds"] = measuring.clock() - begin
        runs = {i: ft.partial(compiled, y0, t1) for i, t1 in enumerate(t1s)}
        one, all_ = measuring.take_turns(runs, rounds, long=0.5).values()
        sol = all_.answer
        row[f"{label} s/step"] = (all_.seconds - one.seconds) / count
        memory = compiled.compiled.memory_analysis()
        row[f"{label} memory/state"] = memory.temp_size_in_bytes / state_bytes
        row[f"{label} succeeded"] = bool(sol.result == dfx.RESULTS.successful)
        states = jax.tree.map(lambda a, b: jnp.stack([a, b[-1]]), y0, sol.ys)
        times = jnp.array([0.0, t1s[1]])
        saved = eqx.tree_at(lambda s: (s.ts, s.ys), sol, (times, states))
        row[f"{label} drift"] = max(
            float(jnp.max(jnp.abs(x))) for x in jax.tree.leaves(dfc.drift(saved, manifold))
        )
    return row


def main(argv=None):
    options = measuring.parser(__doc__, "many_constraints").parse_args(argv)
    few, many = ([100], [100]) if options.smoke else ([200, 1000], [1000, 10_000])
    large = few if options.smoke else [200, 1000, 10_000, 100_000]
    cases = [
        (f"chain, {n} bonds", chain_vector_field, CHAIN, chain(n), 1e-3) for n in few + many[1:]
    ]
    bonds = {"length": CHAIN["length"]}
    cases += [
        (f"chain, lengths of {n} bonds", chain_vector_field, bonds, chain(n), 1e-3) for n in large
    ]
    most = large if options.smoke else [*large, 1_000_000]
    cases += [(f"{n} spins", spin_vector_field, SPINS, spins(n), 2e-2) for n in most]
    cases += [
        (f"{n} molecules", molecule_vector_field, MOLECULES, molecules(n), 1e-2) for n in large
    ]
    size = lambda y0: sum(x.size for x in jax.tree.leaves(y0))  # noqa: E731
    cases = [(*case, max(5, 100_000 // size(case[3])), 100) for case in cases]
    cases += [(f"{n} bodies", bodies_vector_field, BODIES, bodies(n), 1e-3, 2, 2) for n in many]
    case = orbits_vector_field, ORBITS, orbits(128), 2e-2, 1_000, 1_000
    cases += [("128 orbits", *case), ("128 orbits, Dopri8", *case, dfx.Dopri8())]
    rows = []
    for case in cases:
        if options.only in case[0]:
            rows.append(measure(*case))
            measuring.print_row(rows[-1])
    measuring.write(options, measuring.machine(), rows=rows)
    return rows


if __name__ == "__main__":
    main()
