"""The learned solvers of the paper's five systems, newly trained or pretrained."""

from pathlib import Path
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import PRNGKeyArray

from .._projection.newton import Newton
from .._solver.manifold_projection import ManifoldProjection
from ..learned import ConservativeLayer, FitLog, paper
from ..learned._files import load, pretrained_path, read_info, save
from ..learned._networks.deeponet import DeepONet
from ..learned._networks.pinn import PINN
from ..learned._solvers.flow_map_solver import DeepONetSolver
from ..learned._solvers.pinn_solver import PINNSolver
from ..learned._training.fit import fit
from ..systems import AbstractSystem

Network = PINN | DeepONet
# A network, and the training loss at some epochs.
Learned = tuple[Network, np.ndarray, np.ndarray]

KINDS = ("standard", "conservative")
# The paper learns one solution of each of the first systems, and the flow maps of the others.
_PINNS = ("harmonic-oscillator", "rigid-body")
_FLOW_MAPS = ("double-pendulum", "conservative-lorenz", "point-vortices")

# The number of initial states on which flow maps are compared.
_STATES = 20
# Closer vortices rotate about each other by more than half a radian in a step, for which RK4 fails
# too.
_SEPARATION = 0.3


def is_learned(system: AbstractSystem) -> bool:
    """Whether the paper has a learned solver for this system."""
    return system.name in (*_PINNS, *_FLOW_MAPS)


def is_flow_map(system: AbstractSystem) -> bool:
    """Whether the paper learns a flow map of this system, for many initial states."""
    return system.name in _FLOW_MAPS


def initial_states(system: AbstractSystem) -> Any:
    """The initial states of the comparison, with a leading axis: the system's own, and for a flow
    map random ones."""
    own = jax.tree.map(lambda x: x[None], system.y0)
    if not is_flow_map(system):
        return own
    drawn = jax.vmap(system.sample)(jr.split(jr.key(1234), 4 * _STATES))
    if system.name == "point-vortices":
        squares = jnp.sum((drawn[:, :, None] - drawn[:, None]) ** 2, axis=-1)
        squares = squares + 1e9 * jnp.eye(drawn.shape[1])
        drawn = drawn[jnp.sqrt(jnp.min(squares, axis=(1, 2))) >= _SEPARATION]
    return jnp.concatenate([own, drawn[: _STATES - 1]])


def pretrained(system: AbstractSystem) -> dict[str, Learned]:
    """The networks that come with the package."""
    found: dict[str, Learned] = {}
    for kind in KINDS:
        path = pretrained_path(f"{system.name}-{kind}")
        history = read_info(path)["info"]["history"]
        network: Any = load(path)
        found[kind] = network, np.array(history["epochs"]), np.array(history["losses"])
    return found


def build(
    system: AbstractSystem, kind: str, net_key: PRNGKeyArray, states_key: PRNGKeyArray
) -> Any:
    """An untrained network of the paper's size."""
    layer = None
    if kind == "conservative":
        layer = ConservativeLayer(system.manifold, steps=3 if is_flow_map(system) else 5)
    if not is_flow_map(system):
        return paper.pinn(system.y0, 0.0, system.t1, key=net_key, layer=layer)
    states = jax.vmap(system.sample)(jr.split(states_key, 1000))
    return paper.deeponet(states, system.dt, key=net_key, layer=layer)


def train(
    system: AbstractSystem,
    kind: str,
    *,
    seed: int = 0,
    epochs: int = 5000,
    points: int | None = None,
    progress: bool = False,
) -> tuple[Network, FitLog]:
    """A network trained by the recipe of the paper; `kind` is one of `KINDS`."""
    net_key, states_key, fit_key = jr.split(jr.key(seed), 3)
    network = build(system, kind, net_key, states_key)
    return fit(
        network,
        system.vector_field,
        key=fit_key,
        sample=system.sample if is_flow_map(system) else None,
        args=system.args,
        recipe=paper.recipe(network, epochs=epochs, points=points),
        progress=progress,
    )


def trained(system: AbstractSystem, out: Path, seed: int, epochs: int) -> dict[str, Learned]:
    """Both networks, trained anew and saved in the folder `out`."""
    networks: dict[str, Learned] = {}
    for kind in KINDS:
        print(f"Training the {kind} network: {epochs} epochs, seed {seed}")
        network, log = train(system, kind, seed=seed, epochs=epochs, progress=True)
        info = {"system": system.name, "kind": kind, "seed": seed, "epochs": epochs}
        save(out / f"{kind}.network", network, info=info)
        networks[kind] = network, *history(log)
    return networks


def history(log: FitLog, points: int = 250) -> tuple[np.ndarray, np.ndarray]:
    """The training loss at about `points` epochs, each the median over nearby epochs."""
    width = max(len(log.losses) // points, 1)
    count = len(log.losses) // width
    blocks = log.losses[: count * width].reshape(count, width)
    return (np.arange(count) + 0.5) * width, np.nanmedian(blocks, axis=1)


def projection_schedule(network: Network, epochs: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """For a conservative network the iterations p(e) of its layer and the weight s(e) of the last
    one, against the epoch."""
    schedule, layer = paper.recipe(network).schedule, network.layer
    assert schedule is not None
    assert layer is not None
    assert layer.steps is not None
    es, steps = jnp.arange(epochs), layer.steps
    p, s = jax.vmap(lambda e: schedule(e, epochs, steps))(es)
    return {"p(e)": (np.asarray(es), np.asarray(p)), "s(e)": (np.asarray(es), np.asarray(s))}


def learned_solvers(
    system: AbstractSystem, networks: dict[str, Network]
) -> dict[str, dfx.AbstractSolver]:
    """The standard network, the conservative one, and the standard one projected afterwards.

    A network can be far from the manifold, so the projection is `Newton`, in the Euclidean metric
    of the paper. The conservative network is projected too, because its layer makes only a few
    iterations.
    """
    standard, conservative = (
        PINNSolver(network) if isinstance(network, PINN) else DeepONetSolver(network)
        for network in (networks["standard"], networks["conservative"])
    )

    def projected(solver: dfx.AbstractSolver) -> ManifoldProjection:
        return ManifoldProjection(solver, system.manifold, projection=Newton(metric=1.0))

    return {
        "standard": standard,
        "conservative": projected(conservative),
        "standard projected": projected(standard),
    }
