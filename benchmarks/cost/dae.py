"""Differential-algebraic equations, compared with IDA of SUNDIALS: error, steps, time.

1. Index 1 by `DAE`: Robertson's reactions to t = 1e11, a rectifier with a diode, and a
   power system whose network changes twice. The references are IDA at a tolerance of 1e-12, and for
   the power system the equations with the voltages eliminated.
2. Index 3 by `Constraint` and `tangent`: a pendulum, whose reference is an elliptic function, and a
   four-bar linkage, whose reference is its equation in one angle. IDA solves the equations with the
   constraints differentiated twice, because it is made for index 1.
3. Pendulum and linkage over 100,000 steps: the largest residuals and the error of the energy.

IDA calls functions in Python, so its times are those of Python. Writes `results/dae.json`;
`--table` prints the table of the page from it.
"""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import measuring
import numpy as np
import optimistix as optx

import diffrax_conserve as dfc

try:
    from sksundae.ida import IDA
except ImportError:
    IDA = None

CHORD = dict(root_finder=optx.Chord(rtol=1e-9, atol=1e-17))


# ---- IDA ----


def ida(residual, jacobian, y, slope, times, algebraic, rtol, atol):
    """States at the times, and the number of steps; `None` if it failed."""
    solver = IDA(
        residual,
        jacfn=jacobian,
        rtol=rtol,
        atol=atol,
        algebraic_idx=algebraic,
        max_num_steps=10**6,
        first_step=1e-8,
    )
    return solver.solve(np.asarray(times), np.asarray(y), np.asarray(slope))


def ida_of(field, algebraic_rows, size):
    """Residual and Jacobian of `y' = field(t, y)`, whose last rows are equations `0 = field`."""
    mass = np.ones(size)
    mass[algebraic_rows] = 0
    value = jax.jit(field)
    slopes = jax.jit(jax.jacfwd(field, argnums=1))

    def residual(t, y, yp, res):
        res[:] = np.asarray(value(t, y)) - mass * yp

    def jacobian(t, y, yp, res, cj, JJ):
        JJ[:] = np.asarray(slopes(t, y)) - cj * np.diag(mass)

    return residual, jacobian, mass


def by_ida(field, y, times, algebraic, rtol, atol):
    """In phases between the given lists of times; `field(k)` is that of phase `k`, and `y(k, last)`
    its consistent start."""
    states, last, steps, seconds = [], None, 0, 0.0
    for k, ts in enumerate(times):
        start = np.asarray(y(k, last))
        residual, jacobian, mass = ida_of(field(k), algebraic, start.size)
        slope = mass * np.asarray(field(k)(ts[0], start))
        jacobian(ts[0], start, slope, slope, 1.0, np.zeros((start.size, start.size)))  # compiles
        done = measuring.timed(
            lambda r=residual, j=jacobian, s=start, p=slope, ts=ts: ida(
                r, j, s, p, ts, algebraic, rtol, atol
            )
        )
        solution = done.answer
        if not solution.success:
            return None
        # Of two times IDA returns all steps between them.
        states.append(np.asarray(solution.y)[1 if len(ts) > 2 else -1 :])
        last, steps, seconds = states[-1][-1], steps + solution.nfev, seconds + done.seconds
    return np.concatenate(states), steps, seconds


# ---- Index 1 ----


def robertson(t, x, z, args):
    a, b = x
    c = z
    return jnp.stack([-0.04 * a + 1e4 * b * c, 0.04 * a - 1e4 * b * c - 3e7 * b**2])


ROBERTSON = dfc.DAE(robertson, algebraic=lambda t, x, z, args: jnp.sum(x) + z - 1)


def diode(v):
    return 1e-9 * jnp.expm1(v / 0.025)


def rectifier(t, x, z, args):
    """A condenser of 10 µF, charged through the diode, discharged through 10 kΩ; `t` in ms."""
    return 1e-3 * (diode(z) - x / 1e4) / 1e-5


# The source of 5 V at 50 Hz has a resistance of 100 Ω: `5 sin = x + z + 100 i(z)`.
RECTIFIER = dfc.DAE(
    rectifier,
    algebraic=lambda t, x, z, args: 5 * jnp.sin(0.1 * jnp.pi * t) - x - z - 100 * diode(z),
)

