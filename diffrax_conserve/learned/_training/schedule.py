"""Schedules for the number of iterations of the conservative layer, and the weight of the last one.

A schedule is a pair of functions of the epoch `e` (traced), the number `E` of epochs and the number
`P` of iterations in the layer: `p(e, E, P)` and `s(e, E, P)`. The network is trained through
`(1 - s) P_{p-1} u + s P_p u`, where `P_k u` is its output after `k` iterations.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def staged_iterations(epoch: Int[Array, "..."], epochs: int, steps: int) -> Int[Array, "..."]:
    """`p = min(P, floor(e (P + 1) / E))`: no iterations at first, one more after each stage."""
    return jnp.minimum(steps, epoch * (steps + 1) // epochs)


def every_iteration(epoch: Int[Array, "..."], epochs: int, steps: int) -> Int[Array, "..."]:
    """`p = P` from the first epoch on."""
    del epochs
    return jnp.full_like(epoch, steps)


def ramped_weight(epoch: Int[Array, "..."], epochs: int, steps: int) -> Float[Array, "..."]:
    """`s` rises from 0 to 1 within each stage, so that it is continuous where `p` increases."""
    position = epoch * (steps + 1) / epochs
    return position - jnp.minimum(jnp.floor(position), steps)


def linear_weight(epoch: Int[Array, "..."], epochs: int, steps: int) -> Float[Array, "..."]:
    """`s = e / E`, as in the paper: the trained function is discontinuous where `p` increases."""
    del steps
    return epoch / epochs


def constant_weight(epoch: Int[Array, "..."], epochs: int, steps: int) -> Float[Array, "..."]:
    """`s = 1`: only the last iteration counts."""
    del epochs, steps
    return jnp.ones_like(epoch, float)
