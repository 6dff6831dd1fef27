"""First integrals, constraints, and the PyTrees of them that define a manifold."""

import abc
import math
from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from ._along import Along
from ._custom_types import Args, ConstraintFn, Manifold, RealScalarLike, Values, Y
from ._options import check_function, check_numbers, check_vector_field, dtype_of, is_real
from ._tree import tree_shapes


class AbstractConserved(eqx.Module):
    """One entry of a manifold: a function of `(t, y, args)` and its conserved value."""

    fn: eqx.AbstractVar[ConstraintFn]

    @abc.abstractmethod
    def conserved_value(self, t: RealScalarLike, y: Y, args: Args) -> Values:
        """The value of `fn` that a solve started at `(t, y, args)` conserves."""


@final
class FirstIntegral(AbstractConserved):
    r"""A function $I(t, y, args)$ that is constant along the exact solution, or has a known rate.

    The conserved value is $I(t_0, y_0, args)$ of the solve in which it is used, or `value` where
    that is given; the manifold is $\{y : I(t, y, args) = \text{conserved value}\}$.

    With `rate`, which is $dI/dt$ along the exact solution, this is a *balance law*: the conserved
    value at $t$ is larger by $\int_{t_0}^t \mathrm{rate}(s, y(s), args)\, ds$. A solve computes
    this integral step by step, by Gauss quadrature with four nodes along the dense output of the
    wrapped solver, and carries it in the solver state. Examples are the balance of energy and
    dissipated power, and an entropy that decreases; see "Balance laws" in the guide.

    !!! example

        ```python
        import diffrax_conserve as dfc

        def energy(t, y, args):
            q, p = y
            return 0.5 * (p**2 + q**2)

        integral = dfc.FirstIntegral(energy)
        ```
    """

    fn: ConstraintFn
    value: Values | None
    rate: ConstraintFn | None

    def __init__(
        self,
        fn: ConstraintFn,
        *,
        value: Values | None = None,
        rate: ConstraintFn | None = None,
    ):
        self.fn = fn
        self.rate = rate
        check_numbers("value", value)
        # Arrays, so that a different value does not trigger another compilation.
        self.value = jtu.tree_map(
            lambda x: x if isinstance(x, jax.Array) else jnp.asarray(x), value
        )

    def __check_init__(self):
        _check_fn(self)
        if self.rate is not None:
            what = "the derivative of `fn` along the solution"
            check_function("rate", "FirstIntegral", self.rate, "t, y, args", what)

    def conserved_value(self, t: RealScalarLike, y: Y, args: Args) -> Values:
        return self.fn(t, y, args) if self.value is None else self.value


FirstIntegral.__init__.__doc__ = r"""**Arguments:**

- `fn`: a callable `fn(t, y, args)` (a function or an [`equinox.Module`][], whose arrays can then
    be differentiated) that returns a PyTree of real arrays. Every element is one first integral.
- `value`: the conserved value, a PyTree like the one that `fn` returns. By default it is computed
    from the initial state of the solve. With `rate` it is the value at the start of the solve.
- `rate`: a callable `rate(t, y, args)` that returns $dI/dt$ along the exact solution,
    $\partial_t I + \nabla I \cdot f$, shaped like what `fn` returns. By default it is zero.
"""


