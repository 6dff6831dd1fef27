"""Files with the right checksum and malformed contents: one clear `ValueError`, little memory."""

import copy
import hashlib
import json
import random
import subprocess
import sys

import jax.random as jr
import pytest

import diffrax_conserve as dfc

from .learned import LORENZ, SMALL, flow_map, solution, states

VORTICES = dfc.systems.PointVortices()
NETWORKS = {
    "windows": solution(windows=2, layer=dfc.learned.ConservativeLayer(LORENZ.manifold)),
    "deeponet": flow_map(taylor=dfc.learned.Taylor(LORENZ.vector_field, 2)),
    "framed": dfc.learned.Repeated(
        dfc.DeepONet(
            states(9, VORTICES), 0.5, frame=VORTICES.frame, key=jr.key(0),
            core=dfc.learned.Gated, **SMALL,
        ),
        2,
    ),
}  # fmt: skip


def forged(header, body, raw=None):
    """A file with these contents and the right checksum."""
    rest = (json.dumps(header).encode() if raw is None else raw) + b"\n" + body
    digest = hashlib.sha256(rest).hexdigest().encode()
    return b"diffrax-conserve network 4 " + digest + b"\n" + rest


def parts(path, network):
    dfc.save(path, network, info={"note": [1, 2, {"a": None}]})
    rest = path.read_bytes().partition(b"\n")[2]
    header, _, body = rest.partition(b"\n")
    return json.loads(header), body


def places(tree, place=()):
    """The paths of all entries of a JSON tree."""
    yield place
    if not isinstance(tree, dict | list):
        return
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
        yield from places(value, (*place, key))


def nested(depth):
    tree = []
    for _ in range(depth):
        tree = [tree]
    return tree


VALUES = [
    None, True, False, 0, -1, 1, 2, 3, 7, 150, 10**9, 10**30, -(10**30), 0.5, 1e308, 1e-320,
    float("nan"), float("inf"), "", "x", "tanh", "Gated", "PINN", "kepler", "float64",
    "float16", "int8", "object", "../x", "\x00", [], {}, [[]], [1], [10**9], [-1], [0], [2**31] * 8,
    [1] * 100, {"array": ["float64", 10**9]}, {"array": ["float64", 3]}, {"array": []},
    {"array": ["float64", 0, 10**12]}, {"array": [["float64"], 1]}, {"array": ["bool", -1, -1]},
    {"dict": {}}, {"list": []}, {"tuple": [None]}, {"dict": []}, {"tuple": 3}, {"activation": []},
    {"activation": "tanh"}, {"activation": "eval"}, {"given": ["layer", 3]}, {"given": []},
    {"method": ["vector_field", {"Kepler": {"mu": 1.0}}]}, {"method": ["__init__", None]},
    {"method": ["__class__", {"Kepler": {"mu": 1.0}}]}, {"method": ["__reduce__", {"MLP": {}}]},
    {"Kepler": {"mu": 1.0}}, {"BoxCox": {"exponent": 0.5}}, {"BoxCox": {"exponent": 7.0}},
    {"Box": {"lower": 0.0, "upper": 1.0}}, {"Box": {"lower": None, "upper": None}},
    {"Taylor": {"vector_field": 3, "order": 1, "args": None}}, {"DeepONet": {}}, {"Path": {}},
    {"MLP": {"weights": {"tuple": []}, "biases": {"tuple": []}, "activation": None}},
    nested(5), nested(100), ["float64"] * 5, ["float32"] * 500,
]  # fmt: skip


def mutated(header, rng):
    """`header` with one to three of its entries replaced, removed, added or exchanged."""
    header = copy.deepcopy(header)
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        place = rng.choice([p for p in places(header) if p])
        parent = header
        for key in place[:-1]:
            parent = parent[key]
        kind, value = rng.randrange(5), copy.deepcopy(rng.choice(VALUES))
        if kind == 0:
            del parent[place[-1]]
        elif kind == 1 and isinstance(parent, dict):
            parent[rng.choice(["", "x", "array", "tuple", "layer", "taylor", "__class__"])] = value
        elif kind == 2 and type(parent[place[-1]]) in (int, float):
            parent[place[-1]] += rng.choice([-1, 1, 0.5, 1000, 10**7])
        else:
            parent[place[-1]] = value
    return header


