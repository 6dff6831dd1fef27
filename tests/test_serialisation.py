"""Networks in files: what comes back is what went in, and a bad file says what is wrong with it."""

import json
import os
import stat

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jaxtyping
import numpy as np
import pytest

import diffrax_conserve as dfc

from .learned import EAST, LORENZ, RADIUS, SMALL, flow_map, oscillator, solution, states
from .thinned import some_of

VORTICES = dfc.systems.PointVortices()


def vortices(**options):
    y0s = states(system=VORTICES)
    return dfc.DeepONet(y0s, 0.5, frame=VORTICES.frame, key=jr.key(0), **(SMALL | options))


NETWORKS = {
    "pinn": solution(activation="sin"),
    "raw pinn": solution(normalise=False),
    "deeponet": flow_map(depth=3),
    "conservative pinn": solution(layer=dfc.learned.ConservativeLayer(LORENZ.manifold, steps=4)),
    "windows": solution(windows=[0.3, 1.2], slope=2.0),
    "gated": flow_map(core=dfc.learned.Gated, taylor=dfc.learned.Taylor(LORENZ.vector_field, 2)),
    "concatenated": flow_map(
        core=dfc.learned.Concatenated,
        taylor=dfc.learned.Taylor(LORENZ.vector_field),
        layer=dfc.learned.ConservativeLayer(LORENZ.manifold),
    ),
    "conservative deeponet": flow_map(layer=dfc.learned.ConservativeLayer(LORENZ.manifold)),
    "framed": vortices(taylor=dfc.learned.Taylor(VORTICES.vector_field)),
    "repeated": dfc.learned.Repeated(vortices(core=dfc.learned.Concatenated), 3),
    "transformed": dfc.learned.Transformed(flow_map(), dfc.learned.BoxCox(0.125)),
    "family": flow_map(args_domain=dfc.learned.Box({"a": 0.5}, {"a": jnp.array(1.5)})),
    "single": dfc.learned.single_precision(flow_map()),
    "both": dfc.learned.Repeated(dfc.learned.Transformed(flow_map(), dfc.learned.BoxCox(0.0)), 2),
}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.network"


@pytest.mark.parametrize("network", NETWORKS.values(), ids=NETWORKS)
def test_what_is_loaded_is_what_was_saved(network, path):
    dfc.save(path, network)
    loaded = dfc.load(path)
    assert eqx.tree_equal(loaded, network)
    assert jax.tree.structure(loaded) == jax.tree.structure(network)


def test_a_state_of_any_standard_container(path):
    y0 = {"a": (jnp.ones(2), [jnp.zeros((2, 1), jnp.float32), None]), "b": jnp.array(2.0)}
    pinn = dfc.PINN(y0, 0.0, 1.0, key=jr.key(0), **SMALL)
    dfc.save(path, pinn)
    assert eqx.tree_equal(dfc.load(path), pinn)


def test_the_parameters_of_the_system_are_kept(path):
    system = dfc.systems.PointVortices(strengths=(1.0, 2.0, 3.0, -1.0))
    y0s = jax.vmap(system.sample)(jr.split(jr.key(0), 4))
    layer = dfc.learned.ConservativeLayer(system.manifold, steps=2)
    network = dfc.DeepONet(y0s, 0.5, key=jr.key(0), layer=layer, **SMALL)
    dfc.save(path, network)
    assert eqx.tree_equal(dfc.load(path), network)


def test_a_layer_of_the_users_own_is_given_again(path):
    layer = dfc.learned.ConservativeLayer(RADIUS, steps=4)
    pinn = dfc.PINN(EAST, 0.0, 1.0, key=jr.key(0), layer=layer, **SMALL)
    dfc.save(path, pinn)
    with pytest.raises(ValueError, match=r"layer=ConservativeLayer\(manifold, steps=4\)"):
        dfc.load(path)
    assert eqx.tree_equal(dfc.load(path, layer=layer), pinn)
    dfc.save(path, NETWORKS["pinn"])
    with pytest.raises(ValueError, match="leave `layer` out"):
        dfc.load(path, layer=layer)


def test_a_vector_field_of_the_users_own_is_given_again(path):
    taylor = dfc.learned.Taylor(oscillator, 3)
    network = dfc.DeepONet(EAST[None], 1.0, key=jr.key(0), taylor=taylor, **SMALL)
    dfc.save(path, network)
    for wrong in ({}, dict(taylor=dfc.learned.Taylor(oscillator, 2))):
        with pytest.raises(ValueError, match=r"taylor=Taylor\(vector_field, 3\)"):
            dfc.load(path, **wrong)
    assert eqx.tree_equal(dfc.load(path, taylor=taylor), network)


