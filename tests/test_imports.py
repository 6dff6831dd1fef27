"""The import graph: it has no cycle, it points one way, and optional packages stay optional.

The imports are read from the source, so those inside functions and under `TYPE_CHECKING` count too.
"""

import ast
import functools
import graphlib
import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

import diffrax_conserve as dfc
from diffrax_conserve._solver.diffrax_private import register, result_at

from .learned import LORENZ, flow_map, unchecked

PACKAGE = "diffrax_conserve"
ROOT = Path(__file__).parents[1] / PACKAGE

# A part of the package may import those of the lines above it. A part is a file or folder directly
# under the package, and `diffrax_conserve` is its `__init__.py`.
LAYERS = (
    {"_custom_types", "_printing", "_options", "_constants", "_hashable", "_memory"},
    {"_tree", "_time", "_fast"},
    {"_manifold", "_large"},
    {"_balance", "_numerics"},
    {"_projection"},
    {"_interpolation"},
    {"_solver"},
    {"_diagnostics", "_mechanics", "_dae"},
    {"systems"},
    {"learned", "testing"},
    {PACKAGE},
    {"reproduce"},
    {"__main__"},
)

# Packages that only these parts may import, because they are optional.
CONFINED = {
    "hypothesis": {"testing"},
    "klujax": {"_large"},
    "matplotlib": {"reproduce", "_diagnostics"},
}

# Private names of other packages that have no public equivalent: `(file, name)`. The file says why.
PRIVATE_ALLOWED = {
    ("_solver/diffrax_private.py", "diffrax._term.WrapTerm"),
    ("_solver/diffrax_private.py", "diffrax._term.AdjointTerm"),
    ("_solver/diffrax_private.py", "diffrax.RESULTS._index_to_message"),
}


def module_name(file: Path) -> str:
    parts = file.relative_to(ROOT.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(file): file for file in sorted(ROOT.rglob("*.py"))}


def part(module: str) -> str:
    """The file or folder directly under the package that `module` belongs to."""
    return module.split(".")[1] if "." in module else module


@functools.cache
def imports(file: Path) -> tuple[str, ...]:
    """The absolute names of everything that `file` imports, `from a import b` being `a.b`."""
    found = []
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = file.relative_to(ROOT.parent).parts[: -node.level]
                base = ".".join([*package, *filter(None, [base])])
            found += [f"{base}.{alias.name}" for alias in node.names]
    return tuple(found)


def internal_imports(module: str) -> set[str]:
    """The modules of the package that `module` imports."""
    found = set()
    for name in imports(MODULES[module]):
        if name.split(".")[0] == PACKAGE:
            # The last piece is a module in `from . import _tree`, a name in `from ._tree import x`.
            found.add(name if name in MODULES else name.rpartition(".")[0])
    return found - {module}


def test_no_import_cycle():
    graph = {module: internal_imports(module) for module in MODULES}
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        pytest.fail("an import cycle: " + " <- ".join(error.args[1]))


def test_imports_follow_the_layers():
    layer = {part: i for i, parts in enumerate(LAYERS) for part in parts}
    for module in MODULES:
        own = part(module)
        assert own in layer, f"`{own}` is new: say in LAYERS what it may import"
        used = {part(other) for other in internal_imports(module)} - {own}
        wrong = sorted(name for name in used if layer[name] >= layer[own])
        assert not wrong, f"{module} may not import {wrong}"


def test_optional_packages_are_imported_in_their_parts_only():
    for package, owners in CONFINED.items():
        users = {
            part(module)
            for module, file in MODULES.items()
            if any(name.split(".")[0] == package for name in imports(file))
        }
        assert users <= owners


def test_what_is_imported_is_declared():
    project = tomllib.loads((ROOT.parent / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    declared = {re.match(r"[\w-]+", line).group() for line in project["dependencies"]}
    used = {name.split(".")[0] for file in MODULES.values() for name in imports(file)}
    assert used - sys.stdlib_module_names - CONFINED.keys() - {PACKAGE} == declared


def external_names(file: Path) -> Iterator[str]:
    """The names from other packages in `file`: imported, or reached as attributes of an import."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    yield from (name for name in imports(file) if name.split(".")[0] != PACKAGE)
    modules = {
        alias.asname or alias.name.split(".")[0]: alias.name if alias.asname else ""
        for node in ast.walk(tree)
        if isinstance(node, ast.Import)
        for alias in node.names
    }
    for node in ast.walk(tree):
        dotted = ast.unparse(node) if isinstance(node, ast.Attribute) else ""
        root, _, rest = dotted.partition(".")
        if rest and root in modules:
            yield f"{modules[root] or root}.{rest}"


def is_private(name: str) -> bool:
    return any(
        piece == "internal" or (piece.startswith("_") and not piece.endswith("__"))
        for piece in name.split(".")
    )


def test_private_names_of_other_packages_are_those_allowed():
    used = {
        (file.relative_to(ROOT).as_posix(), name)
        for file in MODULES.values()
        for name in external_names(file)
        if is_private(name)
    }
    assert used == PRIVATE_ALLOWED


def test_a_registered_message_is_a_result_like_those_of_diffrax(errors_raise):
    """Fails when diffrax keeps its messages otherwise."""
    messages = dfx.RESULTS._index_to_message
    before = list(messages)
    try:
        first = register("the moon is in the way")
        assert messages == [*before, "diffrax_conserve: the moon is in the way"]
        result = eqx.filter_jit(result_at)(jnp.asarray(first))
        assert dfx.RESULTS[result] == messages[-1]
        assert dfx.RESULTS[dfx.RESULTS.successful] == ""
        chosen = dfx.RESULTS.where(result != dfx.RESULTS.successful, result, dfx.RESULTS.successful)
        with pytest.raises(RuntimeError, match="diffrax_conserve: the moon is in the way"):
            chosen.error_if(jnp.ones(1), chosen == result).block_until_ready()
    finally:
        del messages[len(before) :]


# ---- A new interpreter, without the settings of the tests ----

CODE = """
import json, sys
import diffrax, diffrax_conserve
modules, messages = list(sys.modules), len(diffrax.RESULTS._index_to_message)
from tests.test_imports import work_with_a_heavy_field
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