def outcome(path, content):
    """Both functions may return something, or raise a `ValueError` with a message; nothing else."""
    path.write_bytes(content)
    for function in (dfc.learned.read_info, dfc.load):
        try:
            function(path)
        except ValueError as error:
            message = str(error)
        else:
            continue
        assert 40 < len(message) < 1000


# In the default run few; the count of the law is in the slow one.
@pytest.mark.parametrize("count", [150, pytest.param(4000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("network", NETWORKS.values(), ids=NETWORKS)
def test_mutated_headers(network, count, tmp_path):
    rng = random.Random(count)
    path = tmp_path / "a.network"
    header, body = parts(path, network)
    for _ in range(count):
        outcome(path, forged(mutated(header, rng), body))


@pytest.mark.parametrize("network", NETWORKS.values(), ids=NETWORKS)
def test_arrays_that_are_too_short_or_too_long(network, tmp_path):
    path = tmp_path / "a.network"
    header, body = parts(path, network)
    for wrong in (b"", body[:-1], body[: len(body) // 2], body + b"x", 2 * body):
        path.write_bytes(forged(header, wrong))
        with pytest.raises(ValueError, match="malformed, though its checksum is right"):
            dfc.load(path)


HEADERS = {
    "nothing": b"",
    "no json": b"{",
    "no utf-8": b"\xff\xfe{}",
    "a number": b"1",
    "a long number": b"9" * 100_000,
    "nested lists": b"[" * 100_000,
    "nested dictionaries": b'{"a":' * 100_000,
    "nested and closed": b"[" * 900 + b"]" * 900,
    "a list": b"[]",
    "a dictionary": b"{}",
    "not finite": b'{"kind": NaN}',
}


@pytest.mark.parametrize("raw", HEADERS.values(), ids=HEADERS)
def test_headers_that_are_none(raw, tmp_path):
    path = tmp_path / "a.network"
    path.write_bytes(forged(None, b"", raw))
    for function in (dfc.learned.read_info, dfc.load):
        with pytest.raises(ValueError, match=r"malformed, though its checksum is right"):
            function(path)


def greedy(path):
    """Files of about 1 MB that ask for as much memory as they can."""
    header, body = parts(path, NETWORKS["deeponet"])
    fields = header["network"]["DeepONet"]
    nan = float("nan")

    def network(**changed):
        return header | {"network": {"DeepONet": fields | changed}}

    def arrays(count, *shape):
        return {"list": [{"array": ["float64", *shape]}] * count}

    return {
        "a large array": (network(scale={"array": ["float64", 2**40]}), bytes(2**20)),
        "many large arrays": (network(scale=arrays(9, 2**17 - 1)), bytes(2**20)),
        "many small arrays": (network(scale=arrays(30_000, 1)), bytes(2**20)),
        "many empty arrays": (network(scale=arrays(30_000, 0)), b""),
        "nothing of everything": (network(scale=arrays(900, 0, 2**16)), bytes(2**20)),
        "a list": (network(scale={"list": [0] * 300_000}), body),
        "lists": (network(scale={"list": [{"list": []}] * 80_000}), body),
        "a long series": (
            network(taylor={"Taylor": fields["taylor"]["Taylor"] | {"order": 9999}}),
            body,
        ),
        "info of dictionaries": (header | {"info": {"a": [{}] * 250_000}}, body),
        "info of numbers": (header | {"info": {"a": [nan] * 200_000}}, body),
        "info of keys": (header | {"info": {f"{i}": [] for i in range(80_000)}}, body),
    }


PROBE = """
import resource, sys
import diffrax_conserve as dfc
dfc.load(sys.argv[1])
start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for path in sys.argv[2:]:
    for function in (dfc.learned.read_info, dfc.load):
        try:
            function(path)
        except ValueError:
            pass
    print(path, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - start)
"""


@pytest.mark.slow
def test_memory(tmp_path):
    """The peak of a process that reads all of them, over that of one that has read a good file."""
    good, paths = tmp_path / "good.network", []
    for name, (header, body) in greedy(good).items():
        paths.append(tmp_path / f"{name}.network")
        paths[-1].write_bytes(forged(header, body))
        assert paths[-1].stat().st_size < 3e6
    dfc.save(good, NETWORKS["deeponet"])
    command = [sys.executable, "-c", PROBE, str(good), *map(str, paths)]
    out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    largest = int(out.split()[-1]) * 1024
    assert largest < 100e6, out
