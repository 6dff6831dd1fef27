"""Plants a defect in each trap of the design, one at a time, and runs the test that must notice.

`make mutants`, or `python tests/mutants.py [NAME ...]`. Prints, for each defect, what fails; exits
with status 1 if any defect survives. `mutants.md` says which test must notice which defect, and is
written anew when all are planted.

A defect is a function of a `package`, which replaces functions and methods that it finds by their
names wherever they are. The test runs with this file as a pytest plugin, which plants the defect
before any test is imported.
"""

import contextlib
import dataclasses
import importlib
import inspect
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.flatten_util
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
import pytest

from diffrax_conserve._numerics.metric import Identity
from diffrax_conserve._numerics.problem import relative_to_scale

ROOT = Path(__file__).parents[1]
PACKAGE = "diffrax_conserve"
TABLE = Path(__file__).with_suffix(".md")
TITLE = "What `make mutants` found.\n\n| defect | first test that fails |\n|---|---|\n"


class Package:
    """The package, in which names are replaced until `patch` is undone."""

    def __init__(self, patch: pytest.MonkeyPatch):
        for room in ("", ".learned", ".systems", ".testing"):
            importlib.import_module(PACKAGE + room)
        names = [name for name in sys.modules if name.split(".")[0] == PACKAGE]
        self.modules = [sys.modules[name] for name in sorted(names)]
        self.patch = patch

    def find(self, name: str) -> Any:
        """The one function or class of that name that is defined in the package; that of the core
        where `learned` has one too, as with `Problem`."""
        found = {
            id(value): value
            for module in self.modules
            if getattr(value := vars(module).get(name), "__module__", None) == module.__name__
        }
        core = {k: v for k, v in found.items() if ".learned." not in v.__module__}
        found = core or found
        if len(found) != 1:
            raise LookupError(f"{PACKAGE} defines {len(found)} functions or classes named {name}")
        return next(iter(found.values()))

    def replace(self, name: str, new: Any) -> None:
        """Puts `new` in the place of `Class.attribute`, or of a function in all that import it."""
        owner, _, attribute = name.rpartition(".")
        if owner:
            if attribute not in vars(cls := self.find(owner)):
                raise LookupError(f"{owner} defines no {attribute}")
            self.patch.setattr(cls, attribute, new)
            return
        old = self.find(name)
        for module in self.modules:
            for attribute in [key for key, value in vars(module).items() if value is old]:
                self.patch.setattr(module, attribute, new)

    def around(self, name: str) -> Callable:
        """Decorates what is called in the place of a function or method, with the old one first."""
        owner, _, attribute = name.rpartition(".")
        old = vars(self.find(owner)).get(attribute) if owner else self.find(name)
        return lambda new: self.replace(name, lambda *x, **y: new(old, *x, **y))

    def in_module_of(self, name: str, attribute: str, value: Any) -> None:
        """Replaces what the module that defines `name` calls `attribute`."""
        self.patch.setattr(sys.modules[self.find(name).__module__], attribute, value)


# ---- The core ----


def drop_the_sign_of_time(package):
    package.replace("time_direction", lambda terms, t: jnp.ones((), jnp.result_type(t)))


def drop_scan_kind(package):
    package.replace("ForwardingSolver.scan_kind", property(lambda self: None))


def drop_root_finder(package):
    detached = property(lambda self: diffrax.VeryChord(rtol=1e-3, atol=1e-3))
    package.replace("ForwardingSolver.root_finder", detached)


def do_not_project_the_interpolant(package):
    @package.around("ManifoldInterpolation.evaluate")
    def _(old, self, t0, t1=None, left=True):
        return self.inner.evaluate(t0, t1, left)


def divide_by_the_length_of_a_step_that_has_none(package):
    package.replace("nonzero_length", lambda t0, t1: t1 - t0)


def call_nan_a_success(package):
    @package.around("Problem.status")
    def _(status, self, *values):
        return status(self, *(jnp.where(jnp.isfinite(x), x, 0) for x in values))


def take_the_conserved_value_anew_at_every_step(package):
    conserved_values = package.find("conserved_values")

    @package.around("ManifoldProjection.step")
    def _(step, self, terms, t0, t1, y0, args, state, made_jump):
        values = conserved_values(self.manifold, t0, y0, args)
        values = jax.flatten_util.ravel_pytree(values)[0]
        constants = state.packed_constants.at[: values.size].set(values)
        state = dataclasses.replace(state, packed_constants=constants)
        return step(self, terms, t0, t1, y0, args, state, made_jump)


