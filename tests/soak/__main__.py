"""Runs the attacks, unattended (`make soak COUNT=... SEED=...`): exit status 1 if any is wrong.

A program is one static choice of an attack, compiled once for many lanes of numbers; a lane is one
combination. It draws from `(seed, program)` alone. Programs run in workers, so that one that
crashes or never ends is found wrong, and the rest goes on. What has finished is kept in a file: a
run that was interrupted continues where it was, as long as the package is the same.

    python -m tests.soak --count 1000000                    # all attacks
    python -m tests.soak --attack far --count 1000000       # one of them
    python -m tests.soak --attack far --program 17          # one program again, with its lanes
"""

import argparse
import collections
import contextlib
import dataclasses
import functools
import hashlib
import importlib
import json
import os
import queue
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

from .oracle import Tally

ROOT = Path(__file__).parents[2]
# How much of the count is for each attack.
SHARES = {
    "combinations": 0.2,
    "far": 0.6,
    "gradients": 0.02,
    "nan": 0.15,
    "ending": 0.001,
}
# Most of the time goes into compilation, which takes half as long with XLA's older emitters.
OLDER_EMITTERS = "--xla_backend_extra_options=xla_cpu_disable_new_fusion_emitters"
GRACE = 60.0  # seconds for a worker to start
CHUNK = 6  # programs per worker: what is compiled takes memory


@dataclasses.dataclass
class Job:
    attack: str
    numbers: list[int]
    lanes: int
    timeout: float


def module_of(attack: str) -> Any:
    return importlib.import_module(f"{__package__}.{attack}")


@functools.cache
def package_hash() -> str:
    digest = hashlib.sha256()
    for path in sorted((ROOT / "diffrax_conserve").rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def jobs_of(options: argparse.Namespace) -> list[Job]:
    """In turn, so that a run which is cut short has tried every attack."""
    attacks = options.attack or list(SHARES)
    whole = sum(SHARES[a] for a in attacks)
    queues = []
    for attack in attacks:
        module = module_of(attack)
        lanes = options.lanes or module.LANES
        programs = max(1, round(options.count * SHARES[attack] / whole / lanes))
        numbers = list(range(options.first, options.first + programs))
        if options.program is not None:
            numbers = [options.program]
        chunks = [numbers[i : i + CHUNK] for i in range(0, len(numbers), CHUNK)]
        queues.append([Job(attack, chunk, lanes, module.TIMEOUT) for chunk in chunks])
    order = [(k / len(q), i, job) for i, q in enumerate(queues) for k, job in enumerate(q)]
    return [job for *_, job in sorted(order, key=lambda entry: entry[:2])]


def work(options: argparse.Namespace) -> None:
    """The worker: a line of JSON for each program."""
    import jax

    jax.config.update("jax_enable_x64", True)
    module = module_of(options.attack[0])
    for number in map(int, options.worker.split(",")):
        tally = module.run(options.seed, number, options.lanes)
        print("TALLY " + json.dumps({"number": number, **vars(tally)}), flush=True)


def command_of(job: Job, numbers: list[int], seed: int) -> list[str]:
    worker = ["--worker", ",".join(map(str, numbers)), "--lanes", str(job.lanes)]
    return [
        sys.executable,
        "-m",
        "tests.soak",
        "--attack",
        job.attack,
        "--seed",
        str(seed),
        *worker,
    ]


def run_job(job: Job, seed: int) -> Any:
    """Yields each program's number and tally; starts again after one that hangs or crashes."""
    left = list(job.numbers)
    while left:
        worker = subprocess.Popen(
            command_of(job, left, seed),
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={"JAX_PLATFORMS": "cpu", "XLA_FLAGS": OLDER_EMITTERS, **os.environ},
        )
        lines: queue.Queue = queue.Queue()
        threading.Thread(target=feed, args=(worker, lines), daemon=True).start()
        tail: collections.deque = collections.deque(maxlen=12)
        deadline, why = time.monotonic() + job.timeout + GRACE, "crashed"
        while left:
            try:
                line = lines.get(timeout=max(deadline - time.monotonic(), 0.01))
            except queue.Empty:
                why = f"not ended after {job.timeout} s"
                break
            if line is None:
                break
            if not line.startswith("TALLY "):
                tail.append(line)
                continue
            record = json.loads(line.removeprefix("TALLY "))
            number = record.pop("number")
            left.remove(number)
            deadline = time.monotonic() + job.timeout
            yield number, Tally(**record)
        worker.kill()
        worker.wait()
        if left:
            yield (
                left.pop(0),
                Tally(job.lanes, 0, {why: 1}, {}, [why + ": " + "".join(tail)[-2000:]]),
            )


def feed(worker: Any, lines: queue.Queue) -> None:
    for line in worker.stdout:
        lines.put(line)
    lines.put(None)


def summary(tallies: dict[str, list[Tally]]) -> bool:
    """Prints the table; whether nothing is wrong."""
    print(f"\n{'attack':14}{'programs':>9}{'tried':>10}{'success':>10}{'wrong':>9}")
    right = True
    for attack, found in tallies.items():
        wrong, notes = collections.Counter(), collections.Counter()
        for tally in found:
            wrong.update(tally.wrong)
            notes.update(tally.notes)
        tried, success = sum(t.tried for t in found), sum(t.success for t in found)
        print(f"{attack:14}{len(found):9}{tried:10}{success:10}{sum(wrong.values()):9}")
        for words, counter in (("WRONG", wrong), ("note", notes)):
            for why, count in sorted(counter.items()):
                print(f"    {words}: {why}: {count}")
        right = right and not wrong
    return right


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--count", type=int, default=10_000, help="combinations in all")
    parser.add_argument("--attack", action="append", choices=SHARES, help="only these")
    parser.add_argument("--lanes", type=int, help="combinations per program")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="the first program of each attack")
    parser.add_argument("--program", type=int, help="run this one only, and show what is wrong")
    parser.add_argument("--state", type=Path, default=ROOT / "out" / "soak.jsonl")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        work(options)
        return
    options.state.parent.mkdir(parents=True, exist_ok=True)
    done: dict[tuple, Tally] = {}
    if options.state.exists() and options.program is None:
        for line in options.state.read_text().splitlines():
            # The last one may have been cut off.
            with contextlib.suppress(json.JSONDecodeError):
                record = json.loads(line)
                done[tuple(record["key"])] = Tally(**record["tally"])
    tallies: dict[str, list[Tally]] = {}
    begin = time.monotonic()
    for job in jobs_of(options):
        found = tallies.setdefault(job.attack, [])
        prefix = (package_hash(), options.seed, job.attack, job.lanes)
        found += [done[*prefix, n] for n in job.numbers if (*prefix, n) in done]
        job.numbers = [n for n in job.numbers if (*prefix, n) not in done]
        for number, tally in run_job(job, options.seed):
            found.append(tally)
            with options.state.open("a") as file:
                entry = {"key": [*prefix, number], "tally": vars(tally)}
                file.write(json.dumps(entry) + "\n")
            print(
                f"{time.monotonic() - begin:7.0f} s  {job.attack} {number}: {tally.success} of "
                f"{tally.tried} succeeded, {sum(tally.wrong.values())} wrong",
                flush=True,
            )
            for example in tally.examples:
                print(f"    WRONG {example}")
            if tally.wrong:
                print(
                    f"    again: python -m tests.soak --attack {job.attack} --program {number} "
                    f"--seed {options.seed} --lanes {job.lanes}",
                    flush=True,
                )
    sys.exit(not summary(tallies))


if __name__ == "__main__":
    main()
