"""Our messages in `diffrax.RESULTS`: this test fails when diffrax keeps them otherwise."""

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import pytest

from diffrax_conserve._solver.diffrax_private import member, register


def test_a_registered_message_is_a_result_like_those_of_diffrax(errors_raise):
    messages = dfx.RESULTS._index_to_message
    before = list(messages)
    try:
        first = register("the moon is in the way")
        assert messages == [*before, "diffrax_conserve: the moon is in the way"]
        result = eqx.filter_jit(member)(jnp.asarray(first))
        assert dfx.RESULTS[result] == messages[-1]
        assert dfx.RESULTS[dfx.RESULTS.successful] == ""
        chosen = dfx.RESULTS.where(result != dfx.RESULTS.successful, result, dfx.RESULTS.successful)
        with pytest.raises(RuntimeError, match="diffrax_conserve: the moon is in the way"):
            chosen.error_if(jnp.ones(1), chosen == result).block_until_ready()
    finally:
        del messages[len(before) :]
