"""First integrals, constraints, and the PyTrees of them that define a manifold."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from ._custom_types import Args, ConstraintFn, Manifold, RealScalarLike, Values, Y
from ._hashable import Hashable
from ._options import check_function, check_numbers, dtype_of, is_real, noting_call
from ._tree import tree_shapes, tree_size


def _arrays(value: Values | None) -> Values | None:
    check_numbers("value", value)
    # Python numbers would be static for JAX: another value would be another compilation.
    return jtu.tree_map(jnp.asarray, value)


@final
class FirstIntegral(Hashable):
    r"""A function $I(t, y, args)$ that is constant along the exact solution, or has a known rate.

    The manifold is $\{y : I(t, y, args) = \text{conserved value}\}$. The conserved value is
    $I(t_0, y_0, args)$ of the solve in which it is used, or `value`.

    With `rate`, this is a *balance law*, such as that of energy and dissipated power: the conserved
    value at $t$ is larger by $\int_{t_0}^t \mathrm{rate}(s, y(s), args)\, ds$, by Gauss quadrature
    with four nodes along the dense output of the wrapped solver. See [Balances and
    bounds][balances-and-bounds].

    !!! example

        ```python
        import diffrax_conserve as dfc

        energy = dfc.FirstIntegral(lambda t, y, args: (y[0] ** 2 + y[1] ** 2) / 2)
        ```
    """

    fn: ConstraintFn
    value: Values | None = eqx.field(default=None, kw_only=True, converter=_arrays)
    rate: ConstraintFn | None = eqx.field(default=None, kw_only=True)

    def __check_init__(self):
        check_function("`fn` of a `FirstIntegral`", self.fn, "fn(t, y, args)", "real arrays")
        if self.rate is not None:
            check_function("`rate` of a `FirstIntegral`", self.rate, "rate(t, y, args)", "dI/dt")


FirstIntegral.__init__.__doc__ = r"""**Arguments:**

- `fn`: a callable `fn(t, y, args)` (a function or an [`equinox.Module`][], whose arrays can then
    be differentiated) that returns a PyTree of real arrays. Every element is one first integral. It
    is differentiated in reverse mode, in which JAX has no `while_loop`.
- `value`: the value of `fn` at the start of a solve. Default: that of the initial state. A state
    that has another one is moved there by the first projection of the solve, in the metric of the
    steps: at a turning point it changes what has moved. To choose where it lands, start from
    `diffrax_conserve.project(manifold, y0, projection=...)`.
- `rate`: a callable `rate(t, y, args)` that returns $dI/dt = \partial_t I + \nabla I \cdot f$ along
    the exact solution, like what `fn` returns. Default: zero.
"""


@final
class Constraint(Hashable):
    r"""A function $g(t, y, args)$ that is zero along the exact solution.

    !!! example

        ```python
        import jax.numpy as jnp
        import diffrax_conserve as dfc

        unit_length = dfc.Constraint(lambda t, q, args: jnp.sum(q**2) - 1)
        ```
    """

    fn: ConstraintFn
    # No fields: its function is zero and stays so.
    value = rate = None

    def __check_init__(self):
        check_function("`fn` of a `Constraint`", self.fn, "fn(t, y, args)", "real arrays")

    def derivative(self, vector_field: Callable[[RealScalarLike, Any, Args], Any]) -> "Constraint":
        r"""The hidden constraint $\dot g = \partial_t g + \partial_y g \cdot f = 0$.

        For a constraint on the positions of a mechanism it is that on the velocities, and depends
        only on the part $q' = v$ of the field.

        **Arguments:**

        - `vector_field`: $f$, called as `vector_field(t, y, args)`.

        **Raises:**

        `TypeError` if `vector_field` cannot be called so.

        !!! example

            ```python
            import diffrax_conserve as dfc
            import jax.numpy as jnp

            rod = dfc.Constraint(lambda t, y, args: jnp.sum(y[0] ** 2) - 1)
            velocity = rod.derivative(lambda t, y, args: (y[1], jnp.array([0.0, -9.81])))
            ```
        """
        check_vector_field(vector_field)
        return Constraint(LieDerivative(self.fn, vector_field))


Constraint.__init__.__doc__ = r"""**Arguments:**

