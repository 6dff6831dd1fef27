"""The tables of `docs/published.md` and `docs/appendix/published.md`, from the results.

python benchmarks/published/tables.py           # prints what is won and lost
python benchmarks/published/tables.py --write   # puts each table between its two markers
"""

import argparse
import json
import math

import common
import discrete_gradient
import heyoka_page
import homproj_paper
import julia_energy
import matplotlib as mpl
import mechanisms
import pinn_issues
import positive_chemistry
import sundials
import sympflow
from matplotlib.figure import Figure

DOCS = common.measuring.RESULTS.parents[1] / "docs"
PAGES = [DOCS / "published.md", DOCS / "appendix" / "published.md"]
# In the order of the page.
ROWS = (
    *(sundials, homproj_paper, heyoka_page, discrete_gradient, julia_energy, mechanisms),
    *(positive_chemistry, sympflow, pinn_issues),
)


def read_results():
    files = {module: common.RESULTS / f"{module.__name__}.json" for module in ROWS}
    return {module: json.loads(file.read_text()) for module, file in files.items()}


def judgement(verdict) -> str:
    """What is smaller is better. Errors at roundoff on both sides count as equal."""
    ours, theirs = verdict.ours, verdict.theirs
    if ours == theirs or max(ours, theirs) < 1e-12:
        return "equal"
    if ours < theirs:
        return "ours"
    return "within 1.5" if ours <= 1.5 * theirs else "theirs"


def verdict_table(results):
    heads = ("problem", "what", "against", "theirs", "ours", "first")
    verdicts = [x for module, found in results.items() for x in module.verdicts(found)]
    return common.markdown(heads, ((*verdict, judgement(verdict)) for verdict in verdicts))


def summary(results):
    verdicts = [x for module, y in results.items() for x in module.verdicts(y)]
    found = [judgement(x) for x in verdicts]
    counts = {name: found.count(name) for name in ("ours", "equal", "within 1.5", "theirs")}
    others = [judgement(x) for x in verdicts if "no network" not in x.who]
    ahead = len(others) - others.count("theirs")
    return [
        f"Of {len(found)} comparisons ours is first in {counts['ours']}, equal in "
        f"{counts['equal']}, within a factor of 1.5 in {counts['within 1.5']}, and behind in "
        f"{counts['theirs']}. Without the {len(found) - len(others)} that set our networks beside "
        f"a solver of diffrax, which needs none, it is first, equal or within 1.5 in {ahead} of "
        f"{len(others)}, and behind in {len(others) - ahead}."
    ]


def machine(results):
    about = results[sundials]["machine"]
    names = ("jax", "diffrax", "scipy", "heyoka", "homproj", "scikit-sundae")
    versions = {k: v for x in results.values() for k, v in x["machine"]["versions"].items()}
    packages = ", ".join(f"{name} {versions[name]}" for name in names if name in versions)
    minutes = math.ceil(sum(x["minutes"] for x in results.values()))
    return [
        f"{about['cpu']}, {about['cores']} cores, shared with other work; Python "
        f"{about['python']}, {packages}; {about['date'][:10]}; {minutes} minutes in all."
    ]


def tables(results):
    """By the name in the markers of the pages."""
    return {
        "summary": summary(results),
        "machine": machine(results),
        "verdicts": verdict_table(results),
        "pendulum": sundials.table(results[sundials]),
        "particle": sundials.table(results[sundials], "particle", (1e-4, 1e-6)),
        "camassa-holm": homproj_paper.table(results[homproj_paper]),
        "kepler": homproj_paper.kepler_table(results[homproj_paper]),
        "outer solar system": heyoka_page.table(results[heyoka_page]),
        "discrete gradient": discrete_gradient.table(results[discrete_gradient]),
        "henon-heiles": julia_energy.table(results[julia_energy]),
        "boson": julia_energy.table(results[julia_energy], "quadrupole boson"),
        "default tolerances": julia_energy.loose_table(results[julia_energy]),
        "mechanisms": mechanisms.table(results[mechanisms]),
        "concentrations": positive_chemistry.table(results[positive_chemistry]),
        "sympflow": sympflow.table(results[sympflow]),
        "questions": pinn_issues.table(results[pinn_issues]),
    }


def filled(text, results):
    return common.measuring.filled(text, tables(results))


def figure(results):
    """Errors of three comparisons against what they cost."""
    pendulum = [x for x in results[sundials]["rows"] if x["problem"] == "pendulum"]
    panels = (
        ("pendulum of SUNDIALS", pendulum, "evaluations", ("CVODE, projected, published",
         "Dopri8, projected", "Dopri8, projected and energy")),
        ("Kepler, of homproj", results[homproj_paper]["kepler"], "evaluations",
         ("homproj, H, L, A_x", "ours, plain", "ours, H, L, A_x")),
        ("Hénon-Heiles, of SympFlow", results[sympflow]["rows"], "seconds",
         ("SympFlow", "ours, projected", "RK4, 4 steps, projected", "Dopri8, 1 step, projected")),
    )  # fmt: skip
    drawn = Figure(figsize=(9.6, 4.2))
    for ax, (title, rows, cost, programs) in zip(drawn.subplots(1, 3), panels, strict=True):
        for program in programs:
            points = [(x[cost], x["error"]) for x in rows if x["program"] == program]
            style = "o-" if cost == "evaluations" else "o"  # of several seeds
            ax.loglog(*zip(*points, strict=True), style, markersize=4, label=program)
        ax.set(title=title, xlabel=cost, ylabel="error")
        ax.set_xlim((1e3, 5e4) if cost == "evaluations" else None)
        ax.xaxis.set_minor_formatter("")
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), fontsize=8)
    drawn.savefig(DOCS / "images" / "published.svg", metadata={"Date": None})


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--write", action="store_true", help="the tables of the pages")
    options = parser.parse_args(argv)
    results = read_results()
    print("\n".join([*summary(results), *verdict_table(results)]))
    if options.write:
        for page in PAGES:
            page.write_text(filled(page.read_text(encoding="utf-8"), results), encoding="utf-8")
        with mpl.rc_context(fname=DOCS / "figures.mplstyle"):
            figure(results)


if __name__ == "__main__":
    main()
