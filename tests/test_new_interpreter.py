"""What the package does in a new interpreter, without the settings of the tests.

One answers all questions, as it takes seconds to start and to compile.
"""

import json
import os
import subprocess
import sys

import diffrax as dfx
import jax
import jax.numpy as jnp

import diffrax_conserve as dfc

from .learned import LORENZ, flow_map, unchecked
from .test_imports import CONFINED

CODE = """
import json, sys
import diffrax, diffrax_conserve
modules, messages = list(sys.modules), len(diffrax.RESULTS._index_to_message)
from tests.test_new_interpreter import work_with_a_heavy_field
found = {"modules": modules, "flops": work_with_a_heavy_field()}
later = len(diffrax.RESULTS._index_to_message)
print(json.dumps(found | {"messages": [messages, later]}))
"""


def work_with_a_heavy_field():
    """The operations of a solve with projected fixed steps, and of one error estimate. An
    evaluation of this vector field takes millions of operations, all the rest thousands."""
    heavy = jnp.ones((200, 200))

    def field(t, y, args):
        return LORENZ.vector_field(t, y, args) + 0 * jnp.sum(jnp.tanh(heavy @ (heavy * y[0])))

    def flops(run):
        return jax.jit(run).lower(LORENZ.y0).compile().cost_analysis()["flops"]

    term, solver = dfx.ODETerm(field), unchecked(flow_map())
    projected = dfc.ManifoldProjection(solver, LORENZ.manifold)

    def estimate(y0):
        state = solver.init(term, 0.0, 0.25, y0, None)
        return solver.step(term, 0.0, 0.25, y0, None, state, False)[1]

    solve = lambda y0: dfx.diffeqsolve(term, projected, 0.0, 1.0, 0.25, y0, max_steps=8).ys  # noqa: E731
    return flops(solve), flops(estimate)


def test_optional_packages_messages_and_unused_error_estimates():
    # All passes over the program, unlike in the tests, but none over the machine code.
    flags = [flag for flag in os.environ["XLA_FLAGS"].split() if "disable_hlo_passes" not in flag]
    environment = {**os.environ, "XLA_FLAGS": " ".join(flags), "JAX_ENABLE_X64": "1"}
    done = subprocess.run(
        [sys.executable, "-c", CODE], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert "diffrax_conserve" in found["modules"]
    assert CONFINED.keys().isdisjoint(found["modules"])
    # The list is complete when the package is imported, and the same in this process.
    assert found["messages"] == 2 * [len(dfx.RESULTS._index_to_message)]
    # XLA removes what a loop carries and nobody reads, but not by the flags of the tests: with
    # fixed steps the error estimate of a learned solver, which evaluates the field.
    projected, estimate = found["flops"]
    assert projected < 1e6 < 1e7 < estimate
