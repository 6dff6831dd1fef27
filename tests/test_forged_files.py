"""Files with the right checksum and malformed contents: one clear `ValueError`, little memory."""

import copy
import functools
import hashlib
import json
import random

import pytest

import diffrax_conserve as dfc
from diffrax_conserve.learned._files import read_info

from .learned import saved

NAMES = "pinn", "gated", "framed"


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


VALUES = [
    None, True, 0, -1, 3, 10**30, 0.5, 1e308, float("nan"), "", "tanh", "Gated", "kepler",
    "object", "../x", "\x00", [], {}, [[]], [-1], [2**31] * 8, {"array": ["float64", 10**9]},
    {"array": ["float64", 3]}, {"array": []}, {"array": [["float64"], 1]}, {"given": []},
    {"dict": {}}, {"list": []}, {"tuple": [None]}, {"tuple": 3}, {"activation": "eval"},
    {"method": ["vector_field", {"Kepler": {"mu": 1.0}}]}, {"method": ["__reduce__", {"MLP": {}}]},
    {"method": ["__class__", {"Kepler": {"mu": 1.0}}]}, {"BoxCox": {"exponent": 7.0}},
    {"Box": {"lower": None, "upper": None}}, {"DeepONet": {}}, {"Path": {}},
    {"Taylor": {"vector_field": 3, "order": 1, "args": None}},
    {"MLP": {"weights": {"tuple": []}, "biases": {"tuple": []}, "activation": None}},
    functools.reduce(lambda tree, _: [tree], range(100), []), ["float32"] * 500,
]  # fmt: skip


def places(tree, place=()):
    """The paths of all entries of a JSON tree."""
    yield place
    if isinstance(tree, dict | list):
        for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
            yield from places(value, (*place, key))


def mutated(header, rng):
    """`header` with one to three of its entries replaced, removed, added or exchanged."""
    header = copy.deepcopy(header)
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        place = rng.choice([p for p in places(header) if p] or [()])
        if not place:  # nothing is left
            break
        parent = functools.reduce(lambda tree, key: tree[key], place[:-1], header)
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


# In the default run few; the count of the law is in the slow one.
@pytest.mark.parametrize("count", [150, pytest.param(4000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", NAMES)
def test_mutated_headers(name, count, tmp_path):
    """Both functions may return something, or raise a `ValueError` with a message; nothing else."""
    rng, path = random.Random(count), tmp_path / "a.network"
    header, body = parts(path, saved(name))
    for _ in range(count):
        path.write_bytes(forged(mutated(header, rng), body))
        for function in (read_info, dfc.load):
            try:
                function(path)
            except ValueError as error:
                message = str(error)
            else:
                continue
            assert 40 < len(message) < 1000


@pytest.mark.parametrize("name", NAMES)
def test_arrays_that_are_too_short_or_too_long(name, tmp_path):
    path = tmp_path / "a.network"
    header, body = parts(path, saved(name))
    for wrong in (b"", body[:-1], body[: len(body) // 2], body + b"x", 2 * body):
        path.write_bytes(forged(header, wrong))
        with pytest.raises(ValueError, match="malformed, though its checksum is right"):
            dfc.load(path)


HEADERS = [b"", b"{", b"\xff\xfe{}", b"1", b"9" * 100_000, b"[" * 100_000, b'{"a":' * 100_000]
HEADERS += [b"[" * 900 + b"]" * 900, b"[]", b"{}", b'{"kind": NaN}']


def test_headers_that_are_none(tmp_path):
    path = tmp_path / "a.network"
    for raw in HEADERS:
        path.write_bytes(forged(None, b"", raw))
        for function in (read_info, dfc.load):
            with pytest.raises(ValueError, match=r"malformed, though its checksum is right"):
                function(path)
