"""Differential-algebraic equations by `DAE` and `Radau`, beside IDA of SUNDIALS.

Each problem is given as it stands in its source, of index 1 to 3. IDA solves the equations of index
1 that `Radau` solves, because it is made for index 1; it calls functions in Python, so its
evaluations and steps can be compared and its times cannot.

- Robertson's reactions to t = 1e11, the chemical Akzo Nobel problem, the transistor amplifier and
  the car axis (index 3) of the test set of initial value problems (Mazzia and Magherini, Bari
  2008), with its published values. They are on pages of SciMLBenchmarks too (`DAE/ROBERDAE`,
  `DAE/ChemicalAkzoNobel`, `DAE/TransistorAmplifier`, `DAE/caraxis`).
- A pendulum in Cartesian coordinates (index 3); the reference is the equation in its angle.
- A power system whose network changes twice; the reference has its voltages eliminated.

Errors are the largest of a component that the source judges, relative for the reactions and
absolute for the others. Constraints are all that `DAE` finds, the hidden ones too; their error is
the largest residual at the end.

Writes `results/dae.json`, from which `report.py` makes the table and the figure of the page.
"""

import functools as ft
import itertools

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import measuring
import numpy as np

import diffrax_conserve as dfc

try:
    from sksundae.ida import IDA
except ImportError:
    IDA = None

TOLERANCES = [1e-4, 1e-6, 1e-8, 1e-10]
MOST = 200_000  # evaluations of IDA


# ---- The problems ----


class Problem(eqx.Module):
    """A differential-algebraic equation between times at which it may jump, with `args` between
    them, and how to judge the state at the end."""

    dae: dfc.DAE
    guess: object
    times: list
    exact: object = eqx.field(static=True)
    args: tuple = (None,)
    atol: float = 1.0  # over the relative tolerance
    relative: bool = False

    def absolute(self, rtol):
        """The absolute tolerance, above the roundoff of a total that is one."""
        return max(rtol * self.atol, 1e-14)

    def start(self, y, t, args):
        return self.dae.consistent(self.guess if y is None else y, t=t, args=args)


def robertson(t, x, z, args):
    a, b = x
    return jnp.stack([-0.04 * a + 1e4 * b * z, 0.04 * a - 1e4 * b * z - 3e7 * b**2])


SHARES = [0.2083340149701255e-7, 0.8333360770334713e-13]


def amplifier(t, u, args):
    one, two = (1e-6 * jnp.expm1((u[k] - u[k + 1]) / 0.026) for k in (1, 4))
    return jnp.stack([
        (u[0] - 0.1 * jnp.sin(200 * jnp.pi * t)) / 1e3,
        (2 * u[1] - 6) / 9e3 + 0.01 * one, u[2] / 9e3 - one, (u[3] - 6) / 9e3 + 0.99 * one,
        (2 * u[4] - 6) / 9e3 + 0.01 * two, u[5] / 9e3 - two, (u[6] - 6) / 9e3 + 0.99 * two,
        u[7] / 9e3,
    ])  # fmt: skip


CAPACITY = np.zeros((8, 8))
for i, j, c in ((0, 1, 1e-6), (3, 4, 3e-6), (6, 7, 5e-6)):
    CAPACITY[[i, j], [i, j]], CAPACITY[[i, j], [j, i]] = -c, c
CAPACITY[2, 2], CAPACITY[5, 5] = -2e-6, -4e-6
VOLTS = [-0.5562145012262709e-2, 3.006522471903042, 2.849958788608128, 2.926422536206241,
         2.704617865010554, 2.761837778393145, 4.770927631616772, 1.236995868091548]  # fmt: skip


