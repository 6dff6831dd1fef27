"""What a wrapper of another solver takes over from it."""

from typing import Any

import diffrax as dfx
from jaxtyping import PyTree

from .._custom_types import VF, Args, RealScalarLike, Y
from .._hashable import Hashable
from .terms import innermost


def _of_innermost(name: str) -> Any:
    """A property that reads an attribute of the solver inside all wrappers."""
    return property(lambda self: getattr(innermost(self.solver), name))


class ForwardingSolver(Hashable, dfx.AbstractWrappedSolver[Any]):
    """The base of our wrappers. For diffrax a wrapper is an instance of the classes of the solver
    inside, such as of an implicit solver. It then reads the attributes of such a solver from the
    wrapper, which therefore must have them all."""

    term_structure = _of_innermost("term_structure")
    term_compatible_contr_kwargs = _of_innermost("term_compatible_contr_kwargs")
    root_finder = _of_innermost("root_finder")
    root_find_max_steps = _of_innermost("root_find_max_steps")
    scan_kind = _of_innermost("scan_kind")

    def order(self, terms: PyTree[dfx.AbstractTerm]) -> int | None:
        return self.solver.order(terms)

    def func(self, terms: PyTree[dfx.AbstractTerm], t0: RealScalarLike, y0: Y, args: Args) -> VF:
        return self.solver.func(terms, t0, y0, args)
