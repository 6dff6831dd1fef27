"""Checks of the numbers and functions that a user passes."""

import contextlib
import inspect
import textwrap
from collections.abc import Iterator
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.core
import jax.errors
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np


def dtype_of(x: Any) -> Any:
    """The dtype of a number or an array; `object` for anything else."""
    if hasattr(x, "dtype"):
        return x.dtype
    return np.asarray(x).dtype if eqx.is_array_like(x) else np.dtype(object)


def is_real(x: Any) -> bool:
    """Whether `x` is a real number or an array of them, and not a string or a boolean."""
    return any(jnp.issubdtype(dtype_of(x), kind) for kind in (jnp.floating, jnp.integer))


def check_number(
    name: str,
    value: Any,
    *,
    least: float | None = None,
    above: float | None = None,
    optional: bool = True,
) -> None:
    """Raises unless `value` is a real number or an array of them, at least `least` and greater than
    `above`, not NaN; or a tracer; or, if `optional`, `None`."""
    if isinstance(value, jax.core.Tracer) or (optional and value is None):
        return
    ending = ", or `None`." if optional else "."
    if not is_real(value):
        raise TypeError(f"`{name}` is {value!r}, but it must be a real number{ending}")
    number, wanted = np.asarray(value), ""
    if above is not None and not np.all(number > above):
        wanted = "positive" if above == 0 else f"greater than {above:g}"
    if least is not None and not np.all(number >= least):
        wanted = f"at least {least:g}" if np.isfinite(least) else "a number"
    if wanted:
        raise ValueError(f"`{name}` is {value}, but it must be {wanted}{ending}")


def check_numbers(name: str, tree: Any, *, least: float | None = None) -> None:
    """`check_number` of every leaf of `tree`."""
    for path, leaf in jtu.tree_leaves_with_path(tree):
        check_number(name + jtu.keystr(path), leaf, least=least)


def check_counts(**counts: Any) -> None:
    for name, value in counts.items():
        if isinstance(value, bool) or not isinstance(value, int | np.integer):
            raise TypeError(f"`{name}` is {value!r}, but it must be an integer.")
        if value < 1:
            raise ValueError(f"`{name}` is {value}, but it must be a positive integer.")


def check_float64(user: str) -> None:
    """Raises unless JAX has float64, which `user` needs for the solve that it judges by."""
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise RuntimeError(
            f"`{user}` needs float64. Set the environment variable `JAX_ENABLE_X64=1`, or call "
            "`jax.config.update('jax_enable_x64', True)` before any array is made."
        )


def check_function(name: str, fn: Any, call: str, returns: str) -> None:
    """Raises unless `fn` takes as many arguments as `call`, such as `"fn(t, y, args)"`."""
    remedy = f"Pass a function `{call}` that returns {returns}."
    if not callable(fn):
        raise TypeError(f"{name} is of type `{type(fn).__name__}`, not callable. {remedy}")
    try:
        given = inspect.signature(fn)
    except ValueError:  # some builtins have no signature
        return
    wanted = parameters(call)
    try:
        given.bind(*wanted)
    except TypeError as error:
        raise TypeError(f"{name} has the parameters `{given}`. {remedy}") from error
    positional = [p.name for p in given.parameters.values() if p.kind <= p.POSITIONAL_OR_KEYWORD]
    for name_of_it, expected in zip(positional, wanted, strict=False):
        if name_of_it != expected and name_of_it in wanted:
            raise TypeError(f"{name} has the parameters `{given}`, in another order. {remedy}")


def parameters(call: str) -> list[str]:
    """The names `t`, `y` and `args` of `"fn(t, y, args)"`."""
    return call.partition("(")[2].removesuffix(")").split(", ")


@contextlib.contextmanager
def noting_call(name: str, call: str, *given: Any) -> Iterator[None]:
    """Adds to an error inside of a function of the user its name, and what it was given."""
    try:
        yield
    except Exception as error:
        known = dict(zip(parameters(call), given, strict=True))
        shown = (f"{p} = {textwrap.shorten(eqx.tree_pformat(x), 200)}" for p, x in known.items())
        note = f"{name} was called as `{call}`, here with {', '.join(shown)}."
        note += _needs(error, known.get("args", ""))
        if note not in getattr(error, "__notes__", []):
            error.add_note(note)
        raise


@contextlib.contextmanager
def one_of(states: Any, args: Any = ()) -> Iterator[None]:
    """Tells with an error of a function what it was called with: one of `states`, and `args`, if no
    `noting_call` inside tells that."""
    try:
        yield
    except Exception as error:
        one = jtu.tree_map(lambda x: jnp.asarray(x)[0], states)
        note = f"Here a state is {eqx.tree_pformat(one)}. {ONE_STATE}"
        error.add_note(note + _needs(error, args))
        raise


def _needs(error: Exception, args: Any) -> str:
    if args is None and "NoneType" in str(error):
        return " The function seems to need `args`: pass them here too."
    if isinstance(error, _NEEDS_NUMBERS) or str(error).startswith("Reverse-mode diff"):
        return (
            " JAX traces and differentiates it: in the place of `if` write `jnp.where`, of `float`,"
            " `math` and `numpy` functions of `jax.numpy`, of a `while_loop` a `lax.scan`."
        )
    return ""


_NEEDS_NUMBERS = jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError


ONE_STATE = (
    "For one state `y` write `jax.tree.map(lambda x: x[None], y)`: `states`, as all arguments of "
    "many states, have a leading axis over them."
)


def check_solution(sol: Any, user: str) -> None:
    if not isinstance(sol, dfx.Solution):
        raise TypeError(
            f"`sol` is of type `{type(sol).__name__}`, but `{user}` takes the `diffrax.Solution` "
            "that `diffrax.diffeqsolve` returned."
        )


def found_in(sol: Any, kind: type, user: str, solver: str) -> Any:
    """What of a `kind` is in the state of the solver; raises if there is nothing."""
    check_solution(sol, user)
    is_one = lambda x: isinstance(x, kind)  # noqa: E731
    found = [*filter(is_one, jtu.tree_leaves(sol.solver_state, is_leaf=is_one))]
    if not found:
        raise ValueError(
            f"`sol` holds no `{kind.__name__}`. Solve with {solver}, and with "
            "`saveat=SaveAt(..., solver_state=True)`."
        )
    return found[0]
