"""What the pages cannot do themselves.

The table of solvers in `api/solvers.md` is the one that the tests run. A code block in a comment
`<!-- check ... -->` runs with the page, and is not shown.

Links to the objects of other packages, as `` [`diffrax.diffeqsolve`][] ``, stand in a table, not in
inventories that each build downloads, so that it needs no network. A name that is not in the table
fails the strict build, as a misspelt name of our own does.
"""

import re
import runpy
from pathlib import Path

DIFFRAX = "https://docs.kidger.site/diffrax/api"
EQUINOX = "https://docs.kidger.site/equinox/api"

PAGES = {
    f"{DIFFRAX}/diffeqsolve/": "diffeqsolve",
    f"{DIFFRAX}/solution/": "Solution",
    f"{DIFFRAX}/terms/": "AbstractTerm ODETerm",
    f"{DIFFRAX}/events/": "Event",
    f"{DIFFRAX}/stepsize_controller/": "PIDController",
    f"{DIFFRAX}/adjoints/": "BacksolveAdjoint",
    f"{DIFFRAX}/solvers/abstract_solvers/": "AbstractSolver",
    f"{DIFFRAX}/solvers/ode_solvers/": "Tsit5 Dopri8 Kvaerno5",
    f"{EQUINOX}/module/module/": "Module",
    f"{EQUINOX}/transformations/": "filter_jit",
    "https://optax.readthedocs.io/en/latest/api/transformations.html": "GradientTransformation",
}
TABLE = Path(__file__).parents[1] / "tests" / "solver" / "conformance_table.py"
CHECK = re.compile(r"\n*^<!-- check$.*?^-->$", re.DOTALL | re.MULTILINE)


def on_config(config):
    register = config.plugins["autorefs"].register_url
    for page, names in PAGES.items():
        package = re.search("diffrax|equinox|optax", page)[0]
        for name in names.split():
            register(f"{package}.{name}", f"{page}#{package}.{name}")
    # Described there without an anchor of its own.
    register("diffrax.RESULTS", f"{DIFFRAX}/solution/")


def on_page_markdown(markdown, **kwargs):
    del kwargs
    rows = runpy.run_path(str(TABLE))["TABLE"].items()
    table = ["| solver | tested as | inside `ManifoldProjection` |", "|---|---|---|"]
    table += [f"| `{solver}` | {kind} | supported |" for solver, kind in rows]
    return CHECK.sub("", markdown).replace("<!-- conformance table -->", "\n".join(table))
