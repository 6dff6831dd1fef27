"""From the results of `make bench`: what was reached, the tables of the documentation,
and the figures of the page on performance.

Prints the table of what was meant to be reached; `--write` puts every table between its two markers
and redraws the figures. A test holds the tables of the pages to the results.
"""

import argparse
import re
import statistics
from pathlib import Path
from typing import Any, NamedTuple

import figures
import measuring

ROOT = measuring.HERE.parent.parent
DOCS = ROOT / "docs"
PAGES = [
    DOCS / "performance.md",
    DOCS / "many-constraints.md",
    measuring.RESULTS.parent / "README.md",
]
UNROLLED = ", unrolled"
NAMES = ("overhead", "gradients", "work_precision", "scaling", "many_constraints")

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


# ---- What was meant to be reached ----


class Goal(NamedTuple):
    """`measured` is to be at most `target`, or at least, if `most` is false."""

    what: str
    target: float
    measured: float | None
    most: bool = True

    @property
    def reached(self) -> bool:
        if self.measured is None:
            return False
        return self.measured <= self.target if self.most else self.measured >= self.target


def goals(results: Results) -> list[Goal]:
    default = [
        goal._replace(what=f"{goal.what}, by default flags of XLA")
        for goal in overhead_goals(results, DEFAULT_FLAGS)
        if "one trajectory" in goal.what
    ]
    return [
        *overhead_goals(results, "overhead"),
        *default,
        *precision_goals(results),
        *other_goals(results),
    ]


def overhead_goals(results: Results, name: str) -> list[Goal]:
    ratios = {
        (table["system"], table["method"], table["batch"]): table["ratios"]
        for table in results[name]["tables"]
    }

    def ratio(what: str, system: str, method: str, batch: int) -> float | None:
        return ratios.get((system, method, batch), {}).get(what)

    against_c = [
        Goal(
            f"projected RK4 / the same in C, rigid body, {trajectories(batch)}",
            target,
            ratio("projected / C", "rigid-body", "RK4", batch),
        )
        for batch, target in ((1, 4), (1_000, 3), (100_000, 3))
    ]
    against_c.append(
        Goal(
            "the same in a batch of 100,000, solved by thousands (jax.lax.map)",
            3,
            ratio("projected, by thousands / C", "rigid-body", "RK4", 100_000),
        )
    )
    against_plain = [
        Goal(
            f"projected / plain, Tsit5 adaptive, {system}, one trajectory",
            1.6,
            ratio("projected / plain", system, "Tsit5 adaptive", 1),
        )
        for system in ("rigid-body", "three-vortices")
    ]
    ten = ratio("projected / plain", "ten-vortices", "RK4", 1_000)
    by_hand = [
        Goal(
            f"root finder by hand / projected, RK4, {system}, batch of 1,000",
            10,
            ratio("root_find by hand / projected", system, "RK4", 1_000),
            most=False,
        )
        for system in ("rigid-body", "three-vortices", "ten-vortices")
    ]
    compilation = [x["compilation, projected / plain"] for x in ratios.values()]
    return [
        *against_c,
        *against_plain,
        Goal("projected / plain, RK4, ten vortices, four integrals, batch of 1,000", 1.5, ten),
        *by_hand,
        Goal("compilation, projected / plain: median", 1.5, statistics.median(compilation)),
        Goal("compilation, projected / plain: largest", 1.5, max(compilation)),
    ]


def trajectories(batch: int) -> str:
    return "one trajectory" if batch == 1 else f"batch of {batch:,}"


def precision_goals(results: Results) -> list[Goal]:
    parts = results["work_precision"]["parts"]
    rigid = parts["rigid-body"]["times"]
    projected = rigid["projected Tsit5"]["error and drift"]
    batch = parts["batch"]["times"]
    unrolled = rigid[f"projected Tsit5{UNROLLED}"]["error and drift"]
    cvode = least(rigid, "CVODE, BDF", "error and drift")
    unlike = parts["unlike"]
    best_batch = "batch of 1,000 to error 1e-9 and drift 1e-14: our best"
    theirs = least(batch, "heyoka", "error and drift")
    packaged = {name: x for name, x in batch.items() if not name.endswith(UNROLLED)}
    to_error = "time to error 1e-6 and drift 1e-14: projected Tsit5"
    plain = rigid["plain Tsit5"]["error"]
    return [
        Goal(f"{to_error} / plain Tsit5 (error alone)", 0.6, quotient(projected, plain)),
        Goal(f"{to_error}{UNROLLED} / the same", 0.6, quotient(unrolled, plain)),
        Goal(f"{to_error} / CVODE's BDF with projection", 0.2, quotient(projected, cvode)),
        Goal(f"{to_error}{UNROLLED} / the same", 0.2, quotient(unrolled, cvode)),
        Goal(
            f"{best_batch} / heyoka's best",
            2,
            quotient(least(packaged, "projected", "error and drift"), theirs),
        ),
        Goal(
            f"{best_batch}{UNROLLED} / heyoka's best",
            2,
            quotient(least(batch, "projected", "error and drift"), theirs),
        ),
        Goal(
            "unlike Kepler orbits: a lane of the adaptive batch / the mean lane alone",
            3,
            unlike["projected"]["batch"] / unlike["projected"]["alone"],
        ),
    ]


def least(times: dict[str, dict[str, Any]], prefix: str, quantity: str) -> float | None:
    """The shortest time of those whose name starts with `prefix`."""
    found = [x[quantity] for name, x in times.items() if name.startswith(prefix)]
    return min((x for x in found if x is not None), default=None)


def quotient(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else a / b


def other_goals(results: Results) -> list[Goal]:
    bodies = {row["bodies"]: row for row in results["scaling"]["parts"]["bodies"]}[10_000]
    pair = "10,000 bodies: projection / one evaluation of the pairwise forces"
    return [
        Goal(
            "gradient, projected / plain: largest",
            2.5,
            max(row["ratio"] for row in results["gradients"]["rows"]),
        ),
        Goal(f"{pair}, all ten integrals", 0.05, bodies["projection / force"]),
        Goal(f"{pair}, without the energy", 0.05, bodies["without energy / force"]),
    ]


def goal_table(results: Results) -> list[str]:
    lines = ["| what | goal | measured | |", "|---|---|---|---|"]
    for goal in goals(results):
        measured = "not measured" if goal.measured is None else number(goal.measured)
        sign = "at most" if goal.most else "at least"
        verdict = "reached" if goal.reached else "missed"
        lines.append(f"| {goal.what} | {sign} {goal.target:g} | {measured} | {verdict} |")
    return lines


# ---- The other tables ----


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
        "goals": goal_table(results),
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
    print("\n".join([*machine_lines(results), "", *goal_table(results)]))
    if options.write:
        for page in PAGES:
            page.write_text(filled(page.read_text(encoding="utf-8"), results), encoding="utf-8")
        write_figures(results, ROOT / "docs" / "images")


def write_figures(results: Results, folder: Path) -> None:
    figures.save(figures.work_precision(results["work_precision"]), folder / "work-precision")
    figures.save(figures.scaling(results["scaling"]), folder / "scaling")


if __name__ == "__main__":
    main()
