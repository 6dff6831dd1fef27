"""The soak run finds what is wrong, and draws the same again."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from . import soak

PROGRAM = soak.Program("harmonic-oscillator", ("energy",), "RK4", False, False, "ts", False)


@pytest.fixture(scope="module")
def run():
    lanes = soak.draw_lanes(PROGRAM, 0, 0, 4)
    # Small steps, of which an error is asked for.
    lanes = eqx.tree_at(lambda x: x.dt0, lanes, jnp.full(4, 0.002))
    lanes = eqx.tree_at(lambda x: x.span, lanes, 0.1 * jnp.sign(lanes.span))
    return lanes, soak.run_batch(PROGRAM, lanes)


def test_what_is_right_is_judged_right(run):
    verdict = soak.judge(PROGRAM, *run)
    assert not verdict.failed.any()
    assert verdict.wrong == {}
    assert 0 < verdict.worst_ratio <= 1


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [("ratio", 1.5, "residual"), ("ratio", np.nan, "residual"), ("finite", False, "not finite")],
)
def test_what_is_wrong_is_found(run, field, value, reason):
    lanes, outcome = run
    planted = getattr(outcome, field).at[2].set(value)
    outcome = eqx.tree_at(lambda o: getattr(o, field), outcome, planted)
    assert reason in soak.judge(PROGRAM, lanes, outcome).wrong[2]
    # Unless the solve says that it failed.
    failed = eqx.tree_at(lambda o: o.okay, outcome, outcome.okay.at[2].set(False))
    assert soak.judge(PROGRAM, lanes, failed).wrong == {}


def test_a_wrong_solution_on_the_manifold_is_found(run):
    lanes, outcome = run
    mirrored = eqx.tree_at(lambda o: o.states, outcome, jax.tree.map(lambda x: -x, outcome.states))
    assert all("the error is" in why for why in soak.judge(PROGRAM, lanes, mirrored).wrong.values())
    assert len(soak.judge(PROGRAM, lanes, mirrored).wrong) == 4


def test_programs_are_drawn_again_and_cover_every_system():
    programs = [soak.draw_program(3, k) for k in range(len(soak.SYSTEMS))]
    assert programs == [soak.draw_program(3, k) for k in range(len(soak.SYSTEMS))]
    assert {p.system for p in programs} == set(soak.SYSTEMS)
    assert programs != [soak.draw_program(4, k) for k in range(len(soak.SYSTEMS))]