EMF, REACTANCE = np.array([1.05, 1.1]), np.array([0.2, 0.3])
INERTIA, INPUT, DAMPING = np.array([0.05, 0.03]), np.array([0.8, 0.6]), 0.02
LINES = [(0, 2, 0.3), (1, 2, 0.4), (0, 1, 0.5)]


def network(lines, fault=0.0):
    """Admittances of two machines and a load, which a line joins to a rigid bus."""
    matrix = np.diag([1 / 0.2j, 1 / 0.3j + fault, 1 / 0.25j + 0.9 - 0.3j])
    for a, b, reactance in lines:
        matrix[np.ix_([a, b], [a, b])] += np.array([[1, -1], [-1, 1]]) / (1j * reactance)
    return matrix


NETWORKS = [network(LINES), network(LINES, -50j), network(LINES[:2])]
PHASES = [[0.0, 0.1], [0.1, 0.25], [0.25, 3.0]]


def machines(t, x, v, matrix):
    angle, speed = x[:2], x[2:]
    emf = EMF * jnp.exp(1j * angle)
    power = jnp.real(emf * jnp.conj((emf - v[:2]) / (1j * REACTANCE)))
    return jnp.concatenate([speed, (INPUT - power - DAMPING * speed) / INERTIA])


def currents(angle):
    return jnp.append(EMF * jnp.exp(1j * angle) / (1j * REACTANCE), 1 / 0.25j)


def balance(t, x, z, matrix):
    off = matrix @ jax.lax.complex(z[:3], z[3:]) - currents(x[:2])
    return jnp.concatenate([off.real, off.imag])


POWER = dfc.DAE(
    lambda t, x, z, args: machines(t, x, jax.lax.complex(z[:3], z[3:]), args), algebraic=balance
)
REDUCED = lambda t, x, args: machines(t, x, jnp.linalg.solve(args, currents(x[:2])), args)  # noqa: E731


@eqx.filter_jit
def phase(term, solver, y, times, args, controller, dt0):
    """The states at all times but the first, and the steps."""
    solution = dfx.diffeqsolve(
        term,
        solver,
        times[0],
        times[-1],
        dt0,
        y,
        args,
        saveat=dfx.SaveAt(ts=times[1:]),
        stepsize_controller=dfx.ClipStepSizeController(controller, step_ts=times),
        max_steps=10**6,
    )
    return solution.ys, solution.stats["num_steps"]


def ours(term, solver, start, times, args, controller, dt0=None):
    """The states of all phases, the steps and the seconds."""

    def run():
        y, found, steps = None, [], 0
        for ts, a in zip(times, args, strict=True):
            y = start(y, ts[0], a)
            ys, count = phase(term, solver, y, jnp.asarray(ts), a, controller, dt0)
            found.append(ys)
            steps, y = steps + count, jax.tree.map(lambda y: y[-1], ys)
        return found, steps

    run()
    done = measuring.take_turns({"": run}, rounds=3)[""]
    found, steps = done.answer
    columns = [_columns(ys) for ys in found]
    return np.concatenate(columns), int(steps), done.seconds


def _columns(ys):
    """The numbers of the states, a row for each time."""
    return np.concatenate([np.reshape(y, (len(y), -1)) for y in jax.tree.leaves(ys)], axis=1)


def dae_field(dae, n, args):
    def field(t, y):
        x, z = y[:n], y[n:]
        x, z = (x[0] if n == 1 else x), (z[0] if z.size == 1 else z)
        return jnp.concatenate(
            [jnp.atleast_1d(dae.f(t, x, z, args)), jnp.atleast_1d(dae.algebraic(t, x, z, args))]
        )

    return field