def akzo_nobel(t, x, z, args):
    """Five concentrations; `z` is the sixth, in equilibrium."""
    a, b, c, d, e = x
    root = jnp.sqrt(b)
    first, second, third = 18.7 * a**4 * root, 0.58 * c * d, 0.09 * a * d**2
    back, fourth, inflow = 0.58 / 34.4 * a * e, 0.42 * z**2 * root, 3.3 * (0.9 / 737 - b)
    return jnp.stack([
        -2 * first + second - back - third, -first / 2 - third - fourth / 2 + inflow,
        first - second + back, -second + back - 2 * third, second - back + fourth,
    ])  # fmt: skip


MOLES = [0.1150794920661702, 0.1203831471567715e-2, 0.1611562887407974, 0.3656156421249283e-3,
         0.1708010885264404e-1]  # fmt: skip


def car_axis(t, y, args):
    """Two ends of an axis on springs over a bumpy road, and the forces of two constraints."""
    left, right, rates, (one, two) = y[:2], y[2:4], y[4:8], y[8:]
    height = 0.1 * jnp.sin(10 * t)
    wheel = jnp.stack([jnp.sqrt(1 - height**2), height])
    spring = lambda way: (0.5 / jnp.sqrt(jnp.sum(way**2)) - 1) * way  # noqa: E731
    axis, weight = left - right, jnp.array([0.0, 5e-4])
    return jnp.concatenate([
        rates, spring(left) + one * wheel + 2 * two * axis - weight,
        spring(right - wheel) - 2 * two * axis - weight,
        jnp.stack([left @ wheel, axis @ axis - 1]),
    ])  # fmt: skip


PLACES = [0.4934557842755629e-1, 0.4969894602303324, 1.041742524885400, 0.3739110272652214,
          -0.7705836840321485e-1, 0.7446866596327776e-2, 0.1755681574942899e-1,
          0.7703410437794031, -0.4736886750784630e-2, -0.1104680411345730e-2]  # fmt: skip


def pendulum(t, y, dy, args):
    (q, v, force), (dq, dv, _) = y, dy
    return dq - v, dv + force * q + jnp.array([0.0, 1.0]), jnp.sum(q**2) - 1


def swing(end):
    """Position and velocity by the angle, from rest at the side."""
    field = lambda t, y, args: jnp.stack([y[1], -jnp.sin(y[0])])  # noqa: E731
    angle, rate = tight(field, jnp.array([jnp.pi / 2, 0.0]), [end], (None,))
    return np.array([np.sin(angle), -np.cos(angle), rate * np.cos(angle), rate * np.sin(angle)])


EMF, REACTANCE = np.array([1.05, 1.1]), np.array([0.2, 0.3])
INERTIA, INPUT, DAMPING = np.array([0.05, 0.03]), np.array([0.8, 0.6]), 0.02
LINES = [(0, 2, 0.3), (1, 2, 0.4), (0, 1, 0.5)]


def network(lines, fault=0.0):
    """Admittances of two machines and a load, which a line joins to a rigid bus."""
    matrix = np.diag([1 / 0.2j, 1 / 0.3j + fault, 1 / 0.25j + 0.9 - 0.3j])
    for a, b, reactance in lines:
        matrix[np.ix_([a, b], [a, b])] += np.array([[1, -1], [-1, 1]]) / (1j * reactance)
    return jnp.asarray(matrix)


NETWORKS = network(LINES), network(LINES, -50j), network(LINES[:2])


def machines(t, x, z, matrix):
    """Angles and speeds, with the voltages as pairs of real numbers."""
    angle, speed = x[:2], x[2:]
    emf, v = EMF * jnp.exp(1j * angle), jax.lax.complex(z[:3], z[3:])
    power = jnp.real(emf * jnp.conj((emf - v[:2]) / (1j * REACTANCE)))
    return jnp.concatenate([speed, (INPUT - power - DAMPING * speed) / INERTIA])


def injected(angle):
    return jnp.append(EMF * jnp.exp(1j * angle) / (1j * REACTANCE), 1 / 0.25j)


