"""What is found once is kept, but not for ever."""

import jax
import jax.numpy as jnp
import pytest

import diffrax_conserve as dfc
from diffrax_conserve._dae import dae
from diffrax_conserve._large import klu, sparse
from diffrax_conserve._memory import Memory


def test_the_least_recently_used_is_forgotten():
    memory, asked = Memory(2), []

    def found(key):
        return memory(key, lambda: asked.append(key))

    for key in "abacab":
        found(key)
    assert asked == ["a", "b", "c", "b"]
    assert len(memory) == 2


FOUND = [(dae, "_SEARCHES"), (dae, "_FOUND"), (klu, "_KNOWN"), (sparse, "_KNOWN")]


@pytest.mark.parametrize(("module", "name"), FOUND)
def test_memory_does_not_grow_with_the_number_of_functions(module, name, monkeypatch):
    memory = Memory(2)
    monkeypatch.setattr(module, name, memory)
    for k in range(4):
        if module is klu:
            klu.sparse_jacobian(lambda y, k=k: k * y, jnp.ones(4))
        elif module is sparse:
            lengths = dfc.Constraint(lambda t, y, args, k=k: jnp.sum(y**2, axis=1) - k)
            jax.eval_shape(lambda y, of=lengths: dfc.project(of, y), jnp.ones((40, 3)))
        else:
            equations = dfc.DAE(residual=lambda t, y, dy, args, k=k: (1 + k) * dy + y)
            jax.eval_shape(lambda y, of=equations: of.term.vf(0.0, y, None), jnp.ones(4))
    assert len(memory) == 2
