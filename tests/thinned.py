"""A law over many cases, of which `make test` runs some and `make slow` the others."""

import zlib
from collections.abc import Callable, Iterable

import pytest


def some_of(
    arguments: str, cases: Iterable, *, ids: Iterable[str] | None = None, period: int
) -> Callable:
    """Parametrises a test by all `cases`; one in `period` runs by default, others for each test.

    Which ones follows from the name of the test, so that several laws reach all cases together.
    """

    cases = list(cases)
    ids = map(_name, cases) if ids is None else ids

    def decorate(test: Callable) -> Callable:
        first = zlib.crc32(test.__name__.encode()) % period
        params = [
            pytest.param(
                *(case if "," in arguments else (case,)),
                id=name,
                marks=() if i % period == first else pytest.mark.slow,
            )
            for i, (case, name) in enumerate(zip(cases, ids, strict=True))
        ]
        return pytest.mark.parametrize(arguments, params)(test)

    return decorate


def _name(case: object) -> str:
    """Of a function or a class its name, which is the same in all workers."""
    parts = case if isinstance(case, tuple) else (case,)
    return "-".join(getattr(part, "__name__", str(part)) for part in parts)
