"""Runs the attacks, unattended (`make soak COUNT=... SEED=...`): exit status 1 if any is wrong.

A program is one static choice of an attack, compiled once for many lanes of numbers. It draws from
`(seed, program)` alone, and runs in an interpreter of its own, so that one that crashes or never
ends is found wrong, and the rest goes on. What has finished is kept in a file: a run that was
interrupted continues where it was, as long as the package is the same.

    python -m tests.soak --count 1000000                    # all attacks
    python -m tests.soak --attack far --count 1000000       # one of them
    python -m tests.soak --attack far --program 17          # one program again, with its lanes
"""

import argparse
import collections
import contextlib
import functools
import hashlib
import importlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

from .oracle import Tally

ROOT = Path(__file__).parents[2]
# How much of the count is for each attack.
SHARES = {"far": 0.5, "ordinary": 0.25, "nan": 0.25}
GRACE = 60.0  # seconds for an interpreter to start


class Job(NamedTuple):
    attack: str
    number: int
    lanes: int
    seed: int


def module_of(attack: str) -> Any:
    return importlib.import_module(f"{__package__}.{attack}")


@functools.cache
def package_hash() -> str:
    files = sorted((ROOT / "diffrax_conserve").rglob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:12]


def jobs_of(options: argparse.Namespace) -> list[Job]:
    """In turn, so that a run which is cut short has tried every attack."""
    attacks = options.attack or list(SHARES)
    whole = sum(SHARES[a] for a in attacks)
    jobs = []
    for i, attack in enumerate(attacks):
        lanes = options.lanes or module_of(attack).LANES
        programs = max(1, round(options.count * SHARES[attack] / whole / lanes))
        numbers = range(programs) if options.program is None else [options.program]
        jobs += [(n / programs, i, Job(attack, n, lanes, options.seed)) for n in numbers]
    return [job for *_, job in sorted(jobs, key=lambda entry: entry[:2])]


def command_of(job: Job) -> list[str]:
    return [sys.executable, "-m", __package__, "--worker", json.dumps(job)]


def run_job(job: Job) -> Tally:
    timeout = module_of(job.attack).TIMEOUT + GRACE
    defaults = {"JAX_PLATFORMS": "cpu", "JAX_ENABLE_X64": "1"}
    try:
        done = subprocess.run(
            command_of(job),
            cwd=ROOT,
            env=defaults | os.environ,
            timeout=timeout,
            capture_output=True,
        )
        if done.returncode == 0:
            return Tally(**json.loads(done.stdout.splitlines()[-1]))
        why, tail = "crashed", done.stderr[-2000:].decode(errors="replace")
    except subprocess.TimeoutExpired:
        why, tail = f"not ended after {timeout} s", ""
    return Tally(job.lanes, 0, {why: 1}, {}, [f"{why}: {tail}"])


def summary(tallies: dict[str, list[Tally]]) -> bool:
    """Prints the table; whether nothing is wrong."""
    print(f"\n{'attack':14}{'programs':>9}{'tried':>10}{'success':>10}{'wrong':>9}")
    right = True
    for attack, found in tallies.items():
        wrong = sum((collections.Counter(t.wrong) for t in found), collections.Counter())
        notes = sum((collections.Counter(t.notes) for t in found), collections.Counter())
        tried, success = sum(t.tried for t in found), sum(t.success for t in found)
        print(f"{attack:14}{len(found):9}{tried:10}{success:10}{sum(wrong.values()):9}")
        for why, count in [*sorted(wrong.items()), *sorted(notes.items())]:
            print(f"    {'WRONG' if why in wrong else 'note'}: {why}: {count}")
        right = right and not wrong
    return right


def finished(state: Path) -> dict[tuple, Tally]:
    done = {}
    for line in state.read_text().splitlines() if state.exists() else ():
        # The last one may have been cut off.
        with contextlib.suppress(json.JSONDecodeError):
            record = json.loads(line)
            done[tuple(record["key"])] = Tally(**record["tally"])
    return done


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--count", type=int, default=10_000, help="lanes in all")
    parser.add_argument("--attack", action="append", choices=SHARES, help="only these")
    parser.add_argument("--lanes", type=int, help="lanes per program")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--program", type=int, help="run this one only, and show what is wrong")
    parser.add_argument("--state", type=Path, default=ROOT / "out" / "soak.jsonl")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:  # in its own interpreter
        job = Job(*json.loads(options.worker))
        print(json.dumps(vars(module_of(job.attack).run(job.seed, job.number, job.lanes))))
        return
    options.state.parent.mkdir(parents=True, exist_ok=True)
    done = finished(options.state) if options.program is None else {}
    tallies: dict[str, list[Tally]] = {}
    begin = time.monotonic()
    for job in jobs_of(options):
        key = (package_hash(), *job)
        tally = done.get(key) or run_job(job)
        tallies.setdefault(job.attack, []).append(tally)
        if key in done:
            continue
        with options.state.open("a") as file:
            file.write(json.dumps({"key": key, "tally": vars(tally)}) + "\n")
        print(
            f"{time.monotonic() - begin:7.0f} s  {job.attack} {job.number}: {tally.success} of "
            f"{tally.tried} succeeded, {sum(tally.wrong.values())} wrong",
            flush=True,
        )
        for example in tally.examples:
            again = f"--attack {job.attack} --program {job.number} --seed {job.seed}"
            print(f"    WRONG {example}\n    again: {again} --lanes {job.lanes}", flush=True)
    sys.exit(not summary(tallies))


if __name__ == "__main__":
    main()
