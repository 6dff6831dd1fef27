"""From the results of `make bench`: the tables of the documentation, and the figures of the page on
performance.

Prints the tables; `--write` puts each between its two markers and redraws the figures. A test holds
the tables of the pages to the results.
"""

import argparse
import re
from pathlib import Path
from typing import Any

import figures
import measuring

ROOT = measuring.HERE.parent.parent
DOCS = ROOT / "docs"
PAGES = [
    DOCS / "performance.md",
    DOCS / "many-constraints.md",
    measuring.RESULTS.parent / "README.md",
]
NAMES = ("overhead", "work_precision", "scaling", "many_constraints")

# One trajectory without the option of XLA that the documentation recommends.
DEFAULT_FLAGS = "overhead-default-flags"

# Of each system: what is kept, the integrals, and the numbers in its state.
SIZES = {
    "rigid-body": ("rigid body", 2, 3),
    "three-vortices": ("three vortices", 4, 6),
    "ten-vortices": ("ten vortices", 4, 20),
    "outer-solar-system": ("outer solar system", 10, 36),
}

Results = dict[str, dict[str, Any]]


def read_results() -> Results:
    return {name: measuring.read(name) for name in (*NAMES, DEFAULT_FLAGS)}


# ---- Tables ----


def number(x: float | None) -> str:
    if x is None:
        return ""
    digits = 0 if x >= 100 else 1 if x >= 10 else 2 if x >= 0.1 else 4
    return f"{x:,.{digits}f}"


def overhead_table(results: Results, name: str = "overhead") -> list[str]:
    names = ("plain", "projected", "root_find by hand", "plain, C", "projected, C")
    lines = [
        "| system, solver | trajectories | plain | projected | by hand | plain C | projected C |",
        "|---|---|---|---|---|---|---|",
    ]
    for table in results[name]["tables"]:
        ns = [number(table["rows"].get(name, {}).get("ns")) for name in names]
        cells = [f"{table['system']}, {table['method']}", f"{table['batch']:,}", *ns]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def integrals_table(results: Results) -> list[str]:
    """Projected over plain, by the number of integrals: the times of a step, alone and in a batch,
    and the time of compilation, alone."""
    tables = results["overhead"]["tables"]
    found = {(t["system"], t["method"], t["batch"]): t["ratios"] for t in tables}
    heads = ("integrals", "numbers in the state", "system", "method")
    heads = (*heads, "alone", "batch of 1,000", "compilation")
    lines = [f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
    for system, (name, integrals, numbers) in SIZES.items():
        for method in ("RK4", "Tsit5 adaptive"):
            one, many = (found.get((system, method, batch), {}) for batch in (1, 1_000))
            if one or many:
                times = [x.get("projected / plain") for x in (one, many)]
                times.append(one.get("compilation, projected / plain"))
                cells = ["" if x is None else f"{x:.1f}" for x in times]
                head = [str(integrals), str(numbers), name, method]
                lines.append(f"| {' | '.join([*head, *cells])} |")
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


def times_table(results: Results, part: str) -> list[str]:
    found = results["work_precision"]["parts"][part]
    lines = [
        f"| program | ms to error {found['target']:.0e} | and drift below 1e-14 |",
        "|---|---|---|",
    ]
    for name, times in found["times"].items():
        cells = ["never" if x is None else number(1e3 * x) for x in times.values()]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def machine_lines(results: Results) -> list[str]:
    """One line: what `make bench` ran on, and when it began."""
    about = results["overhead"]["machine"]
    versions = about["versions"] | results["work_precision"]["machine"]["versions"]
    wanted = ("jax", "diffrax", "scipy", "homproj", "heyoka")
    packages = ", ".join(f"{name} {versions[name]}" for name in wanted if name in versions)
    device = "" if about["device"] == "cpu" else f", {about['device']}"
    return [
        f"{about['cpu']}, {about['cores']} cores{device}, {about['precision']}; Python "
        f"{about['python']}, {packages}; {about['date'][:10]}; load {about['load']}."
    ]


def tables(results: Results) -> dict[str, list[str]]:
    """By the name in the markers of the pages."""
    return {
        "by integrals": integrals_table(results),
        "overhead": overhead_table(results),
        "default flags": overhead_table(results, DEFAULT_FLAGS),
        "rigid body": times_table(results, "rigid-body"),
        "kepler": times_table(results, "kepler"),
        "batch": times_table(results, "batch"),
        "machine": machine_lines(results),
        "many constraints": many_table(results),
    }


def filled(text: str, results: Results) -> str:
    """The text of a page with the current tables."""
    for name, lines in tables(results).items():
        begin, end = f"<!-- begin: {name} -->", f"<!-- end: {name} -->"
        table = "\n".join(lines)
        pattern = f"{re.escape(begin)}.*?{re.escape(end)}"
        text = re.sub(pattern, lambda _, x=f"{begin}\n{table}\n{end}": x, text, flags=re.DOTALL)
    return text


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
        write_figures(results, ROOT / "docs" / "images")


def write_figures(results: Results, folder: Path) -> None:
    figures.save(figures.work_precision(results["work_precision"]), folder / "work-precision")
    figures.save(figures.scaling(results["scaling"]), folder / "scaling")


if __name__ == "__main__":
    main()
