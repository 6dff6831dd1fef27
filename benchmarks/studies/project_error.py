"""What projecting the error estimate saves in steps, and costs in accuracy.

For each system and tolerance: steps and final state error of `ManifoldProjection(Tsit5(), ...)`
under a `PIDController`, without and with `project_error=True`. `--smoke` for one system.
"""

import sys

import diffrax as dfx
import equinox as eqx
import jax
import numpy as np

import diffrax_conserve as dfc

jax.config.update("jax_enable_x64", True)


@eqx.filter_jit
def solve(system, tolerance, project_error):
    solver = dfc.ManifoldProjection(dfx.Tsit5(), system.manifold, project_error=project_error)
    return dfx.diffeqsolve(
        dfx.ODETerm(system.vector_field),
        solver,
        0.0,
        system.t1,
        None,
        system.y0,
        system.args,
        stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
        max_steps=None,
    )


def main(smoke=False):
    print(
        f"{'system':22}{'tolerance':>10}{'steps':>8}{'projected':>11}{'error':>11}{'projected':>11}"
    )
    for name in dfc.systems.names()[: 1 if smoke else None]:
        system = dfc.systems.get(name)
        exact = jax.tree.map(lambda y: y[-1], system.reference(np.array([0.0, system.t1])))
        for tolerance in (1e-5, 1e-8):
            sols = [solve(system, tolerance, project_error) for project_error in (False, True)]
            steps = [int(sol.stats["num_steps"]) for sol in sols]
            errors = [
                np.sqrt(
                    sum(
                        np.sum((np.asarray(a)[-1] - np.asarray(b)) ** 2)
                        for a, b in zip(
                            jax.tree.leaves(sol.ys), jax.tree.leaves(exact), strict=True
                        )
                    )
                )
                for sol in sols
            ]
            print(
                f"{name:22}{tolerance:10.0e}{steps[0]:8d}{steps[1]:11d}"
                f"{errors[0]:11.1e}{errors[1]:11.1e}"
            )


if __name__ == "__main__":
    main("--smoke" in sys.argv)
