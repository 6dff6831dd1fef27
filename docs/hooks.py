"""What the pages cannot do themselves.

The table of solvers in `api/solvers.md` is the one that the tests run.

A code block in a comment `<!-- check ... -->` runs with the page, and is not shown.

A comment `# fmt: skip`, which is for the formatter, is not shown.

Links from the docs to the objects of other packages: `` [`diffrax.diffeqsolve`][] ``.

The usual way is an inventory downloaded at each build. Ours is a table, so that the build needs no
network; a name that is not in it fails the strict build, as a misspelt name of our own does.
"""

import re
import runpy
from pathlib import Path

DIFFRAX = "https://docs.kidger.site/diffrax/api"
EQUINOX = "https://docs.kidger.site/equinox/api"
OPTIMISTIX = "https://docs.kidger.site/optimistix/api"
OPTAX = "https://optax.readthedocs.io/en/latest/api"

PAGES = {
    f"{DIFFRAX}/diffeqsolve/": "diffrax.diffeqsolve",
    f"{DIFFRAX}/saveat/": "diffrax.SaveAt diffrax.SubSaveAt",
    f"{DIFFRAX}/solution/": "diffrax.Solution",
    f"{DIFFRAX}/terms/": (
        "diffrax.AbstractTerm diffrax.ODETerm diffrax.ControlTerm diffrax.MultiTerm"
    ),
    f"{DIFFRAX}/events/": "diffrax.Event",
    f"{DIFFRAX}/stepsize_controller/": (
        "diffrax.ConstantStepSize diffrax.StepTo diffrax.PIDController "
        "diffrax.ClipStepSizeController"
    ),
    f"{DIFFRAX}/adjoints/": (
        "diffrax.RecursiveCheckpointAdjoint diffrax.BacksolveAdjoint diffrax.ImplicitAdjoint "
        "diffrax.DirectAdjoint diffrax.ForwardMode"
    ),
    f"{DIFFRAX}/solvers/abstract_solvers/": (
        "diffrax.AbstractSolver diffrax.AbstractWrappedSolver diffrax.AbstractImplicitSolver "
        "diffrax.AbstractAdaptiveSolver"
    ),
    f"{DIFFRAX}/solvers/ode_solvers/": (
        "diffrax.Euler diffrax.Heun diffrax.Midpoint diffrax.Ralston diffrax.Bosh3 diffrax.Tsit5 "
        "diffrax.Dopri5 diffrax.Dopri8 diffrax.ImplicitEuler diffrax.Kvaerno3 diffrax.Kvaerno4 "
        "diffrax.Kvaerno5 diffrax.SemiImplicitEuler diffrax.ReversibleHeun "
        "diffrax.LeapfrogMidpoint diffrax.HalfSolver"
    ),
    f"{EQUINOX}/module/module/": "equinox.Module",
    f"{EQUINOX}/errors/": "equinox.error_if",
    f"{EQUINOX}/transformations/": (
        "equinox.filter_jit equinox.filter_grad equinox.filter_value_and_grad equinox.filter_vmap"
    ),
    f"{OPTAX}/transformations.html": "optax.GradientTransformation",
    f"{OPTIMISTIX}/root_find/": "optimistix.root_find optimistix.Newton optimistix.Chord",
}

ROOT = Path(__file__).parent.parent

# Described on a page, without an anchor of their own.
MENTIONED = {"diffrax.RESULTS": f"{DIFFRAX}/solution/"}


def on_config(config):
    autorefs = config.plugins["autorefs"]
    for page, names in PAGES.items():
        for name in names.split():
            autorefs.register_url(name, f"{page}#{name}")
    for name, page in MENTIONED.items():
        autorefs.register_url(name, page)


SKIP = re.compile(r"\s*<span class=\"c1\"># fmt: skip</span>")
CHECK = re.compile(r"\n*^<!-- check$.*?^-->$", re.DOTALL | re.MULTILINE)
CONFORMANCE = ROOT / "tests" / "solver" / "conformance_table.py"


def on_page_markdown(markdown, **kwargs):
    del kwargs
    rows = runpy.run_path(str(CONFORMANCE))["TABLE"].items()
    table = ["| solver | tested as | inside `ManifoldProjection` |", "|---|---|---|"]
    table += [f"| `{solver}` | {kind} | supported |" for solver, kind in rows]
    markdown = CHECK.sub("", markdown)
    return markdown.replace("<!-- conformance table -->", "\n".join(table))


def on_page_content(html, **kwargs):
    del kwargs
    return SKIP.sub("", html)
