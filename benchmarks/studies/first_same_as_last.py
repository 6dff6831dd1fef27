"""Does a projected first-same-as-last solver need a fresh first stage?

Prints the largest state error at the final time for the plain solver, the projected one (which
reuses the last stage, evaluated at the candidate), and the projected one with the first stage
evaluated again at the projected state. Run: `python benchmarks/studies/first_same_as_last.py`,
with `--smoke` for one row.
"""

import sys
from itertools import islice
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp

import diffrax_conserve as dfc

PROBLEMS = {
    "kepler": 20.0,
    "rigid-body": 20.0,
    "point-vortices": 20.0,
    "henon-heiles": 50.0,
    "outer-solar-system": 20_000.0,
}


class Refreshed(dfx.AbstractWrappedSolver[Any]):
    """Evaluates the first stage of each step, as after a jump."""

    solver: dfx.AbstractSolver

    term_structure = property(lambda self: self.solver.term_structure)
    interpolation_cls = property(lambda self: self.solver.interpolation_cls)
    scan_kind = property(lambda self: self.solver.scan_kind)

    def order(self, terms):
        return self.solver.order(terms)

    def error_order(self, terms):
        return self.solver.error_order(terms)

    def init(self, terms, t0, t1, y0, args):
        return self.solver.init(terms, t0, t1, y0, args)

    def func(self, terms, t0, y0, args):
        return self.solver.func(terms, t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        del made_jump
        return self.solver.step(terms, t0, t1, y0, args, solver_state, made_jump=True)


def error(system, solver, t1, tolerance, reference):
    sol = dfx.diffeqsolve(
        dfx.ODETerm(system.vector_field),
        solver,
        0.0,
        t1,
        None,
        system.y0,
        stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
        max_steps=100_000,
    )
    pairs = zip(jax.tree.leaves(sol.ys), jax.tree.leaves(reference), strict=True)
    return max(float(jnp.max(jnp.abs(y[-1] - r[-1]))) for y, r in pairs)


def main(smoke=False):
    jax.config.update("jax_enable_x64", True)
    print(f"{'system':20}{'solver':8}{'tolerance':>10}{'plain':>10}{'reused':>10}{'fresh':>10}")
    for name, t1 in islice(PROBLEMS.items(), 1 if smoke else None):
        system = dfc.systems.get(name)
        reference = system.reference(jnp.linspace(0, t1, 5))
        for solver in (dfx.Tsit5(),) if smoke else (dfx.Tsit5(), dfx.Dopri5(), dfx.Bosh3()):
            solvers = (
                solver,
                dfc.ManifoldProjection(solver, system.manifold),
                dfc.ManifoldProjection(Refreshed(solver), system.manifold),
            )
            for tolerance in (1e-5,) if smoke else (1e-5, 1e-8):
                errors = [error(system, s, t1, tolerance, reference) for s in solvers]
                row = "".join(f"{e:10.2e}" for e in errors)
                print(f"{name:20}{type(solver).__name__:8}{tolerance:10.0e}{row}", flush=True)


if __name__ == "__main__":
    main("--smoke" in sys.argv)