def balance(t, x, z, matrix):
    off = matrix @ jax.lax.complex(z[:3], z[3:]) - injected(x[:2])
    return jnp.concatenate([off.real, off.imag])


def eliminated(t, x, matrix):
    v = jnp.linalg.solve(matrix, injected(x[:2]))
    return machines(t, x, jnp.concatenate([v.real, v.imag]), matrix)


def tight(field, y0, times, args):
    """The state at the end of an ordinary differential equation, at a tolerance of 1e-13."""
    steps, t0 = dfx.PIDController(rtol=1e-13, atol=1e-13), 0.0
    for t1, a in zip(times, args, strict=True):
        solution = dfx.diffeqsolve(
            dfx.ODETerm(field), dfx.Dopri8(), t0, t1, 1e-4, y0, a, stepsize_controller=steps,
            max_steps=100_000,
        )  # fmt: skip
        y0, t0 = solution.ys[-1], t1
    return np.asarray(y0)


MACHINES, SWITCHED = jnp.array([0.57, 0.58, 0.0, 0.0]), [0.1, 0.25, 3.0]
TOTAL = dfc.DAE(robertson, algebraic=lambda t, x, z, args: jnp.sum(x) + z - 1)
PAIR = lambda x, z: (jnp.array(x), jnp.array(z))  # noqa: E731
PROBLEMS = {
    "Robertson's reactions": Problem(
        TOTAL, PAIR([1.0, 0.0], 0.0), [1e11], lambda: SHARES, atol=1e-6, relative=True
    ),
    "Akzo Nobel": Problem(
        dfc.DAE(akzo_nobel, algebraic=lambda t, x, z, args: 115.83 * x[0] * x[3] - z),
        PAIR([0.444, 0.00123, 0.0, 0.007, 0.0], 0.36),
        [180.0],
        lambda: MOLES,
        relative=True,
    ),
    "transistor amplifier": Problem(
        dfc.DAE(amplifier, mass=CAPACITY),
        jnp.array([0.0, 3, 3, 6, 3, 3, 6, 0]),
        [0.2],
        lambda: VOLTS,
    ),
    "power system with a fault": Problem(
        dfc.DAE(machines, algebraic=balance),
        (MACHINES, jnp.array([1.0, 1, 1, 0, 0, 0])),
        SWITCHED,
        lambda: tight(eliminated, MACHINES, SWITCHED, NETWORKS),
        NETWORKS,
    ),
    "pendulum, index 3": Problem(
        dfc.DAE(residual=pendulum),
        (jnp.array([1.0, 0.0]), jnp.zeros(2), jnp.array(0.0)),
        [20.0],
        lambda: swing(20.0),
    ),
    "car axis, index 3": Problem(
        dfc.DAE(car_axis, mass=np.diag([1.0] * 4 + [5e-4] * 4 + [0, 0])),
        jnp.array([0.0, 0.5, 1, 0.5, -0.5, 0, -0.5, 0, 0, 0]),
        [3.0],
        lambda: PLACES,
    ),
}


# ---- The solvers ----


@eqx.filter_jit
def phase(dae, y, t0, t1, args, rtol, atol):
    solution = dfx.diffeqsolve(
        dae.term, dae.wrap(dfc.Radau()), t0, t1, 1e-6, y, args, max_steps=10**6,
        stepsize_controller=dfx.PIDController(rtol=rtol, atol=atol),
    )  # fmt: skip
    return jax.tree.map(lambda y: y[-1], solution.ys), solution.stats["num_accepted_steps"]


def by_radau(problem, rtol):
    """The state at the end, the steps and the seconds."""

    def run():
        y, t0, steps = None, 0.0, 0
        for t1, args in zip(problem.times, problem.args, strict=True):
            y = problem.start(y, t0, args)
            y, more = phase(problem.dae, y, t0, t1, args, rtol, problem.absolute(rtol))
            steps, t0 = steps + more, t1
        return y, steps

    run()
    done = measuring.take_turns({"": run}, rounds=3)[""]
    return done.answer[0], int(done.answer[1]), done.seconds


