"""What a new interpreter, without the settings of the tests, says of the package.

One answers all questions, as each takes seconds to start.
"""

import functools
import json
import os
import subprocess
import sys

CODE = """
import json, sys
import diffrax, diffrax_conserve
modules, messages = list(sys.modules), len(diffrax.RESULTS._index_to_message)
from tests.solver.test_sweeps import work_with_a_heavy_field
found = {"modules": modules, "messages": messages}
print(json.dumps(found | {"flops": work_with_a_heavy_field()}))
"""


@functools.cache
def interpreter() -> dict:
    # All passes over the program, unlike in the tests, but none over the machine code.
    flags = [flag for flag in os.environ["XLA_FLAGS"].split() if "disable_hlo_passes" not in flag]
    environment = {**os.environ, "XLA_FLAGS": " ".join(flags), "JAX_ENABLE_X64": "1"}
    done = subprocess.run(
        [sys.executable, "-c", CODE], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)