class Case(eqx.Module):
    """An index-1 problem."""

    dae: dfc.DAE
    solver: dfx.AbstractSolver
    x: jax.Array
    z: jax.Array
    times: list
    args: list
    rtol: float
    atol: float
    relative: bool = False
    reduced: object = None

    def start(self, y, t, args):
        x, z = (self.x, self.z) if y is None else y
        return self.dae.consistent(x, z, t=t, args=args)

    def judged(self):
        norm = dict(norm=lambda e: optx.rms_norm(e[0]))
        controller = dfx.PIDController(rtol=self.rtol, atol=self.atol, **norm)
        found = ours(
            self.dae.term,
            self.dae.wrap(self.solver),
            self.start,
            self.times,
            self.args,
            controller,
            1e-6,
        )
        n, z = self.x.size, found[0][:, self.x.size :]
        algebraic = [*range(n, n + self.z.size)]
        field = lambda k: dae_field(self.dae, n, self.args[k])  # noqa: E731

        def consistent(k, last):
            y = None
            if last is not None:
                y = last[:n].reshape(self.x.shape), jnp.asarray(last[n:].reshape(self.z.shape))
            y = self.start(y, self.times[k][0], self.args[k])
            return np.concatenate([np.ravel(part) for part in y])

        by = lambda r, a: by_ida(field, consistent, self.times, algebraic, r, a)  # noqa: E731
        if self.reduced is not None:
            exact, *_ = ours(
                dfx.ODETerm(self.reduced),
                dfx.Dopri8(),
                lambda y, t, args: self.x if y is None else y,
                self.times,
                self.args,
                dfx.PIDController(rtol=1e-13, atol=1e-13),
                1e-6,
            )
        else:
            exact = by(1e-12, self.atol)[0]
        del z

        def error(states):
            states, true = (np.asarray(y)[:, : exact.shape[1]] for y in (states, exact))
            return float(np.max(np.abs(states - true) / (np.abs(true) if self.relative else 1)))

        def residual(states):
            """The largest, relative to its terms, at the ends of the phases."""
            last, worst = 0, 0.0
            for ts, a in zip(self.times, self.args, strict=True):
                rows = states[last : last + len(ts) - 1]
                last += len(ts) - 1
                for t, row in zip(ts[1:], rows, strict=True):
                    g = lambda y, t=t, a=a: dae_field(self.dae, n, a)(t, y)[n:]  # noqa: E731
                    row = jnp.asarray(row)
                    scale = jnp.abs(jax.jacfwd(g)(row)) @ jnp.abs(row)
                    worst = max(worst, float(jnp.max(jnp.abs(g(row)) / (scale + 1e-300))))
            return worst

        rows = {"ours": found, "IDA": by(self.rtol, self.atol)}
        return {
            name: dict(error=error(row[0]), steps=row[1], seconds=row[2], residual=residual(row[0]))
            for name, row in rows.items()
        }


def index_1():
    decades = np.array([0.0, *4 * np.logspace(-1, 10, 12), 1e11])
    return {
        "Robertson to t = 1e11": Case(
            ROBERTSON,
            dfc.Radau(),
            jnp.array([1.0, 0.0]),
            jnp.array(0.0),
            [decades],
            [None],
            1e-8,
            1e-16,
            relative=True,
        ),
        "rectifier, 5 periods": Case(
            RECTIFIER,
            dfc.Radau(),
            jnp.array(0.0),
            jnp.array(0.0),
            [np.linspace(0, 100, 41)],
            [None],
            1e-7,
            1e-10,
        ),
        "power system with a fault": Case(
            POWER,
            dfx.Tsit5(),
            jnp.array([0.57, 0.58, 0.0, 0.0]),
            jnp.array([1.0, 1, 1, 0, 0, 0]),
            PHASES,
            [jnp.asarray(matrix) for matrix in NETWORKS],
            1e-8,
            1e-8,
            reduced=REDUCED,
        ),
    }


# ---- Index 3 ----


def falling(t, y, args):
    return y[1], jnp.broadcast_to(jnp.array([0.0, -1.0]), y[1].shape)


def rod(q):
    return jnp.sum(q**2, keepdims=True) - 1


def four_bars(q):
    """Bars of lengths 1, 2, 2 between the fixed points (0, 0) and (2.5, 0)."""
    p, r = q
    bars = jnp.stack([p, r - p, r - jnp.array([2.5, 0.0])])
    return jnp.sum(bars**2, axis=1) - jnp.array([1.0, 4.0, 4.0])


