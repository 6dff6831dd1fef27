"""Plants a defect in each trap of the design, one at a time, and runs tests that must notice.

`make mutants`, or `python tests/mutants.py [NAME ...]`. Prints, for each defect, the first test
that fails; exits with status 1 if any defect survives.
"""

import dataclasses
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]


@dataclasses.dataclass(frozen=True)
class Mutant:
    """A piece of text in a file of the package, what takes its place, and the tests to run."""

    file: str
    old: str
    new: str
    tests: tuple[str, ...]


SOLVER = "_solver/_manifold_projection.py"
MUTANTS = {
    "drop the sign of time": Mutant(
        "_solver/_terms.py",
        "direction = wrapped[0].direction if wrapped else 1",
        "direction = 1",
        ("tests/solver/test_diffrax.py", "-k", "either_direction"),
    ),
    "drop scan_kind": Mutant(
        SOLVER,
        "def scan_kind(self)",
        "def not_scan_kind(self)",
        ("tests/solver/test_diffrax.py", "-k", "adjoints_agree"),
    ),
    "drop root_finder": Mutant(
        SOLVER,
        "def root_finder(self)",
        "def not_root_finder(self)",
        ("tests/solver/test_diffrax.py", "-k", "implicit_solvers"),
    ),
    "do not project the interpolant": Mutant(
        "_interpolation.py",
        "y, info = self.target.unpack().project(t0, self.inner.evaluate(t0, left=left))",
        "_, info = self.target.unpack().project(t0, y := self.inner.evaluate(t0, left=left))",
        ("tests/solver/test_conservation.py", "-k", "saved_and_dense"),
    ),
    "call NaN a success": Mutant(
        "_projection/_base.py",
        "jnp.all((jnp.abs(g) <= tol) & (tol < jnp.inf))",
        "~jnp.any(jnp.abs(g) > tol)",
        ("tests/projection/test_laws.py", "-k", "nan"),
    ),
    "take the conserved value anew at every step": Mutant(
        SOLVER,
        "            state.values,\n            args,\n            time_direction(terms, t1),",
        "            conserved_values(self.manifold, t1, y0, args),\n"
        "            args,\n            time_direction(terms, t1),",
        ("tests/solver/test_diffrax.py", "-k", "continued_solve"),
    ),
    "accept a step whose projection failed": Mutant(
        SOLVER,
        "jnp.where(success, e, FAILED_PROJECTION)",
        "e",
        ("tests/solver/test_diffrax.py", "-k", "retried"),
    ),
    "report a failed projection as a success": Mutant(
        SOLVER,
        "result = dfx.RESULTS.where(success | (result != dfx.RESULTS.successful), result, failed)",
        "result = dfx.RESULTS.where(success | True, result, failed)",
        ("tests/solver/test_failure.py",),
    ),
    "ignore max_correction": Mutant(
        "_projection/_target.py",
        "~(info.correction <= self.limit)",
        "(info.correction < 0)",
        ("tests/solver/test_failure.py", "-k", "max_correction"),
    ),
    "forget the curvature in the derivative": Mutant(
        "_projection/_simplified_newton.py",
        "_, vjp = eqx.filter_vjp(residual, candidate)\n        (direction,) = vjp(multiplier)",
        "_, vjp = eqx.filter_vjp(residual, jax.lax.stop_gradient(candidate))\n"
        "        (direction,) = vjp(jax.lax.stop_gradient(multiplier))",
        ("tests/projection/test_derivatives.py", "-k", "unrolled"),
    ),
    "leave a lane of a batch unfinished": Mutant(
        "_projection/_any_lane.py",
        "jnp.any(flags), states",
        "jnp.all(flags), states",
        ("tests/projection/test_laws.py", "-k", "lane_of_a_batch"),
    ),
    "stop the Newton iteration of random features at once": Mutant(
        "_solver/_galerkin.py",
        "found = size <= tolerance * jnp.max(jnp.abs(states))",
        "found = size < jnp.inf",
        ("tests/solver/test_random_features.py", "-k", "rigid_body"),
    ),
    "report unsolved equations as a success": Mutant(
        "_solver/_random_features.py",
        "            unsolved(found),",
        "            unsolved(found | True),",
        ("tests/solver/test_random_features_in_diffrax.py", "-k", "say_so"),
    ),
    "follow the network wherever it goes": Mutant(
        "_training/_pool.py",
        "goes_on = small & ~jr.bernoulli(",
        "goes_on = ~jr.bernoulli(",
        ("tests/training/test_pool.py", "-k", "leads_nowhere"),
    ),
    "judge the best model on the states of its time": Mutant(
        "_training/_epochs.py",
        "best = problem.criterion(carry.best_weights, carry.points)",
        "best = carry.best",
        ("tests/training/test_pool.py", "-k", "compared_on_the_same"),
    ),
}


def survives(name: str, mutant: Mutant) -> bool:
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for part in ("diffrax_conserve", "tests", "pyproject.toml"):
            source = ROOT / part
            copy_one = shutil.copytree if source.is_dir() else shutil.copy
            copy_one(source, copy / part)
        file = copy / "diffrax_conserve" / mutant.file
        text = file.read_text(encoding="utf-8")
        if text.count(mutant.old) != 1:
            raise SystemExit(f"{name}: the text to replace is {text.count(mutant.old)} times there")
        mutated = text.replace(mutant.old, mutant.new)
        if "jax." in mutant.new and "\nimport jax\n" not in mutated:
            mutated = mutated.replace(
                "import equinox as eqx\n", "import equinox as eqx\nimport jax\n"
            )
        file.write_text(mutated, encoding="utf-8")
        run = subprocess.run(
            [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *mutant.tests],
            cwd=copy,
            env={**os.environ, "PYTHONPATH": str(copy), "CI": "1"},
            capture_output=True,
            text=True,
            check=False,
        )
    failed = [line for line in run.stdout.splitlines() if line.startswith("FAILED")]
    if run.returncode == 1 and failed:
        print(f"noticed   {name}: {failed[0].split(' - ')[0].removeprefix('FAILED ')}", flush=True)
        return False
    print(
        f"SURVIVED  {name} (pytest exited with {run.returncode})\n{run.stdout[-2000:]}", flush=True
    )
    return True


def main() -> int:
    names = sys.argv[1:] or list(MUTANTS)
    survivors = [name for name in names if survives(name, MUTANTS[name])]
    print(f"{len(names) - len(survivors)} of {len(names)} defects noticed")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())
