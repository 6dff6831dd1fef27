"""Attack: a failure is to name its own constraint in another process, and in eight threads.

One process solves and pickles what has failed; another, which has traced other manifolds first,
reads it. Both lower the same program, which is to be the same text, or a persistent cache of
compiled programs would not find it.
"""

import hashlib
import json
import os
import pickle
import subprocess
import sys
import tempfile
import threading
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from .oracle import Tally

LANES, TIMEOUT, THREADS = 10, 300, 8
ROOT = Path(__file__).parents[2]


def place(name: str) -> int:
    """Which entry of its manifold cannot hold in the solve called `name`."""
    return zlib.crc32(name.encode()) % 2


def expected(name: str) -> str:
    return f"entry {place(name)} of the manifold"


def failing(name: str) -> Any:
    """A solve one of whose constraints cannot hold."""
    import diffrax as dfx
    import jax.numpy as jnp

    import diffrax_conserve as dfc

    def solve(y0: Any) -> Any:
        entry = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2) * jnp.where(t > 0, -1.0, 1.0))
        always = dfc.FirstIntegral(lambda t, y, args: jnp.ones(()))
        manifold = (always, entry) if place(name) else (entry, always)
        return dfx.diffeqsolve(
            dfx.ODETerm(lambda t, y, args: -y),
            dfc.ManifoldProjection(dfx.Euler(), manifold),
            0.0,
            1.0,
            0.1,
            y0,
            throw=False,
        )

    return solve


def message(solution: Any) -> str:
    import diffrax as dfx

    return str(dfx.RESULTS[solution.result])


def child(path: str, others: list[str], target: str) -> None:
    """Traces the others first; writes the pickle at `path`, or reads it where there is one."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    y0 = jnp.array([1.0, 2.0])
    for other in others:
        jax.eval_shape(lambda y, other=other: failing(other)(y).ys, y0)
    text = jax.jit(lambda y: failing(target)(y).ys).lower(y0).as_text()
    found = {"text": hashlib.sha256(text.encode()).hexdigest(), "threads": {}}
    if not Path(path).exists():
        found["here"] = message(solution := failing(target)(y0))
        Path(path).write_bytes(pickle.dumps(solution))
    else:
        found["here"] = message(pickle.loads(Path(path).read_bytes()))
        start = threading.Barrier(THREADS)

        def trace(name: str) -> None:
            start.wait()
            try:
                found["threads"][name] = message(failing(name)(y0))
            except Exception as error:
                found["threads"][name] = repr(error)

        names = [f"{target}_thread{k}_" for k in range(THREADS)]
        threads = [threading.Thread(target=trace, args=(name,)) for name in names]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    print("FOUND " + json.dumps(found))


def spawn(*args: str) -> dict[str, Any]:
    command = [sys.executable, "-m", "tests.soak.processes", *args]
    done = subprocess.run(command, cwd=ROOT, env=os.environ, capture_output=True, text=True)
    for line in done.stdout.splitlines():
        if line.startswith("FOUND "):
            return json.loads(line.removeprefix("FOUND "))
    return {"text": None, "here": done.stderr[-500:], "threads": {}}


def run(seed: int, number: int, lanes: int) -> Tally:
    rng = np.random.default_rng([seed, number])
    target = f"target{rng.integers(10**6)}_"
    tally = Tally(THREADS + 2)
    with tempfile.TemporaryDirectory() as folder:
        found = []
        few = int(rng.integers(0, 3))
        for place, count in (("a", few), ("b", few + int(rng.integers(1, 4)))):
            others = [f"{place}{k}" for k in range(count)]
            found.append(spawn(str(Path(folder) / "solution"), json.dumps(others), target))
    first, second = found
    tally.success = sum(expected(target) in m for m in [first["here"], second["here"]])
    tally.blame(
        "pickled: another name", expected(target) not in second["here"], lambda i: f"{found}"
    )
    tally.blame("a program that depends on what was traced before", first["text"] != second["text"])
    tally.blame(
        "threads: another name",
        [
            expected(name) not in second["threads"].get(name, "")
            for name in sorted(second["threads"])
        ]
        if len(second["threads"]) == THREADS
        else [True] * THREADS,
        lambda i: f"{second['threads']}",
    )
    return tally


if __name__ == "__main__":
    child(sys.argv[1], json.loads(sys.argv[2]), sys.argv[3])
