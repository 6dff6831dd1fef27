"""Networks in files: what comes back is what went in, and a bad file says what is wrong with it."""

import copy
import functools
import hashlib
import json
import os
import random
import stat

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_conserve as dfc
from diffrax_conserve.learned._files import pretrained_path, read_info

from .learned import EAST, RADIUS, SAVED, SMALL, Still, saved, solution, states
from .problems import oscillator


def same(*networks):
    """Bit for bit; by numpy, which compiles nothing."""
    as_numpy = lambda x: np.asarray(x) if isinstance(x, jax.Array) else x  # noqa: E731
    return eqx.tree_equal(*(jax.tree.map(as_numpy, network) for network in networks))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.network"


@pytest.mark.parametrize("name", SAVED)
def test_what_is_loaded_is_what_was_saved(name, path):
    network = saved(name)
    dfc.save(path, network)
    loaded = dfc.load(path)
    assert same(loaded, network)
    assert jax.tree.structure(loaded) == jax.tree.structure(network)


def polar(y):
    across = jnp.stack([-y[1], y[0]])
    return dfc.learned.Frame(jnp.sum(y**2)[None], jnp.stack([y, across], axis=1))


# A file could hold it, but not the whole layer.
OF_A_SYSTEM = dfc.FirstIntegral(dfc.systems.LotkaVolterra().first_integral)


LAYER, TAYLOR = dfc.learned.ConservativeLayer, dfc.learned.Taylor
GIVEN = {
    "layer": (
        LAYER([OF_A_SYSTEM, RADIUS], steps=4),
        None,
        r"=ConservativeLayer\(manifold, steps=4\)",
    ),
    "taylor": (TAYLOR(oscillator, 3), TAYLOR(oscillator, 2), r"=Taylor\(vector_field, 3\)"),
    "frame": (polar, None, "=frame"),
}


@pytest.mark.parametrize("name", GIVEN)
def test_what_is_the_users_own_is_given_again(path, name):
    given, wrong, match = GIVEN[name]
    network = dfc.DeepONet(EAST[None], 1.0, key=jr.key(0), **{name: given}, **SMALL)
    dfc.save(path, network)
    with pytest.raises(ValueError, match=name + match):
        dfc.load(path, **{name: wrong})
    assert same(dfc.load(path, **{name: given}), network)


def test_another_vector_field_is_told(path):
    def spring(t, y, stiffness):
        return stiffness * oscillator(t, y, None)

    given = dfc.learned.Taylor(spring, 2, args=1.0)
    network = dfc.DeepONet(jr.normal(jr.key(1), (9, 2)), 1.0, taylor=given, key=jr.key(0), **SMALL)
    dfc.save(path, dfc.learned.Repeated(network, 2))
    with pytest.raises(ValueError, match="Pass the field, and its `args`, for which the network"):
        dfc.load(path, taylor=dfc.learned.Taylor(spring, 2, args=1.0 + 1e-6))
    of_others = dfc.learned.Taylor(lambda t, y, args: {"v": -y["q"], "q": y["v"]}, 2)
    with pytest.raises(ValueError, match=r"cannot be computed.* Pass the field"):
        dfc.load(path, taylor=of_others)
    dfc.load(path, taylor=dfc.learned.Taylor(oscillator, 2))
    layer, other = LAYER(RADIUS), LAYER(dfc.FirstIntegral(lambda t, y, args: y[0] ** 3))
    dfc.save(path, dfc.DeepONet(EAST[None], 1.0, layer=LAYER(RADIUS), key=jr.key(0), **SMALL))
    with pytest.raises(ValueError, match="Pass the manifold, and its `args`, for which the"):
        dfc.load(path, layer=other)
    dfc.load(path, layer=layer)


def test_the_info(path):
    dfc.save(path, saved("deeponet"), info={"system": "lorenz", "errors": [1.0, 2.0]})
    found = read_info(path)
    assert found["info"] == {"system": "lorenz", "errors": [1.0, 2.0]}
    assert found["network"]["DeepONet"]["max_step"] == 0.25
    assert set(found) == {"info", "network"}


def test_a_save_that_fails_leaves_the_old_file(path, monkeypatch):
    dfc.save(path, saved("pinn"))
    old = path.read_bytes()

    def fail(*arguments):
        raise OSError("no space left")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match="no space"):
        dfc.save(path, saved("deeponet"))
    assert path.read_bytes() == old
    assert list(path.parent.iterdir()) == [path]


def test_a_file_keeps_its_mode_and_a_link_stays_one(path):
    dfc.save(path, saved("pinn"))
    umask = os.umask(0)
    os.umask(umask)
    assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~umask
    path.chmod(0o640)
    link = path.with_name("link.network")
    link.symlink_to(path.name)
    dfc.save(link, saved("deeponet"))
    assert link.is_symlink()
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert same(dfc.load(path), saved("deeponet"))


class State(eqx.Module):
    x: jax.Array


