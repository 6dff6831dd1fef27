"""The command line: `diffrax-conserve`, or `python -m diffrax_conserve`."""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

from .. import __version__, systems
from ._job import SetupError
from ._job import reproduce as _reproduce
from ._verdict import verdict

_NAMES = (*systems.names(), *systems.names(stiff=True))


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns its exit status: 0, or 1 if a solver failed.

    Wrong input raises `SystemExit` with status 2, after a message on standard error.
    """
    parser = _parser()
    options = parser.parse_args(argv)
    if options.command == "list":
        width = max(map(len, _NAMES))
        for name in _NAMES:
            print(f"{name:{width}}  {systems.get(name).title}")
        return 0
    # The references need float64, and drifts are compared with its roundoff.
    jax.config.update("jax_enable_x64", True)
    system = systems.get(options.name)
    try:
        if options.command == "compare":
            verdict(system, options)
            return 0
        if not options.train and (options.seed is not None or options.epochs is not None):
            raise SetupError("--seed and --epochs are options of --train: give --train too")
        if options.epochs is not None and options.epochs < 1:
            raise SetupError(f"--epochs must be positive, but is {options.epochs}")
        ok = _reproduce(
            system,
            options.out or Path("out", options.name),
            t1=system.t1 if options.t1 is None else options.t1,
            dt=system.dt if options.dt is None else options.dt,
            anew=options.train,
            seed=options.seed or 0,
            epochs=5000 if options.epochs is None else options.epochs,
        )
    except SetupError as error:
        parser.error(str(error))
    return 0 if ok else 1


def run() -> int:
    """Runs `main` and flushes standard output: what the installed command calls."""
    try:
        status = main()
        sys.stdout.flush()
    except OSError as error:
        # Python flushes standard output once more at exit, and that must not fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):  # a closed pipe is not an error
            place = "" if error.filename is None else f" {error.filename}"
            print(f"error: cannot write{place}: {error.strerror or error}", file=sys.stderr)
        return 1
    return status


def _parser() -> argparse.ArgumentParser:
    title = "Conservative solves of the systems in the catalogue."
    every = "list", "reproduce kepler --out out/kepler", "compare kepler"
    parser = argparse.ArgumentParser("diffrax-conserve", description=title, **_examples(*every))
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    commands.add_parser("list", help="list the systems by name", **_examples("list"))
    reproduce = commands.add_parser(
        "reproduce",
        help="compare solvers of a system, plain and projected",
        description=(
            "Compares RK4 with projected RK4, for stiff systems Kvaerno5 with projected Kvaerno5,\n"
            "and for the paper's five systems learned solvers too. Prints a table of errors and\n"
            "drifts, and writes figures and metrics.json."
        ),
        **_examples(
            "reproduce kepler",
            "reproduce kepler --t1 50 --dt 0.1 --out out/longer",
            "reproduce rigid-body --train --epochs 500 --seed 1",
        ),
    )
    compare = commands.add_parser(
        "compare",
        help="say whether a projection makes a solution of a system better",
        description=(
            "Solves without projection, with all entries of the manifold kept, and with each of\n"
            "them left out, in several metrics. Prints errors and drifts, and says what to take.\n"
            "The solver is RK4, with a tolerance Tsit5, and for stiff systems Kvaerno5."
        ),
        **_examples(
            "compare lotka-volterra",
            "compare rigid-body --tol 1e-6 --starts 8 --out out/verdict",
        ),
    )
    for command in (reproduce, compare):
        command.add_argument("name", metavar="NAME", choices=_NAMES, help="a system, see `list`")
        command.add_argument("--t1", type=float, metavar="T", help="final time; the first is 0")
    reproduce.add_argument("--out", type=Path, metavar="DIR", help="default: out/NAME")
    reproduce.add_argument(
        "--dt", type=float, metavar="H", help="length of a step, or of a saved one if stiff"
    )
    reproduce.add_argument("--train", action="store_true", help="train the networks again")
    reproduce.add_argument("--seed", type=int, metavar="N", help="of --train (default: 0)")
    reproduce.add_argument("--epochs", type=int, metavar="N", help="of --train (default: 5000)")
    compare.add_argument("--dt", type=float, metavar="H", help="length of fixed steps")
    compare.add_argument("--tol", type=float, metavar="X", help="tolerance of adaptive steps")
    compare.add_argument(
        "--starts", type=int, metavar="N", help="random initial states; default: that of the system"
    )
    compare.add_argument("--seed", type=int, metavar="N", default=0, help="of them (default: 0)")
    compare.add_argument("--out", type=Path, metavar="DIR", help="for a figure of the errors")
    return parser


def _examples(*calls: str) -> dict[str, Any]:
    """The options of a parser that shows these calls below its help."""
    text = "\n".join(["examples:", *(f"  diffrax-conserve {call}" for call in calls)])
    return dict(epilog=text, formatter_class=argparse.RawDescriptionHelpFormatter)
