"""The interface that `fit` trains: a flow map, or one window of a PINN."""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from ..._custom_types import Y

# A function from `(key, count, first, last)` to times.
Times = Callable[[PRNGKeyArray, int, Any, Any], Float[Array, " points"]]
# A function from a random key to an initial state.
Sampler = Callable[[PRNGKeyArray], Any]
# The iterations of a conservative layer and the weight of the last one, `(p, s)`.
LayerSchedule = tuple[Int[Array, ""], Float[Array, ""]]


class Points(NamedTuple):
    """Collocation points: times, and for a flow map the initial state of each."""

    ts: Float[Array, " points"]
    y0s: Any  # with a leading axis; None for a window
    pairs: Any = None  # pairs of states from data, one for each point


def checked_part(name: str, part: Any, kind: type) -> Any:
    """`part`; raises unless it is `None` or a `kind`."""
    if not isinstance(part, kind | None):
        raise TypeError(
            f"`{name}` is of type `{type(part).__name__}`, but it must be a `{kind.__name__}`."
        )
    return part


class AbstractTrainable(eqx.Module):
    """A network whose states are functions of time, which `fit` trains to be solutions."""

    layer: eqx.AbstractVar[Any]  # a `ConservativeLayer`, or None

    @abc.abstractmethod
    def draw(self, times: Times, sample: Sampler | None, count: int, key: PRNGKeyArray) -> Points:
        """`count` random collocation points."""

    @abc.abstractmethod
    def states(
        self, points: Points, ts: Float[Array, " points"], schedule: LayerSchedule | None
    ) -> PyTree[Array]:
        """The states at `ts` of the solutions to which `points` belong, stacked."""

    @abc.abstractmethod
    def starts(self, points: Points) -> Points:
        """The initial times and states of these solutions."""

    @abc.abstractmethod
    def measured(self, points: Points, rates: Y) -> Float[Array, "points n"]:
        """Rates of change of the states as vectors, in the units of the loss."""

    @abc.abstractmethod
    def weights(self) -> Any:
        """The part of the network that is trained."""

    @abc.abstractmethod
    def linear_weights(self) -> Any:
        """The weights in which the candidate is linear, as a tuple, perhaps empty."""