@final
class Constraint(AbstractConserved):
    r"""A function $g(t, y, args)$ that is zero along the exact solution.

    The manifold is $\{y : g(t, y, args) = 0\}$.

    !!! example

        ```python
        import jax.numpy as jnp
        import diffrax_conserve as dfc

        unit_length = dfc.Constraint(lambda t, q, args: jnp.sum(q**2) - 1)
        ```
    """

    fn: ConstraintFn

    def __check_init__(self):
        _check_fn(self)

    def derivative(self, vector_field: Callable[[RealScalarLike, Any, Args], Any]) -> "Constraint":
        r"""The hidden constraint $\dot g = \partial_t g + \partial_y g \cdot f = 0$.

        If $g = 0$ holds for all times, so does the hidden constraint. For a constraint on the
        positions of a mechanism it is the constraint on the velocities, and it depends only on the
        part $q' = v$ of the field.

        **Arguments:**

        - `vector_field`: $f$, called as `vector_field(t, y, args)`.

        **Returns:**

        A [`diffrax_conserve.Constraint`][].

        **Raises:**

        `TypeError` if `vector_field` is not callable.

        !!! example

            ```python
            import diffrax_conserve as dfc
            import jax.numpy as jnp

            def free_fall(t, y, args):
                q, v = y
                return v, jnp.array([0.0, -9.81])

            rod = dfc.Constraint(lambda t, y, args: jnp.sum(y[0] ** 2) - 1)
            along_the_circle = rod.derivative(free_fall)
            ```
        """
        check_vector_field(vector_field, "constraint.derivative(vector_field)")
        return Constraint(Along(self.fn, vector_field))

    def conserved_value(self, t: RealScalarLike, y: Y, args: Args) -> Values:
        return jtu.tree_map(jnp.zeros_like, self.fn(t, y, args))


Constraint.__init__.__doc__ = r"""**Arguments:**

- `fn`: a callable `fn(t, y, args)` (a function or an [`equinox.Module`][], whose arrays can then
    be differentiated) that returns a PyTree of real arrays. Every array element is one scalar
    constraint.
"""


def _check_fn(entry: AbstractConserved) -> None:
    check_function("fn", type(entry).__name__, entry.fn, "t, y, args", "real arrays")


def is_entry(x: Any) -> bool:
    return isinstance(x, AbstractConserved)


def rate_of(entry: Any) -> ConstraintFn | None:
    return entry.rate if isinstance(entry, FirstIntegral) else None


def check_manifold(manifold: Manifold) -> None:
    """Raises unless `manifold` is a non-empty PyTree of `FirstIntegral`s and `Constraint`s."""
    entries = named_entries(manifold)
    for name, entry in entries:
        if not is_entry(entry):
            remedy = (
                "Wrap it: `FirstIntegral(fn)` keeps `fn(t, y, args)` at its initial value, "
                "`Constraint(fn)` keeps it at zero."
                if callable(entry)
                else "Each leaf must be a `FirstIntegral(fn)` or a `Constraint(fn)`."
            )
            raise TypeError(
                f"`{name}` is {entry!r}, which is neither a `FirstIntegral` nor a `Constraint`. "
                + remedy
            )
    if not entries:
        raise ValueError(
            f"`manifold` is {manifold!r}, which holds no `FirstIntegral` and no `Constraint`: "
            "there is nothing to conserve. Give at least one, or use the solver without projection."
        )


def named_entries(manifold: Manifold) -> list[tuple[str, Any]]:
    flat, _ = jtu.tree_flatten_with_path(manifold, is_leaf=is_entry)
    return [(f"manifold{jtu.keystr(path)}", entry) for path, entry in flat]


def entry_name(manifold: Manifold, position: int) -> str:
    """The name of an entry of a manifold; the message of a failed solve gives only its number.

    **Arguments:**

    - `manifold`: a PyTree of `FirstIntegral`s and `Constraint`s.
    - `position`: the number of the entry, in the order in which JAX flattens the PyTree.

    **Returns:**

    The path to the entry, such as `manifold['energy']`.

    **Raises:**

    `ValueError` if the manifold has no entry of that number.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        sphere = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - 1)
        print(dfc.entry_name({"sphere": sphere}, 0))  # manifold['sphere']
        ```

        ```text
        manifold['sphere']
        ```
    """
    names = [name for name, _ in named_entries(manifold)]
    if not 0 <= position < len(names):
        raise ValueError(
            f"`position` is {position}, but the manifold has the entries 0 to {len(names) - 1}: "
            f"{', '.join(names)}."
        )
    return names[position]


def evaluate(manifold: Manifold, t: RealScalarLike, y: Y, args: Args) -> Values:
    """`manifold` with each entry replaced by `fn(t, y, args)`."""
    return jtu.tree_map(
        lambda entry: jtu.tree_map(jnp.asarray, entry.fn(t, y, args)), manifold, is_leaf=is_entry
    )