def for_ida(dae, y, args):
    """The equations of index 1 in place, and their Jacobian, as IDA wants them."""
    _, rebuild = jax.flatten_util.ravel_pytree(y)
    equations = dae.wrap(dfc.Radau()).solver._equations
    value = jax.jit(lambda t, y, dy: equations(t, rebuild(y), rebuild(dy), args))
    slopes = jax.jit(jax.jacfwd(value, (1, 2)))

    count = itertools.count()

    def residual(t, y, dy, out):
        if next(count) > MOST:  # IDA goes on in steps of roundoff
            raise FloatingPointError
        out[:] = value(t, y, dy)

    def jacobian(t, y, dy, _, c, out):
        by_y, by_slope = slopes(t, y, dy)
        out[:] = np.asarray(by_y) + c * np.asarray(by_slope)

    return residual, jacobian, slopes


def by_ida(problem, rtol):
    """As `by_radau`, with evaluations in the place of steps; `None` if IDA fails."""
    y, t0, evaluations, seconds = None, 0.0, 0, 0.0
    for t1, args in zip(problem.times, problem.args, strict=True):
        y = problem.start(y, t0, args)
        given = t0, numbers(y), numbers(problem.dae.term.vf(t0, y, args))
        residual, jacobian, slopes = for_ida(problem.dae, y, args)
        # The functions compile before the clock runs.
        residual(*given, np.zeros(given[1].size))
        algebraic = np.flatnonzero(~np.any(np.asarray(slopes(*given)[1]), axis=0)).tolist()
        ida = IDA(
            residual,
            jacfn=jacobian,
            rtol=rtol,
            atol=problem.absolute(rtol),
            first_step=1e-8,
            algebraic_idx=algebraic or None,
            max_num_steps=MOST,
        )
        try:
            done = measuring.timed(ft.partial(ida.solve, np.array([t0, t1]), *given[1:]))
        except FloatingPointError:
            return None
        if not done.answer.success:
            return None
        _, rebuild = jax.flatten_util.ravel_pytree(y)
        y, t0 = rebuild(jnp.asarray(done.answer.y[-1])), t1
        evaluations, seconds = evaluations + int(done.answer.nfev), seconds + done.seconds
    return y, evaluations, seconds


def judged(problem, tolerances):
    exact = numbers(problem.exact())
    rows = []
    for rtol in tolerances:
        row = dict(rtol=rtol)
        for name, solve in (("ours", by_radau), ("ida", by_ida)):
            row[name] = found = solve(problem, rtol)
            if found is None:
                continue
            y, work, seconds = found
            size = np.abs(exact) if problem.relative else 1
            error = np.max(np.abs(numbers(y)[: exact.size] - exact) / size)
            off = max(problem.dae.report(y, t=problem.times[-1], args=problem.args[-1]).residuals)
            row[name] = dict(error=float(error), work=work, seconds=seconds, constraints=off)
        rows.append(row)
        print("  ", row, flush=True)
    return rows


def numbers(tree):
    return np.asarray(jax.flatten_util.ravel_pytree(tree)[0], float)


def main(argv=None):
    options = measuring.parser(__doc__, "dae").parse_args(argv)
    if IDA is None:
        print("scikit-sundae is not installed: nothing to compare with")
        return None
    about = measuring.machine("scikit-sundae", "scipy")
    measuring.print_machine(about)
    found, cases = {}, list(PROBLEMS.items())
    for name, problem in cases[4:5] if options.smoke else cases:
        if options.only in name:
            print(name)
            found[name] = judged(problem, TOLERANCES[:1] if options.smoke else TOLERANCES)
    measuring.write(options, about, problems=found)
    return dict(problems=found)


if __name__ == "__main__":
    main()
