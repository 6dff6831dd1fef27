"""From the results of `make bench`: tables of the documentation, and the figures of the pages on
performance and on Radau.

Prints the tables; `--write` puts each between its two markers and redraws the figures. A test holds
the tables of the pages to the results.
"""

import argparse
import math
import runpy
import statistics
from collections.abc import Iterable
from typing import Any

import matplotlib as mpl
import measuring
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

ROOT = measuring.HERE.parent.parent
DOCS = ROOT / "docs"
FILES = ("performance", "many-constraints", "radau", "large-stiff")
PAGES = [DOCS / f"{x}.md" for x in FILES]
NAMES = ("scaling", "many_constraints", "dae", "large", "compiler_option")
# Of each system: the integrals that are kept, and the numbers in its state.
SIZES = {"rigid body": (2, 3), "three vortices": (4, 6), "ten vortices": (4, 20)}

Results = dict[str, dict[str, Any]]


def read_results() -> Results:
    return {name: measuring.read(name) for name in NAMES}


# ---- Tables ----


def integrals_table(results: Results) -> list[str]:
    """Projected over plain: the times of a step, alone and in a batch, and of the compilation."""
    heads = ("integrals", "numbers in the state", "system", "method")
    heads = (*heads, "alone", "batch of 1,000", "compilation")
    lines = [f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
    rows = {(x["system"], x["batch"]): x["rows"] for x in results["scaling"]["parts"]["methods"]}
    for system, (integrals, numbers) in SIZES.items():
        alone, many = rows[system, 1], rows[system, 1_000]
        for method in [name.removeprefix("plain ") for name in alone if name.startswith("plain ")]:
            names = f"projected {method}", f"plain {method}"
            columns = ((alone, "ns"), (many, "ns"), (alone, "compile_seconds"))
            ratios = (of[names[0]][key] / of[names[1]][key] for of, key in columns)
            cells = " | ".join(f"{x:.1f}" for x in ratios)
            lines.append(f"| {integrals} | {numbers} | {system} | {method} | {cells} |")
    return lines


def many_table(results: Results) -> list[str]:
    """A step with many constraints, plain and projected, and the memory of a solve."""
    heads = ("", "plain step, ms", "projected over plain", "memory, plain", "memory, projected")
    lines = [f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
    for row in results["many_constraints"]["rows"]:
        plain, projected = (row[f"{kind} s/step"] for kind in ("plain", "projected"))
        memory = [f"{row[f'{kind} memory/state']:.0f}" for kind in ("plain", "projected")]
        cells = [row["problem"], f"{1e3 * plain:.3g}", f"{projected / plain:.1f}", *memory]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def dae_table(results: Results) -> list[str]:
    """Radau beside IDA at a tolerance of 1e-6."""
    heads = "problem | error | steps | ms | constraints"
    lines = [f"| {heads} | IDA: error | evaluations | constraints |", "|" + "---|" * 8]
    for name, rows in results["dae"]["problems"].items():
        ours, ida = next((x["ours"], x["ida"]) for x in rows if x["rtol"] == 1e-6)
        cells = [name, f"{ours['error']:.0e}", f"{ours['work']:,}", f"{1e3 * ours['seconds']:.1f}"]
        cells += [f"{ours['constraints']:.0e}", f"{ida['error']:.0e}", f"{ida['work']:,}"]
        lines.append(f"| {' | '.join(cells)} | {ida['constraints']:.0e} |")
    return lines


def large_table(results: Results) -> list[str]:
    """Large stiff equations beside IDA, at equal error."""
    heads = (
        "problem | unknowns | steps | seconds | those of IDA | ratio | first call, s | memory, MB"
    )
    lines = [f"| {heads} |", "|" + "---|" * 8]
    for name, found in results["large"]["results"].items():
        radau = found["radau"]
        nearest = min(
            range(len(radau["errors"])), key=lambda k: abs(math.log(radau["errors"][k] / 1e-5))
        )
        steps = radau["accepted"][nearest] + radau["rejected"][nearest]
        cells = [name.split(",")[0], f"{found['n']:,}", f"{steps:,}", f"{radau['at_error']:.2g}"]
        cells += [f"{found['ida']:.2g}", f"{found['ratio']:.1f}", f"{found['first_call']:.0f}"]
        lines.append(f"| {' | '.join(cells)} | {found['memory'] / 1e6:.0f} |")
    return lines


def first_call_table(results: Results) -> list[str]:
    """The first call of ten systems, and what the option of the compiler does to both times."""
    heads = "system | plain, s | projected, s | over plain | with the option, s | run time with it"
    lines = [f"| {heads} |", "|" + "---|" * 6]
    rows = results["compiler_option"]["systems"]
    kinds = ("plain", "projected", "with the option")
    found = []
    for name, row in rows.items():
        plain, kept, quick = (row[kind]["first"] for kind in kinds)
        slower = row["with the option"]["seconds"] / row["projected"]["seconds"]
        found.append((plain, kept, kept / plain, quick, slower))
        lines.append(f"| {name.replace('-', ' ')} | {_cells(found[-1])} |")
    middle = [statistics.median(column) for column in zip(*found, strict=True)]
    return [*lines, f"| median | {_cells(middle)} |"]


def _cells(numbers: Iterable[float]) -> str:
    return " | ".join(f"{x:.1f}" for x in numbers)


def machine_lines(results: Results) -> list[str]:
    """One line: what `scaling.py` ran on, and when it began."""
    about = results["scaling"]["machine"]
    packages = ", ".join(f"{name} {about['versions'][name]}" for name in ("jax", "diffrax"))
    device = "" if about["device"] == "cpu" else f", {about['device']}"
    return [
        f"{about['cpu']}, {about['cores']} cores{device}, {about['precision']}; Python "
        f"{about['python']}, {packages}; {about['date'][:10]}; load {about['load']}."
    ]


def tables(results: Results) -> dict[str, list[str]]:
    """By the name in the markers of the pages."""
    return {
        "by integrals": integrals_table(results),
        "machine": machine_lines(results),
        "many constraints": many_table(results),
        "beside IDA": dae_table(results),
        "large beside IDA": large_table(results),
        "first call": first_call_table(results),
    }


def filled(text: str, results: Results) -> str:
    """The text of a page with the current tables."""
    return measuring.filled(text, tables(results))


# ---- The figures ----


def draw_batches(results: Results) -> Figure:
    """The time of a step against the size of the batch; plain solves are dashed."""
    figure = Figure()
    ax = figure.subplots()
    rows = results["scaling"]["parts"]["batch"]
    for method, colour in (("RK4", "#CC79A7"), ("Tsit5", "#D55E00")):
        for kind, line in (("plain", "--"), ("projected", "-")):
            name = f"{kind} {method}"
            x, y = zip(*((r["batch"], r["rows"][name]["ns"]) for r in rows), strict=True)
            ax.loglog(x, y, line, marker="o", color=colour, label=name)
    ax.set(xlabel="trajectories", ylabel="ns per step and trajectory")
    runpy.run_path(str(DOCS / "drawing.py"))["label"](ax)
    return figure


def draw_dae(results: Results) -> Figure:
    """The errors of Radau and IDA against their time."""
    figure = Figure(figsize=(9.6, 5.4))
    problems = results["dae"]["problems"]
    for ax, (name, rows) in zip(figure.subplots(2, 3).flat, problems.items(), strict=True):
        for key, label in (("ours", "DAE and Radau"), ("ida", "IDA, from Python")):
            found = [row[key] for row in rows if row[key]]
            x, y = zip(*((1e3 * z["seconds"], z["error"]) for z in found), strict=True)
            ax.loglog(x, y, "o-", markersize=4, label=label)
        ax.set(title=name, xlabel="ms", ylabel="error")
        ax.xaxis.set_major_locator(LogLocator(subs=(1, 3)))
        ax.xaxis.set_major_formatter("{x:g}")
        ax.xaxis.set_minor_formatter("")
    figure.axes[0].legend(fontsize=8)
    return figure


FIGURES = {"scaling": draw_batches, "dae": draw_dae}


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--write", action="store_true", help="the tables and figures of the pages")
    options = parser.parse_args(argv)
    results = read_results()
    for name, lines in tables(results).items():
        print("\n".join([name, "", *lines, ""]))
    if options.write:
        for page in PAGES:
            page.write_text(filled(page.read_text(encoding="utf-8"), results), encoding="utf-8")
        with mpl.rc_context(fname=DOCS / "figures.mplstyle"):
            for name, draw in FIGURES.items():
                path = DOCS / "images" / f"{name}.svg"
                draw(results).savefig(path, metadata={"Date": None})


if __name__ == "__main__":
    main()
