"""Run-time errors whose message holds the number that is wrong.

The messages of a compiled program are fixed when it is compiled, but it can pick one of several by
an integer. Here there is one for every single-precision number, written when it is asked for.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, final, overload

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Shaped

from .._custom_types import RealScalarLike


@final
@dataclasses.dataclass(frozen=True)
class _Messages(Sequence[str]):
    """The messages for all numbers, by the bits of the number in single precision."""

    template: str  # with one place for a number

    @overload
    def __getitem__(self, index: int) -> str: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[str]: ...
    def __getitem__(self, index: Any) -> Any:
        return self.template.format(float(np.int32(index).view(np.float32)))

    def __len__(self) -> int:
        return 2**31


def refuse_if(
    x: Shaped[Array, ""], wrong: Bool[Array, ""], number: RealScalarLike, template: str
) -> Shaped[Array, ""]:
    """`x`, with a run-time error if `wrong`, whose message is `template` with `number` in it.

    In a batch it is the largest of the wrong numbers.
    """
    bits = lax.bitcast_convert_type(jnp.asarray(number, jnp.float32), jnp.int32)
    index = jnp.where(wrong, bits, jnp.iinfo(jnp.int32).min)
    return eqx.branched_error_if(x, wrong, index, _Messages(template))