def test_a_frame_of_the_users_own_is_given_again(path):
    def polar(y):
        across = jnp.stack([-y[1], y[0]])
        return dfc.learned.Frame(jnp.sum(y**2)[None], jnp.stack([y, across], axis=1))

    network = dfc.DeepONet(EAST[None], 1.0, key=jr.key(0), frame=polar, **SMALL)
    dfc.save(path, network)
    with pytest.raises(ValueError, match="frame=frame"):
        dfc.load(path)
    assert eqx.tree_equal(dfc.load(path, frame=polar), network)


def test_the_info(path):
    dfc.save(path, NETWORKS["deeponet"], info={"system": "lorenz", "errors": [1.0, 2.0]})
    found = dfc.learned.read_info(path)
    assert found["info"] == {"system": "lorenz", "errors": [1.0, 2.0]}
    assert found["network"]["DeepONet"]["max_step"] == 0.25
    assert set(found) == {"info", "network"}


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
def test_arrays_keep_their_dtype(path, dtype):
    single = jax.tree.map(lambda x: x.astype(dtype), NETWORKS["deeponet"])
    dfc.save(path, single)
    assert eqx.tree_equal(dfc.load(path), single)
    # Some arrays, too.
    mixed = eqx.tree_at(lambda m: m.core, NETWORKS["deeponet"], single.core)
    dfc.save(path, mixed)
    assert eqx.tree_equal(dfc.load(path), mixed)


def test_the_file_is_no_pickle(path):
    dfc.save(path, NETWORKS["pinn"])
    first, header, _ = path.read_bytes().split(b"\n", 2)
    assert first.startswith(b"diffrax-conserve network 4 ")
    assert set(json.loads(header)["network"]) == {"PINN"}


# ---- What cannot be saved ----


def test_what_cannot_be_saved(path):
    with pytest.raises(TypeError, match="activation"):
        dfc.save(path, solution(activation=lambda x: x))
    function = dfc.learned.FlowMap(lambda y0, h: y0, 1.0)
    with pytest.raises(TypeError, match="a file cannot describe"):
        dfc.save(path, dfc.learned.Repeated(function, 2))
    with pytest.raises(ValueError, match="JSON"):
        dfc.save(path, NETWORKS["pinn"], info={"array": np.ones(3)})
    with pytest.raises(ValueError, match="JSON"):
        dfc.save(path, NETWORKS["pinn"], info={"error": np.nan})

    class State(eqx.Module):
        x: jax.Array

    custom = dfc.PINN(State(EAST), 0.0, 1.0, key=jr.key(0), **SMALL)
    with pytest.raises(TypeError, match="State"):
        dfc.save(path, custom)
    assert list(path.parent.iterdir()) == []


def test_a_save_that_fails_leaves_the_old_file(path, monkeypatch):
    dfc.save(path, NETWORKS["pinn"])
    old = path.read_bytes()

    def fail(*arguments):
        raise OSError("no space left")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match="no space"):
        dfc.save(path, NETWORKS["deeponet"])
    assert path.read_bytes() == old
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o666])
def test_a_file_keeps_its_mode_and_a_link_stays_one(path, mode):
    dfc.save(path, NETWORKS["pinn"])
    umask = os.umask(0)
    os.umask(umask)
    assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~umask
    path.chmod(mode)
    link = path.with_name("link.network")
    link.symlink_to(path.name)
    dfc.save(link, NETWORKS["deeponet"])
    assert link.is_symlink()
    assert stat.S_IMODE(path.stat().st_mode) == mode
    assert eqx.tree_equal(dfc.load(path), NETWORKS["deeponet"])
    assert set(path.parent.iterdir()) == {path, link}


# ---- Bad files ----


@pytest.fixture
def content(path):
    dfc.save(path, NETWORKS["pinn"])
    return path.read_bytes()


@pytest.mark.parametrize("fraction", [0.001, 0.01, 0.05, 0.5, 0.999])
def test_a_truncated_file(path, content, fraction):
    path.write_bytes(content[: int(fraction * len(content))])
    with pytest.raises(ValueError, match="truncated"):
        dfc.load(path)


@pytest.mark.parametrize("position", [60, 300, 1000, -1])
def test_a_damaged_file(path, content, position):
    damaged = bytearray(content)
    damaged[position] ^= 1
    path.write_bytes(bytes(damaged))
    with pytest.raises(ValueError, match="damaged"):
        dfc.load(path)


