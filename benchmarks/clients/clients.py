"""Published packages with one solver exchanged: what a projection costs and gains there.

python benchmarks/clients/clients.py             # measures each that is installed, minutes
python benchmarks/clients/clients.py --only NAME
python benchmarks/clients/clients.py --write     # puts the table on its page

Each problem is a file beside this one, and runs in a process of its own.
"""

import argparse
import contextlib
import importlib
import importlib.util
import io
import json
import re
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path += [str(HERE), str(HERE.parent / "cost")]
import measuring  # noqa: E402

RESULTS = measuring.RESULTS / "clients.json"
PAGES = [HERE.parents[1] / "docs" / "in-your-code.md"]
# The files, in the order of the table, and the packages that they import.
PACKAGES = {
    "galactic_orbit": "galax",
    "guiding_centre": "essos",
    "robot": "soromox",
    "epidemic": "stochastix",
    "flow_on_sphere": "bijx",
    "quantum_state": "dynamiqs",
    "density_matrix": "jaxquantum",
}
HEADS = ("package", "problem", "error", "drift", "cost", "first call", "`compare` says")


def measure(name, smoke):
    """The row of one problem: through the package, without projection and with it."""

    client = importlib.import_module(name).client(smoke)
    reference = client.reference()
    solvers = {"plain": client.solver, "kept": client.kept()}
    runs = {key: client.run(solver, client.tolerance) for key, solver in solvers.items()}
    first = {key: measuring.timed(run) for key, run in runs.items()}
    # One after the other: dynamiqs forgets what it compiled when the solver changes.
    again = {}
    for key, run in runs.items():
        run()
        again.update(measuring.take_turns({key: run}, 2 if smoke else 7))
    row = dict(package=client.package, problem=client.problem)
    row["version"] = measuring.version(client.package)
    for key in runs:
        row[key] = dict(
            error=client.error(first[key].answer, reference),
            drift=client.drift(first[key].answer),
            first=first[key].seconds,
            seconds=again[key].seconds,
        )
    return row


def compared(name, smoke):
    """What `compare` prints and recommends for one problem, which compiles for minutes."""
    import diffrax_conserve as dfc

    client = importlib.import_module(name).client(smoke)
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        report = dfc.compare(
            client.field, client.solver, client.manifold, client.y0, t1=float(client.ts[-1]),
            rtol=client.tolerance, atol=client.tolerance, args=client.args,
            projection=client.projection,
        )  # fmt: skip
    return dict(verdict=report.verdict, printed=printed.getvalue())


def installed(name):
    return importlib.util.find_spec(PACKAGES[name]) is not None


def apart(part, name, smoke):
    """`measure` or `compared`, in a process of its own."""
    options = ["--smoke"] if smoke else []
    command = [sys.executable, __file__, "--part", part, name, *options]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def read_results():
    return json.loads(RESULTS.read_text())


def ratio(row, key):
    return f"{row['kept'][key] / row['plain'][key]:.1f}"


def both(row, key):
    return f"{row['plain'][key]:.0e} → {row['kept'][key]:.0e}"


def says(verdict):
    """What `compare` recommends in few words, and the error of that over plain, as it judges it."""
    chosen, times = (
        re.search(r"`(.*?)`", verdict),
        re.search(r"error is ([\d.e+-]+) times", verdict),
    )
    beside = f", error × {times[1]}" if times else ""
    if verdict.startswith("Do not"):
        return f"do not{beside}"
    if verdict.startswith("Projecting changes"):
        return f"{chosen[1]}, for what it keeps{beside}"
    return f"{chosen[1]}{beside}" if verdict.startswith("Take `") else verdict


def tables(results):
    rows = [results["rows"][name] for name in PACKAGES if name in results["rows"]]
    cells = [
        (
            *(f"{x['package']} {x['version']}", x["problem"], both(x, "error"), both(x, "drift")),
            *(ratio(x, "seconds"), ratio(x, "first"), says(x.get("verdict", ""))),
        )
        for x in rows
    ]
    lines = [HEADS, ("---",) * len(HEADS), *cells]
    return {"clients": ["", *(f"| {' | '.join(line)} |" for line in lines), ""]}


def filled(text, results):
    return measuring.filled(text, tables(results))


def run_all(options):
    """All costs first, because the comparisons take long; what is done is kept."""
    rows = read_results()["rows"] if RESULTS.exists() else {}
    names = [name for name in PACKAGES if options.only in name]
    for name in names:
        if not installed(name):
            print(f"{name}: {PACKAGES[name]} is not installed")
    for part in ("measure", "compared"):
        for name in filter(installed, names):
            rows[name] = rows.get(name, {}) | apart(part, name, options.smoke)
            print(json.dumps(rows[name], indent=1), flush=True)
            if not options.smoke:
                about = measuring.machine(*PACKAGES.values())
                RESULTS.write_text(json.dumps(dict(machine=about, rows=rows), indent=1) + "\n")


def main():
    parser = measuring.parser(__doc__, "clients")
    parser.add_argument("--part", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--write", action="store_true", help="put the table on the page")
    options = parser.parse_args()
    if options.part:
        part, name = options.part
        print(json.dumps(dict(measure=measure, compared=compared)[part](name, options.smoke)))
        return
    if not options.write:
        run_all(options)
        return
    for page in PAGES:
        page.write_text(filled(page.read_text(encoding="utf-8"), read_results()), encoding="utf-8")


if __name__ == "__main__":
    main()
