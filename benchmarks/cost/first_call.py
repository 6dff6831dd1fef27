"""What the first call of a solve costs: the size of its program, and the time to compile it.

Primitives are those of the traced program, with those of all programs inside. Instructions and
fusions are those of the compiled one; XLA compiles each fusion to a kernel of its own. Seconds are
processor seconds of tracing, lowering and compilation; those of `consistent` contain the search for
the structure of the equations and the call itself. A quotient is over plain diffrax in the same
run: of the DAEs over Kvaerno5 on the pendulum as an ordinary differential equation, of RK4 on 64
rigid bodies and of the gradient of Tsit5 on an orbit with saved times over those not projected.
Leaves are the arrays of the solver state, each of which a gradient saves and restores.

Writes `results/first_call.json`.
"""

import functools as ft
import re
import time

import dae as problems
import diffrax as dfx
import jax
import jax.extend.core as jex
import jax.numpy as jnp
import measuring

import diffrax_conserve as dfc

GRAVITY = jnp.array(9.81)


def pendulum(t, y, dy, gravity):
    (q, v, force), (dq, dv, _) = y, dy
    return dq - v, dv + force * q + gravity * jnp.array([0.0, 1.0]), jnp.sum(q**2) - 1


def swing(t, y, gravity):
    """The same with the force eliminated."""
    q, v = y
    down = gravity * jnp.array([0.0, 1.0])
    return v, -(jnp.sum(v**2) - down @ q) / jnp.sum(q**2) * q - down


def solve(term, solver, y0, args, end=1.0):
    steps = dfx.PIDController(rtol=1e-6, atol=1e-6)
    return dfx.diffeqsolve(term, solver, 0.0, end, 1e-3, y0, args, stepsize_controller=steps).ys


def programs():
    """Functions and their arguments, and functions whose call is timed as it is."""
    side, rest, amplifier = jnp.array([1.0, 0.0]), jnp.zeros(2), problems.PROBLEMS
    amplifier = amplifier["transistor amplifier"]
    dae, mass = dfc.DAE(residual=pendulum), amplifier.dae
    guess = side, rest, jnp.array(0.0)
    plain = lambda y, g: solve(dfx.ODETerm(swing), dfx.Kvaerno5(), y, g)  # noqa: E731
    kept = lambda y, g: solve(dae.term, dae.wrap(dfc.Radau()), y, g)  # noqa: E731
    sound = lambda y, end: solve(mass.term, mass.wrap(dfc.Radau()), y, None, end)  # noqa: E731
    by_gravity = lambda fn: jax.grad(lambda y, g: jnp.sum(fn(y, g)[0]), 1)  # noqa: E731
    start = (side, rest), GRAVITY
    yield "Kvaerno5", plain, lambda: start
    yield "Kvaerno5, gradient", by_gravity(plain), lambda: start
    consistent = lambda: (dae.consistent(guess, args=GRAVITY), GRAVITY)  # noqa: E731
    yield "DAE pendulum", kept, consistent
    yield "DAE pendulum, gradient", by_gravity(kept), consistent
    begin = lambda: (mass.consistent(amplifier.guess), jnp.array(0.2))  # noqa: E731
    yield "transistor amplifier", sound, begin
    body, orbit = dfc.systems.RigidBody(), dfc.systems.Kepler()
    bodies = lambda: (measuring.initial_states(body, 64),)  # noqa: E731
    start = lambda: (orbit.y0, jnp.array(1.0))  # noqa: E731
    for name, solver in (("RK4", dfc.RK4()), ("projected RK4", kept_by(dfc.RK4(), body))):
        yield f"{name}, 64 rigid bodies", jax.vmap(ft.partial(turned, body, solver)), bodies
    for name, solver in (("Tsit5", dfx.Tsit5()), ("projected Tsit5", kept_by(dfx.Tsit5(), orbit))):
        yield f"{name}, gradient of an orbit", by_gravity(ft.partial(saved, orbit, solver)), start


def kept_by(solver, system):
    return dfc.ManifoldProjection(solver, system.manifold)


def turned(body, solver, y0):
    term, steps = dfx.ODETerm(body.vector_field), dict(adjoint=dfx.ForwardMode(), max_steps=None)
    return dfx.diffeqsolve(term, solver, 0.0, 1.0, 0.05, y0, **steps, throw=False).ys


def saved(orbit, solver, y0, strength):
    """The field is multiplied by `strength`: it only changes the clock."""
    term = dfx.ODETerm(
        lambda t, y, k: jax.tree.map(lambda x: k * x, orbit.vector_field(t, y, None))
    )
    options = dict(
        saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 1.0, 20)),
        stepsize_controller=dfx.PIDController(rtol=1e-8, atol=1e-8),
    )
    return dfx.diffeqsolve(term, solver, 0.0, 1.0, 0.01, y0, strength, **options).ys


def leaves(name):
    """The arrays of the state of a projected solver."""
    system = dfc.systems.RigidBody() if "RK4" in name else dfc.systems.Kepler()
    inner = dfc.RK4() if "RK4" in name else dfx.Tsit5()
    given = dfx.ODETerm(system.vector_field), 0.0, 1.0, system.y0, None
    return len(jax.tree.leaves(jax.eval_shape(lambda: kept_by(inner, system).init(*given))))


def primitives(jaxpr):
    """The number of equations, with those of all programs inside."""
    is_program = lambda x: isinstance(x, jex.ClosedJaxpr | jex.Jaxpr)  # noqa: E731
    params = [eqn.params for eqn in jaxpr.eqns]
    inside = filter(is_program, jax.tree.leaves(params, is_leaf=is_program))
    return len(jaxpr.eqns) + sum(primitives(getattr(x, "jaxpr", x)) for x in inside)


def judged(fn, given):
    begin = time.process_time()
    args = jax.block_until_ready(given())
    before = time.process_time() - begin
    traced = jax.jit(fn).trace(*args)
    compiled = traced.lower().compile()
    first = time.process_time() - begin - before
    text = compiled.as_text()
    compiled(*args)
    best = measuring.take_turns({"": lambda: compiled(*args)}, rounds=20)[""].seconds
    return dict(
        primitives=primitives(traced.jaxpr.jaxpr),
        instructions=len(re.findall(r"^\s+(?:ROOT )?%?[\w.-]+ = ", text, re.M)),
        fusions=len(re.findall(r" fusion\(", text)),
        first=first,
        consistent=before,
        milliseconds=1e3 * best,
    )


def main(argv=None):
    options = measuring.parser(__doc__, "first_call").parse_args(argv)
    about = measuring.machine()
    measuring.print_machine(about)
    found, plain = {}, {}
    for name, fn, given in programs():
        if options.only not in name or (options.smoke and "pendulum" in name):
            continue
        jax.clear_caches()  # each compiles what the others share with it
        row = found[name] = judged(fn, given)
        kind = name.split(", ", 1)[1:] if "RK4" in name or "orbit" in name else "gradient" in name
        kind = str(kind)
        row |= dict(leaves=leaves(name)) if "projected" in name else {}
        plain.setdefault(kind, row["first"])
        row["over_plain"] = row["first"] / plain[kind]
        print(f"{name}: " + ", ".join(f"{k} {v:.4g}" for k, v in row.items()), flush=True)
    measuring.write(options, about, programs=found)
    return found


if __name__ == "__main__":
    main()