def test_a_foreign_file(path):
    for foreign in (b"", b"PK\x03\x04 something else\n", b"{}\n", np.arange(99).tobytes()):
        path.write_bytes(foreign)
        with pytest.raises(ValueError, match=r"does not hold a network|truncated"):
            dfc.load(path)


@pytest.mark.parametrize("version", [b"3", b"5", b"12"])
def test_a_file_of_another_version(path, content, version):
    path.write_bytes(content.replace(b"network 4 ", b"network %s " % version, 1))
    with pytest.raises(ValueError, match=f"has format {version.decode()}, .* upgrade .* changelog"):
        dfc.load(path)


def test_a_missing_file(path):
    with pytest.raises(FileNotFoundError):
        dfc.load(path)


@pytest.mark.parametrize("path", [None, 0, 3, b"a.network"])
def test_what_is_no_path(path, monkeypatch):
    """An integer would be an open file, and 0 the standard input."""
    # As users see it: the run-time type checker of the suite would answer first.
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    for function in (dfc.load, dfc.learned.read_info, lambda p: dfc.save(p, NETWORKS["pinn"])):
        with pytest.raises(TypeError, match="`path` is"):
            function(path)


@pytest.mark.parametrize("path", ["/", "/dev/zero"])
def test_what_is_no_file(path):
    for function in (dfc.load, dfc.learned.read_info, lambda p: dfc.save(p, NETWORKS["pinn"])):
        with pytest.raises(ValueError, match="is a folder or a device"):
            function(path)


# ---- The networks of the package ----

SYSTEMS = dfc.systems.names()[:5]


@pytest.mark.parametrize("kind", ["standard", "conservative"])
@pytest.mark.parametrize("name", SYSTEMS)
def test_every_pretrained_network(name, kind):
    name = f"{name}-{kind}"
    network = dfc.load_pretrained(name)
    file = dfc.learned.pretrained_path(name)
    info = dfc.learned.read_info(file)["info"]
    system = dfc.systems.get(info["system"])
    assert file.stat().st_size < 200_000
    assert (network.layer is not None) == (kind == "conservative")
    assert info["command"].startswith("python benchmarks/learned/paper.py")
    assert info["errors"]["plain"]["largest_state_error"] > 0
    assert len(info["history"]["epochs"]) == len(info["history"]["losses"])
    # It is the network whose error is noted.
    if isinstance(network, dfc.PINN):
        y = eqx.filter_jit(network)(system.dt)
        exact = system.reference(jnp.array([system.dt]))[0]
        expected = info["errors"]["plain"]["one_step_error"]
        np.testing.assert_allclose(jnp.linalg.norm(y - exact), expected, rtol=1e-6)
    else:
        assert network.max_step == system.dt
        y = eqx.filter_jit(network)(system.y0, 0.0)
        np.testing.assert_allclose(y, system.y0, rtol=0, atol=1e-14)


@some_of("name", SYSTEMS, ids=SYSTEMS, period=5)
def test_every_network_of_the_zoo(name):
    network = dfc.load_pretrained(name)
    file = dfc.learned.pretrained_path(name)
    info = dfc.learned.read_info(file)["info"]
    system = dfc.systems.get(name)
    assert file.stat().st_size < 60_000
    assert info["command"].startswith("python benchmarks/learned/zoo.py")
    if isinstance(network, dfc.PINN):
        ts = jnp.linspace(0, system.t1, 20)
        error = jnp.linalg.norm(jax.vmap(network)(ts) - system.reference(ts), axis=1)
        noted = info["errors"]["plain"]["largest_state_error"]
        assert 0 < float(jnp.max(error)) <= 1.01 * noted
        return
    # The states that are drawn for the paper's networks are states that it knows.
    states = jax.vmap(system.sample)(jr.split(jr.key(3), 20))
    steps = jax.vmap(lambda y0: system.reference(jnp.array([system.dt]), y0)[0])(states)
    error = eqx.filter_jit(jax.vmap(lambda y: network(y, system.dt)))(states) - steps
    median = float(jnp.median(jnp.linalg.norm(error.reshape(20, -1), axis=1)))
    assert median < 10 * info["errors"]["plain"]["one_step_rms"]
    assert network.domain.contains(system.y0)


@pytest.mark.parametrize("name", ["rigid-bodies", "../pretrained/rigid-body", "/etc/passwd", ""])
def test_a_pretrained_network_that_does_not_exist(name):
    with pytest.raises(ValueError, match=r"rigid-body-conservative"):
        dfc.load_pretrained(name)