@pytest.mark.parametrize(
    ("make", "info", "match"),
    [
        (lambda: solution(activation=lambda x: x), None, "activation"),
        (lambda: dfc.learned.Repeated(Still(), 2), None, "a file cannot describe"),
        (lambda: saved("pinn"), {"array": np.ones(3)}, "JSON"),
        (lambda: saved("pinn"), {"error": np.nan}, "JSON"),
        (lambda: dfc.PINN(State(EAST), 0.0, 1.0, key=jr.key(0), **SMALL), None, "State"),
    ],
)
def test_what_cannot_be_saved(path, make, info, match):
    with pytest.raises((TypeError, ValueError), match=match):
        dfc.save(path, make(), info=info)
    assert list(path.parent.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "match"),
    [
        *((lambda c, f=f: c[: int(f * len(c))], "truncated") for f in (0.001, 0.05, 0.5, 0.999)),
        *(
            (lambda c, p=p: c[:p] + bytes([c[p] ^ 1]) + c[p + 1 :], "damaged")
            for p in (60, 300, 1000, -2)
        ),
        *((lambda c, b=b: b, "holds no network|truncated") for b in (b"", b"PK", b"{}\n")),
        (lambda c: c.replace(b"network 4 ", b"network 3 ", 1), "has format 3, .* Upgrade"),
    ],
)
def test_bad_files(path, change, match):
    dfc.save(path, saved("pinn"))
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(ValueError, match=match):
        dfc.load(path)


# 3 could be an open file.
@pytest.mark.parametrize("path", [3, None, b"a.network", "/dev/zero", "/"])
def test_what_is_no_file(path):
    for function in (dfc.load, read_info, lambda p: dfc.save(p, saved("pinn"))):
        with pytest.raises(ValueError, match=r"`path` is .*must be the path of a file"):
            function(path)


NAMES = [
    name + kind for name in dfc.systems.names()[:5] for kind in ("", "-standard", "-conservative")
]


@pytest.mark.parametrize(
    "name",
    [pytest.param(x, marks=() if x == "rigid-body-standard" else pytest.mark.slow) for x in NAMES],
)
def test_every_pretrained_network_errs_as_noted(name):
    network, file = dfc.load_pretrained(name), pretrained_path(name)
    info = read_info(file)["info"]
    system = dfc.systems.get(info["system"])
    assert file.stat().st_size < 200_000
    assert (network.layer is not None) == name.endswith("-conservative")
    assert info["command"].startswith("python benchmarks/learned/")
    noted = info["errors"]["plain"]
    if isinstance(network, dfc.PINN):
        ts = jnp.linspace(0, system.t1, 20)
        error = jnp.linalg.norm(jax.vmap(network)(ts) - system.reference(ts), axis=1)
        assert 0 < float(jnp.max(error)) <= 1.01 * noted["largest_state_error"]
        return
    # The states that are drawn for the paper's networks are states that all know.
    y0s = states(20, system)
    steps = jax.vmap(lambda y0: system.reference(jnp.array([system.dt]), y0)[0])(y0s)
    error = eqx.filter_jit(jax.vmap(lambda y: network(y, system.dt)))(y0s) - steps
    median = float(jnp.median(jnp.linalg.norm(error.reshape(20, -1), axis=1)))
    assert 0 < median < 10 * noted.get("one_step_rms", noted["largest_state_error"])
    assert network.domain.contains(system.y0)


@pytest.mark.parametrize("name", ["rigid-bodies", "../pretrained/rigid-body", "/etc/passwd", ""])
def test_a_pretrained_network_that_does_not_exist(name):
    with pytest.raises(ValueError, match=r"rigid-body-conservative"):
        dfc.load_pretrained(name)


# ---- Files with the right checksum and malformed contents: one clear error, little memory ----

SOME = "pinn", "gated", "framed"


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
@pytest.mark.parametrize("name", SOME)
def test_mutated_headers(name, count, path):
    """Both functions may return something, or raise a `ValueError` with a message; nothing else."""
    rng, (header, body) = random.Random(count), parts(path, saved(name))
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


@pytest.mark.parametrize("name", SOME)
def test_arrays_that_are_too_short_or_too_long(name, path):
    header, body = parts(path, saved(name))
    for wrong in (b"", body[:-1], body[: len(body) // 2], body + b"x", 2 * body):
        path.write_bytes(forged(header, wrong))
        with pytest.raises(ValueError, match="malformed, though its checksum is right"):
            dfc.load(path)


HEADERS = [b"", b"{", b"\xff\xfe{}", b"1", b"9" * 100_000, b"[" * 100_000, b'{"a":' * 100_000]
HEADERS += [b"[" * 900 + b"]" * 900, b"[]", b"{}", b'{"kind": NaN}']


def test_headers_that_are_none(path):
    for raw in HEADERS:
        path.write_bytes(forged(None, b"", raw))
        for function in (read_info, dfc.load):
            with pytest.raises(ValueError, match=r"malformed, though its checksum is right"):
                function(path)