def _inner_step(self, terms, t0, t1, y0, args, state, _):
    return self.solver.step(terms, t0, t1, y0, args, state.inner, True)


def accept_a_step_whose_projection_failed(package):
    @package.around("ManifoldProjection.step")
    def _(step, *arguments):
        y, _, *rest = step(*arguments)
        return y, _inner_step(*arguments)[1], *rest


def report_a_failed_projection_as_a_success(package):
    @package.around("ManifoldProjection.step")
    def _(step, *arguments):
        return *step(*arguments)[:-1], _inner_step(*arguments)[-1]


def ignore_max_correction(package):
    @package.around("ManifoldProjection.step")
    def _(step, self, *arguments):
        limit = lambda s: s.max_correction  # noqa: E731
        return step(eqx.tree_at(limit, self, None, is_leaf=lambda x: x is None), *arguments)


def forget_the_curvature_in_the_derivative(package):
    @package.around("SimplifiedNewton.solve")
    def _(solve, self, problem, candidate):
        y, info = lax.stop_gradient(solve(self, problem, candidate))
        moved = y + candidate - lax.stop_gradient(candidate)
        # The multipliers follow the candidate, but not the direction in which they move it.
        inverse = jnp.linalg.pinv(lax.stop_gradient(jax.jacobian(problem.residual)(y)))
        return moved - inverse @ problem.residual(moved), info


def leave_a_lane_of_a_batch_unfinished(package):
    wrong = SimpleNamespace(**{**vars(jnp), "any": jnp.all})
    package.in_module_of("_any_lane", "jnp", wrong)


def decide_success_by_the_scale_at_the_candidate(package):
    def wrong(solve, self, problem, candidate):
        scale = problem.scale(problem.linearise(candidate)[1], candidate)
        limit = 16 * jnp.finfo(candidate.dtype).eps * scale
        return solve(self, dataclasses.replace(problem, rtol=0.0, atol=limit), candidate)

    for name in ("SimplifiedNewton", "Newton"):
        package.around(f"{name}.solve")(wrong)
    # One more iteration would bring such a state to roundoff after all.
    package.around("remaining_after_test")(lambda test, *x, **y: test(*x, **y | {"polish": False}))


def polish_along_nearly_parallel_gradients(package):
    tolerance = lambda status, dtype: 16 * float(jnp.finfo(dtype).eps)  # noqa: E731
    package.replace("_pivot_tolerance", tolerance)


def divide_by_every_pivot_in_derivatives(package):
    package.replace("AbstractRows.derivative_pivot_tolerance", lambda rows: 0.0)


def return_a_state_that_was_not_projected_as_nan(package):
    @package.around("ManifoldInterpolation.projected")
    def _(projected, self, t, moved):
        y = projected(self, t, moved)
        return jnp.where(y == moved, jnp.nan, y)


def measure_corrections_in_the_numbers_of_the_state(package):
    @package.around("ManifoldProjection._target")
    def _(made, *arguments):
        state, target = made(*arguments)
        return state, dataclasses.replace(target, factor=Identity())


def give_each_component_of_a_vector_its_own_unit(package):
    package.replace("largest_of_quantity", lambda x, like: x)


def keep_the_frozen_directions(package):
    package.in_module_of("simplified_newton", "FROZEN_STEPS", 100)


def leave_what_was_added_to_the_diagonal(package):
    package.replace("iterative_refinement", lambda solve, product, b: solve(b))


def divide_by_the_roundoff_of_a_pivot(package):
    package.in_module_of("forward_elimination", "TOLERANCE_IN_EPS", 0)


def eliminate_in_the_given_order(package):
    @package.around("ldu_factors")
    def _(old, matrix, *, pivoting=False, **options):
        return old(matrix, **options)


def cross_kinks_in_full_steps(package):
    package.replace("_line_search", lambda *arguments: 1.0)


def differentiate_at_constant_unknowns(package):
    constant = lambda self, solved: lax.stop_gradient(solved.y)  # noqa: E731
    package.replace("SquareSystem.linearisation_point", constant)


def never_give_up(package):
    package.replace("is_shortest_step", lambda *arguments: jnp.asarray(False))


def give_up_once_a_step_is_short(package):
    @package.around("is_shortest_step")
    def _(is_shortest_step, length, time, change, candidate):
        short = jnp.all(change <= 1e-3 * jnp.abs(candidate))
        return short | is_shortest_step(length, time, change, candidate)


def forget_the_roundoff_that_is_not_in_the_gradient(package):
    package.around("cancellation_terms")(lambda measure, fn, y: (*measure(fn, y)[:2], 0 * fn(y)))