class Mechanism(eqx.Module):
    """Unit masses that fall, held by constraints on their positions."""

    positions: object = eqx.field(static=True)
    q: jax.Array
    v: jax.Array

    @property
    def lengths(self):
        return dfc.Constraint(lambda t, y, args: self.positions(y[0]))

    @property
    def manifold(self):
        energy = lambda t, y, args: jnp.sum(y[1] ** 2) / 2 + jnp.sum(y[0][..., 1])  # noqa: E731
        velocities = self.lengths.derivative(falling)
        energy = dfc.FirstIntegral(energy)
        return dict(lengths=self.lengths, velocities=velocities, energy=energy)

    @property
    def field(self):
        return dfc.tangent(falling, self.manifold["velocities"], metric=(jnp.inf, 1.0))

    def solver(self, inner):
        return dfc.ManifoldProjection(
            inner, self.manifold, projection=dfc.SimplifiedNewton(atol=1e-15)
        )

    def judged(self, times, exact):
        y0 = (self.q, self.v)
        found = ours(
            dfx.ODETerm(self.field),
            self.solver(dfx.Dopri8()),
            lambda y, t, args: y0,
            [times],
            [None],
            dfx.PIDController(rtol=1e-8, atol=1e-8),
        )
        n, m = self.q.size, int(np.size(self.positions(self.q)))
        start = np.concatenate([self.q.ravel(), self.v.ravel(), np.zeros(m)])

        def field(t, y):
            """With the constraints differentiated twice, which determine the multipliers."""
            q, v, force = (
                y[:n].reshape(self.q.shape),
                y[n : 2 * n].reshape(self.q.shape),
                y[2 * n :],
            )
            _, vjp = jax.vjp(self.positions, q)
            slope = falling(t, (q, v), None)[1] + vjp(force)[0]
            first = lambda q, v: jax.jvp(self.positions, (q,), (v,))[1]  # noqa: E731
            second = jax.jvp(first, (q, v), (v, slope))[1]
            return jnp.concatenate([v.ravel(), slope.ravel(), jnp.ravel(second)])

        multipliers = self.field.multipliers(0.0, y0)
        start[2 * n :] = np.ravel(multipliers)
        algebraic = [*range(2 * n, 2 * n + m)]
        other = by_ida(lambda k: field, lambda k, last: start, [times], algebraic, 1e-8, 1e-8)
        rows = {"ours": found, "IDA": other}

        def row(states, steps, seconds):
            q, v = states[:, :n], states[:, n : 2 * n]
            off = jax.vmap(lambda q: self.positions(q.reshape(self.q.shape)))(jnp.asarray(q))
            error = float(np.max(np.abs(np.concatenate([q, v], 1) - exact)))
            residual = float(jnp.max(jnp.abs(off)))
            return dict(error=error, steps=steps, seconds=seconds, residual=residual)

        return {name: row(*x) for name, x in rows.items()}

    def long(self, steps):
        """Residuals and energy over many steps at a tolerance of 1e-8, in units of roundoff."""

        @eqx.filter_jit
        def run(y0):
            solution = dfx.diffeqsolve(
                dfx.ODETerm(self.field),
                self.solver(dfx.Tsit5()),
                0.0,
                1e9,
                None,
                y0,
                saveat=dfx.SaveAt(steps=True),
                stepsize_controller=dfx.PIDController(rtol=1e-8, atol=1e-8),
                max_steps=steps,
                throw=False,
            )
            values = jax.vmap(lambda y: {k: e.fn(0, y, None) for k, e in self.manifold.items()})
            done = jnp.isfinite(solution.ts)
            off = values(solution.ys)
            off["energy"] = off["energy"] - self.manifold["energy"].fn(0, y0, None)
            worst = {
                k: jnp.max(jnp.where(done.reshape(-1, *[1] * (x.ndim - 1)), jnp.abs(x), 0))
                for k, x in off.items()
            }

            def terms(y):
                """The sizes of what is added up, `sum |y_k dg/dy_k|`."""
                found = {}
                for k, entry in self.manifold.items():
                    slopes = jax.tree.leaves(jax.jacfwd(lambda y, e=entry: e.fn(0, y, None))(y))
                    parts = zip(slopes, y, strict=True)
                    sizes = [
                        jnp.abs(s * x).reshape(*s.shape[: s.ndim - x.ndim], -1) for s, x in parts
                    ]
                    found[k] = jnp.max(sum(jnp.sum(size, axis=-1) for size in sizes))
                return found

            size = jax.tree.map(
                lambda x: jnp.max(jnp.where(done, x, 0)), jax.vmap(terms)(solution.ys)
            )
            return worst, size, jnp.max(jnp.where(done, solution.ts, 0)), jnp.sum(done)

        worst, size, t, count = run((self.q, self.v))
        units = {k: float(x) / measuring.EPS for k, x in worst.items()}
        relative = {k: x / float(size[k]) for k, x in units.items()}
        return dict(in_eps=units, of_terms=relative, t=float(t), accepted=int(count))


PENDULUM = Mechanism(rod, jnp.array([1.0, 0.0]), jnp.zeros(2))