- `fn`: a callable `fn(t, y, args)`, as of a [`diffrax_conserve.FirstIntegral`][]. Every element of
    what it returns is one scalar constraint.
"""


class LieDerivative(eqx.Module):
    """The derivative of a function along a vector field, `∂_t g + ∂_y g · f`, by one forward pass.
    It is a module and not a closure, so that JAX compiles it once for equal functions."""

    fn: ConstraintFn
    vector_field: Callable[[RealScalarLike, Any, Args], Any]

    def __call__(self, t: RealScalarLike, y: Y, args: Args) -> Values:
        t = jnp.asarray(t, jnp.result_type(float, t))
        y = jtu.tree_map(jnp.asarray, y)
        slope = slope_of(self.vector_field, t, y, args)
        _, along = jax.jvp(lambda t, y: self.fn(t, y, args), (t, y), (jnp.ones_like(t), slope))
        return along


def slope_of(vector_field: Any, t: RealScalarLike, y: Y, args: Args) -> Y:
    """The value of a vector field, like the state; an error tells how the field was called."""
    with noting_call("`vector_field`", "vector_field(t, y, args)", t, y, args):
        return slope_like(y, vector_field(t, y, args))


def slope_like(y: Y, slope: Any, name: str = "vector_field", of: str = "y") -> Y:
    """The value of a vector field, cast to the dtypes of the state. Raises if a leaf has another
    shape than that of the state and is no Python number, which is broadcast."""
    if jtu.tree_structure(slope) == jtu.tree_structure(y):
        pairs = zip(jtu.tree_leaves(slope), jtu.tree_leaves(y), strict=True)
        if all(
            isinstance(f, int | float | complex) or jnp.shape(f) == jnp.shape(x) for f, x in pairs
        ):
            return jtu.tree_map(
                lambda x, f: jnp.broadcast_to(jnp.asarray(f, x.dtype), x.shape), y, slope
            )
    raise ValueError(
        f"`{name}` returns the structure {tree_shapes(slope)}, but it must return a PyTree like "
        f"`{of}`, which has {tree_shapes(y)}."
    )


def check_vector_field(vector_field: Any) -> None:
    returns = "the slope at `y`; of a `diffrax.ODETerm` pass its `vector_field`"
    check_function("`vector_field`", vector_field, "vector_field(t, y, args)", returns)


def is_entry(x: Any) -> bool:
    return isinstance(x, FirstIntegral | Constraint)


def has_value(entry: Any) -> bool:
    """Whether it is known without a solve what an entry is at its start: zero or its `value`."""
    return isinstance(entry, Constraint) or entry.value is not None


def check_manifold(manifold: Manifold) -> None:
    entries = named_entries(manifold)
    if not entries:
        raise ValueError(
            f"`manifold` is {manifold!r}: there is nothing to conserve, or to measure. Give a "
            "`FirstIntegral` or `Constraint`. Only a `ManifoldProjection` with bounds, as "
            "`projection=SimplifiedNewton(lower=0)`, takes `()`: its states are within them."
        )
    for name, entry in entries:
        if not is_entry(entry):
            raise TypeError(
                f"`{name}` is {entry!r}, which is neither a `FirstIntegral` nor a `Constraint`. "
                "Wrap a function: `FirstIntegral(fn)` keeps it constant, `Constraint(fn)` at zero."
            )


def named_entries(manifold: Manifold, root: str = "manifold") -> list[tuple[str, Any]]:
    """The entries of a manifold, with the names that messages give them, such as
    `manifold['energy']`."""
    flat, _ = jtu.tree_flatten_with_path(manifold, is_leaf=is_entry)
    return [(f"{root}{jtu.keystr(path)}", entry) for path, entry in flat]


def entry_names(manifold: Manifold) -> tuple[str, ...]:
    return tuple(name for name, _ in named_entries(manifold))


def evaluate(manifold: Manifold, t: RealScalarLike, y: Y, args: Args) -> Values:
    """`manifold` with each entry replaced by `fn(t, y, args)`."""
    value = lambda entry: jtu.tree_map(jnp.asarray, at_full_precision(entry.fn, t, y, args))  # noqa: E731
    return jtu.tree_map(value, manifold, is_leaf=is_entry)


def at_full_precision(fn: ConstraintFn, t: RealScalarLike, y: Y, args: Args) -> Values:
    """`fn(t, y, args)`, with matrix products of full precision. By default a GPU multiplies
    matrices in float32 with inputs of three digits (TensorFloat-32), which no tolerance could allow
    for."""
    with jax.default_matmul_precision("highest"):
        return fn(t, y, args)


def noting_call_of(name: str, t: RealScalarLike, y: Y, args: Args) -> AbstractContextManager[None]:
    return noting_call(f"`fn` of `{name}`", "fn(t, y, args)", t, y, args)


def conserved_values(
    manifold: Manifold,
    t: RealScalarLike,
    y: Y,
    args: Args,
    given: Values | None = None,
    root: str = "manifold",
) -> Values:
    """`manifold` with each entry replaced by the value that a solve from `(t, y, args)` conserves.

    For a constraint that is zero. For a first integral it is what `given` holds in its place; if
    nothing is given, its own `value`; and without that, `fn(t, y, args)`. Raises unless all fit
    each other and the state.
    """
    entries, treedef = named_entries(manifold, root), jtu.tree_structure(manifold, is_leaf=is_entry)
    values = [entry.value for _, entry in entries]
    if given is not None:
        try:
            values = treedef.flatten_up_to(given)
        except ValueError as error:
            raise ValueError(
                f"`value` has the structure {jtu.tree_structure(given)}, which is not that of "
                f"`manifold`, {treedef}. Put the conserved value in the place of each "
                "`FirstIntegral` and `None` in the place of each `Constraint`."
            ) from error
    found = []
    for (name, entry), value in zip(entries, values, strict=True):
        with noting_call_of(name, t, y, args):
            output = at_full_precision(entry.fn, t, y, args)
        _check_output(name, entry, output, t, y, args)
        if isinstance(entry, Constraint):
            if value is not None:
                raise ValueError(
                    f"`value` has {value!r} in the place of `{name}`, which is a `Constraint` and "
                    "is kept at zero. Put `None` there, or make it a `FirstIntegral`."
                )
            value = jtu.tree_map(jnp.zeros_like, output)
        elif given is None and value is None:
            value = output
        else:
            check_numbers("value", value)
            _check_shapes(f"The conserved value of `{name}` has the structure", value, output)
        found.append(jtu.tree_map(jnp.asarray, value))
    if tree_size(found) == 0:
        raise ValueError("The functions in `manifold` return no array: there is nothing to keep.")
    return treedef.unflatten(found)


def _check_output(
    name: str, entry: Any, output: Values, t: RealScalarLike, y: Y, args: Args
) -> None:
    for leaf in jtu.tree_leaves(output):
        if not jnp.issubdtype(dtype_of(leaf), jnp.floating):
            raise TypeError(
                f"`fn` of `{name}` must return a PyTree of real floating-point arrays, but it "
                f"returned {leaf!r}. Convert it, for example by `jnp.asarray(..., dtype=float)`, "
                "or split a complex value into its real and its imaginary part."
            )
    if entry.rate is not None:
        with noting_call(f"`rate` of `{name}`", "rate(t, y, args)", t, y, args):
            rates = eqx.filter_eval_shape(entry.rate, t, y, args)
        _check_shapes(f"`rate` of `{name}` returns", rates, output)
        if not all(map(is_real, jtu.tree_leaves(rates))):
            raise TypeError(
                f"`rate` of `{name}` returns {jtu.tree_map(dtype_of, rates)}. Return real numbers."
            )


def _check_shapes(what: str, given: Any, output: Any) -> None:
    if tree_shapes(given) != tree_shapes(output):
        raise ValueError(
            f"{what} {tree_shapes(given)}, but `fn` returns {tree_shapes(output)}: both must agree."
        )