class _Passing(eqx.Module):
    """A solver that is told what diffrax says of a jump."""

    solver: diffrax.AbstractSolver
    made_jump: Any

    @property
    def interpolation_cls(self):
        return self.solver.interpolation_cls

    def step(self, terms, t0, t1, y0, args, state, _):
        return self.solver.step(terms, t0, t1, y0, args, state, self.made_jump)


def keep_the_last_stage_of_the_candidate(package):
    @package.around("ManifoldProjection.step")
    def _(step, self, *rest):
        inner = _Passing(self.solver, rest[-1])
        return step(eqx.tree_at(lambda s: s.solver, self, inner), *rest)


# ---- Systems and learned solvers ----


def hang_the_double_pendulum_in_a_gravity_of_1(package):
    @package.around("DoublePendulum.__init__")
    def _(init, self, *arguments, gravity=1.0, **options):
        init(self, *arguments, gravity=gravity, **options)


def stop_the_newton_iteration_of_random_features_at_once(package):
    solved = package.find("Solved")

    @package.around("_newton")
    def _(old, problem, start):
        states = problem.states(start)
        change = problem.solve_linear(problem.jacobians(states), problem.residual(start))
        return solved(start - change, jnp.asarray(True), jnp.asarray(1))


def report_unsolved_equations_as_a_success(package):
    @package.around("_newton")
    def _(newton, *arguments):
        found = newton(*arguments)
        return found._replace(ok=jnp.ones_like(found.ok))


# ---- What a stranger planted, who had read the package and not its tests ----


def take_the_derivative_at_an_upper_bound_from_outside(package):
    @package.around("Bounds.clip")
    def _(clip, self, z, **options):
        y = clip(self, z, **options)
        return jnp.where(z == self.upper, lax.stop_gradient(y), y)


def name_an_element_in_the_place_of_its_entry(package):
    wrong = SimpleNamespace(**{**vars(np), "repeat": lambda _, sizes: np.arange(sum(sizes))})
    package.in_module_of("Problem", "np", wrong)


def project_a_saved_state_to_the_manifold_at_the_end_of_its_step(package):
    @package.around("ManifoldInterpolation.projected")
    def _(projected, self, t, moved):
        return projected(self, self.field_time(self.t1), moved)


def integrate_rates_forwards_in_a_solve_backwards(package):
    @package.around("integrated_rates")
    def _(integrated, manifold, start, end, *given):
        rates = integrated(manifold, start, end, *given)
        return jax.tree.map(lambda x: x * jnp.sign(end - start), rates)


def forget_how_the_state_changed_in_the_last_step(package):
    @package.around("ManifoldProjection._target")
    def _(made, *given):
        state, target = made(*given)
        nothing = jax.tree.map(jnp.zeros_like, target.displacements)
        return state, dataclasses.replace(target, displacements=nothing)


def let_a_moving_constraint_run_forwards_in_a_solve_backwards(package):
    package.in_module_of("RATTLE", "in_field_time", lambda terms, *times: (terms, *times))


def differentiate_a_symmetric_step_in_the_euclidean_metric(package):
    def along(problem, y, multiplier):
        return jax.vjp(problem.residual, y)[1](multiplier)[0]

    package.in_module_of("SymmetricProjection", "_along", along)


def take_one_dae_for_another_of_the_same_shapes(package):
    @package.around("tree_key")
    def _(old, tree):
        leaves, treedef = jax.tree.flatten(tree)
        return treedef, tuple(jnp.shape(x) for x in leaves if eqx.is_array_like(x))


def move_free_unknowns_as_little_as_the_others(package):
    @package.around("_directions")
    def _(old, jacobian, units, along, moves):
        return old(jacobian, jnp.ones_like(units), along, False)


def count_the_roundoff_of_a_combination_as_an_equation(package):
    package.around("_unless_roundoff")(lambda old, values, terms: values)


def solve_for_slopes_whose_coefficients_vanish_at_rest(package):
    package.around("usual")(lambda old, at_rest, values: values)


def meet_all_constraints_at_once(package):
    @package.around("with_stages")
    def _(old, *given):
        return dataclasses.replace(old(*given), stages=(), new_unknowns=())


def leave_what_pivots_leave_in_an_inverse(package):
    package.around("_reaches")(lambda old, matrix: np.ones(matrix.shape, bool))


def divide_by_the_unit_of_an_unknown_that_has_not_moved(package):
    package.around("_positive")(lambda old, units, *given: units)


def begin_with_slopes_of_zero(package):
    package.replace("_IndexOneEquations.first_slopes", lambda self, *given: None)