def linkage():
    """From the crank upright."""
    start = jnp.array([[0.0, 1.0], [2.0, 1.9]])
    bars = dfc.Constraint(lambda t, q, args: four_bars(q))
    frozen = dfc.Newton(metric=jnp.array([[jnp.inf, jnp.inf], [1.0, 1.0]]))
    q, info = dfc.project(bars, start, projection=frozen)
    assert info.ok
    return Mechanism(four_bars, q, jnp.zeros((2, 2)))


def pendulum_reference(times):
    """By the catalogue, an elliptic function, which starts elsewhere: so a solve in the angle."""

    def field(t, y, args):
        return jnp.stack([y[1], -jnp.sin(y[0])])

    y = reference(field, jnp.array([jnp.pi / 2, 0.0]), times)
    a, w = y.T
    q = np.stack([np.sin(a), -np.cos(a)], 1)
    return np.concatenate([q, w[:, None] * np.stack([np.cos(a), np.sin(a)], 1)], 1)


def reference(field, y0, times):
    found, *_ = ours(
        dfx.ODETerm(field),
        dfx.Dopri8(),
        lambda y, t, args: y0,
        [times],
        [None],
        dfx.PIDController(rtol=1e-13, atol=1e-13),
    )
    return found


def linkage_reference(mechanism, times):
    """Lagrange's equation in the angle of the crank: `M a'' + M' a'^2 / 2 = -V'`."""

    def place(a):
        """The joint by the intersection of two circles, on the side of the start."""
        p = jnp.stack([jnp.cos(a), jnp.sin(a)])
        d = jnp.array([2.5, 0.0]) - p
        size = jnp.sum(d**2)
        height = jnp.sqrt(4.0 / size - 1 / 4)
        return jnp.stack([p, p + d / 2 + height * jnp.stack([-d[1], d[0]])])

    velocity = jax.jacfwd(place)
    mass = lambda a: jnp.sum(velocity(a) ** 2)  # noqa: E731
    potential = lambda a: jnp.sum(place(a)[:, 1])  # noqa: E731

    def field(t, y, args):
        a, w = y
        return jnp.stack([w, -(jax.grad(mass)(a) * w**2 / 2 + jax.grad(potential)(a)) / mass(a)])

    start = jnp.pi / 2
    assert float(jnp.max(jnp.abs(place(start) - mechanism.q))) < 1e-12
    a, w = reference(field, jnp.array([start, 0.0]), times).T
    q = jax.vmap(place)(jnp.asarray(a)).reshape(len(a), 4)
    v = jax.vmap(velocity)(jnp.asarray(a)).reshape(len(a), 4) * w[:, None]
    return np.concatenate([q, v], 1)


# ---- The table ----


def table(results):
    lines = ["| problem | error | steps | ms | IDA: error | evaluations | ms |", "|---" * 7 + "|"]
    for name, row in results["problems"].items():
        cells = []
        for one in row["ours"], row["IDA"]:
            cells += [f"{one['error']:.0e}", str(one["steps"]), f"{1e3 * one['seconds']:.0f}"]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main(argv=None):
    parser = measuring.parser(__doc__, "dae")
    parser.add_argument("--table", action="store_true", help="print the table of the results")
    options = parser.parse_args(argv)
    if options.table:
        print(table(measuring.read("dae")))
        return None
    if IDA is None:
        print("scikit-sundae is not installed: nothing to compare with")
        return None
    about = measuring.machine("scikit-sundae", "scipy")
    measuring.print_machine(about)
    found = {}
    cases = list(index_1().items())
    for name, case in cases[-1:] if options.smoke else cases:
        if options.only in name:
            found[name] = case.judged()
            print(name, found[name], flush=True)
    bars, times = linkage(), np.linspace(0, 2 if options.smoke else 20, 21)
    mechanisms = {
        "pendulum": (PENDULUM, pendulum_reference),
        "four-bar linkage": (bars, lambda times: linkage_reference(bars, times)),
    }
    long = {}
    for name, (mechanism, exact) in mechanisms.items():
        if options.only in name:
            found[name] = mechanism.judged(times, exact(times))
            long[name] = mechanism.long(1000 if options.smoke else 100_000)
            print(name, found[name], long[name], flush=True)
    measuring.write(options, about, problems=found, long=long)
    print(table(dict(problems=found)))
    return dict(problems=found, long=long)


if __name__ == "__main__":
    main()
