"""The option is set before XLA starts, beside others, and refused afterwards."""

import os

import jax.numpy as jnp
import pytest

import diffrax_conserve as dfc

from . import fresh

OPTION = "xla_cpu_small_while_loop_byte_threshold=65536"
LIST = "--xla_backend_extra_options="


def test_xla_takes_it_in_a_new_interpreter():
    assert fresh.interpreter()["computed with fast_cpu"] == 3


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("", LIST + OPTION),
        ("--xla_cpu_enable_fast_math=false", f"--xla_cpu_enable_fast_math=false {LIST}{OPTION}"),
        (LIST + "xla_a=1", f"{LIST}xla_a=1,{OPTION}"),
        (LIST + OPTION, LIST + OPTION),
    ],
)
def test_it_adds_to_the_options_of_xla(before, after, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", before)
    monkeypatch.setattr("diffrax_conserve._fast_cpu._has_started", lambda: False)
    dfc.fast_cpu()
    assert os.environ["XLA_FLAGS"] == after


def test_it_says_when_it_is_too_late(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "")
    jnp.ones(3)
    with pytest.raises(RuntimeError, match=f"too late.*{OPTION}"):
        dfc.fast_cpu()