def give_a_zero_no_size(package):
    package.replace("implied_by_others", lambda jacobian, size: 0 * size)


def let_calls_of_lapack_run_at_once(package):
    package.replace("computed_after", lambda x, known: x)


def look_between_the_gauss_points_for_nothing(package):
    package.around("_error")(lambda old, *given: (old(*given)[0], 0.0))


def leave_the_error_of_a_share_of_another_combination(package):
    samples = sys.modules[package.find("_simplified").__module__]._Samples
    package.patch.setattr(samples, "refined", lambda self, c: c)


def correct_what_rests_at_its_bound(package):
    bounds = sys.modules[package.find("along_gradients").__module__].Bounds
    package.patch.setattr(bounds, "corrected", lambda self, z, rows: z == z)


def take_for_conserved_what_changes_along_the_reference(package):
    package.replace("not_conserved", lambda *given: {})


def compare_the_shardings_of_a_closure(package):
    package.replace("ClosureConverted", eqx.filter_closure_convert)


def forget_the_sign_of_a_defect_of_an_invariant(package):
    package.in_module_of(
        "check_invariance", "relative_to_scale", lambda *x: jnp.maximum(relative_to_scale(*x), 0)
    )


def leave_the_arrays_of_a_part_that_is_given_again_in_the_file(package):
    describe = package.find("_describe")

    @package.around("_describe_field")
    def _(describe_field, field, value, arrays):
        before, left = len(arrays), []
        with contextlib.suppress(TypeError):
            describe(value, left)
        found = describe_field(field, value, arrays)
        arrays[before:] = left
        return found


def round_the_rates_of_reactions_to_float32(package):
    @package.around("Mechanism.vector_field")
    def _(field, self, *arguments):
        if not callable(self.rates):
            self = eqx.tree_at(lambda m: m.rates, self, self.rates.astype(jnp.float32))
        return field(self, *arguments)


# ---- How they are planted and noticed ----

MUTANTS = {
    name.replace("_", " "): plant
    for name, plant in list(globals().items())
    if inspect.isfunction(plant) and [*inspect.signature(plant).parameters] == ["package"]
}


def pytest_sessionstart():
    """As a plugin: plants the defect that the environment names."""
    MUTANTS[os.environ["DEFECT"]](Package(pytest.MonkeyPatch()))


def finder(name: str) -> str:
    """The test that must notice a defect, by the table."""
    rows = re.findall(r"^\| (.+?) \| (tests/.+) \|$", TABLE.read_text("utf-8"), re.MULTILINE)
    return dict(rows)[name]


def is_fast(test: str) -> bool:
    """Whether there is such a test, and it is not slow."""
    file, _, name = test.partition("[")[0].partition("::")
    parts = (ROOT / file).read_text(encoding="utf-8").split("\n\n\n")
    (part,) = [part for part in parts if f"def {name}(" in part] or ["@pytest.mark.slow"]
    return not re.search(r"^@(pytest\.mark\.slow|SLOW)$", part, re.MULTILINE)


def found_by(name: str) -> str | None:
    """The first fast test that fails because of a defect; `None` if the defect survives."""
    command = [sys.executable, "-m", "pytest", "-p", "tests.mutants", "-p", "no:cacheprovider"]
    run = subprocess.run(
        [*command, "-x", "-q", "-m", "not slow and not examples", finder(name).partition("[")[0]],
        cwd=ROOT,
        env={**os.environ, "DEFECT": name, "CI": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    failed = [line for line in run.stdout.splitlines() if line.startswith("FAILED")]
    # A defect that does not fit its place crashes every test, whatever they test.
    crashed = any(re.search(r" - (TypeError|AttributeError)", line) for line in failed)
    if run.returncode == 1 and failed and not crashed:
        test = failed[0].split(" - ")[0].removeprefix("FAILED ")
        print(f"noticed   {name}: {test}", flush=True)
        return test
    print(
        f"SURVIVED  {name} (pytest exited with {run.returncode})\n"
        f"{run.stdout[-2000:]}{run.stderr[-2000:]}",
        flush=True,
    )
    return None


def main() -> int:
    found = {name: found_by(name) for name in sys.argv[1:] or MUTANTS}
    noticed = [test for test in found.values() if test]
    print(f"{len(noticed)} of {len(found)} defects noticed")
    if list(found) == list(MUTANTS):
        rows = (f"| {name} | {test or finder(name)} |\n" for name, test in found.items())
        TABLE.write_text(TITLE + "".join(rows), encoding="utf-8")
    return 0 if len(noticed) == len(found) else 1


if __name__ == "__main__":
    sys.exit(main())