def conserved_values(manifold: Manifold, t: RealScalarLike, y: Y, args: Args) -> Values:
    """`manifold` with each entry replaced by its conserved value, zero for a constraint."""
    return jtu.tree_map(
        lambda entry: jtu.tree_map(jnp.asarray, entry.conserved_value(t, y, args)),
        manifold,
        is_leaf=is_entry,
    )


_CONSTRAINTS_MAX = 2048


def check_outputs(manifold: Manifold, t: RealScalarLike, y: Y, args: Args) -> None:
    """Raises unless the functions of the manifold return real floating-point arrays, in total at
    least one scalar and at most as many as the state has unknowns."""
    count = 0
    for name, entry in named_entries(manifold):
        for leaf in jtu.tree_leaves(eqx.filter_eval_shape(entry.fn, t, y, args)):
            _check_output(name, leaf)
            count += math.prod(jnp.shape(leaf))
        _check_rate(name, entry, t, y, args)
    unknowns = sum(jnp.size(leaf) for leaf in jtu.tree_leaves(y))
    if count == 0:
        raise ValueError("The functions in `manifold` return no array: there is nothing to keep.")
    if count > unknowns:
        raise ValueError(
            f"`manifold` has {count} scalar constraints, but the state has only {unknowns} "
            "unknowns: no state can satisfy them in general. Remove dependent ones."
        )
    if count > _CONSTRAINTS_MAX:
        raise ValueError(
            f"`manifold` has {count} scalar constraints, but a projection solves with a full "
            f"matrix of at most {_CONSTRAINTS_MAX} rows. Project parts of the state by solves of "
            "their own."
        )


def _check_rate(name: str, entry: Any, t: RealScalarLike, y: Y, args: Args) -> None:
    if rate_of(entry) is None:
        return
    rates, outputs = (eqx.filter_eval_shape(fn, t, y, args) for fn in (entry.rate, entry.fn))
    for leaf in jtu.tree_leaves(rates):
        if not is_real(leaf):
            raise TypeError(
                f"`rate` of `{name}` returns {dtype_of(leaf)}, but it must return real numbers, as "
                "`fn` does. Return their real part."
            )
    if tree_shapes(rates) != tree_shapes(outputs):
        raise ValueError(
            f"`rate` of `{name}` returns {tree_shapes(rates)}, but its `fn(t, y, args)` returns "
            f"{tree_shapes(outputs)}. Return the derivative of each element in its place."
        )


def check_values(manifold: Manifold, values: Values, t: RealScalarLike, y: Y, args: Args) -> None:
    """Raises unless the conserved values have the shapes of what the first integrals return."""
    entries = named_entries(manifold)
    treedef = jtu.tree_structure(manifold, is_leaf=is_entry)
    try:
        flat = treedef.flatten_up_to(values)
    except ValueError as error:
        raise ValueError(
            f"`value` has the structure {jtu.tree_structure(values)}, which is not that of "
            f"`manifold`, {treedef}. Put the conserved value in the place of each `FirstIntegral` "
            "and `None` in the place of each `Constraint`."
        ) from error
    for (name, entry), value in zip(entries, flat, strict=True):
        check_numbers("value", value)
        output = eqx.filter_eval_shape(entry.fn, t, y, args)
        if isinstance(entry, FirstIntegral) and tree_shapes(output) != tree_shapes(value):
            raise ValueError(
                f"The conserved value of `{name}` has the structure {tree_shapes(value)}, but its "
                f"`fn(t, y, args)` returns {tree_shapes(output)}. Both must be the same."
            )


def _check_output(name: str, leaf: Any) -> None:
    if not hasattr(leaf, "dtype"):
        if isinstance(leaf, float):
            return
        got = f"{leaf!r}, which is no array"
    elif not jnp.issubdtype(leaf.dtype, jnp.floating):
        got = f"an array of dtype {leaf.dtype}"
    else:
        return
    raise TypeError(
        f"`fn` of `{name}` must return a PyTree of real floating-point arrays, but it returned "
        f"{got}. Convert it, for example by `jnp.asarray(..., dtype=float)`, or split a complex "
        "value into its real and its imaginary part."
    )
