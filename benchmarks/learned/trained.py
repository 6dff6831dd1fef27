"""What the programs that train networks and judge them have in common: options, results, tables."""

import argparse
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np


def parser(description: str, systems: Iterable[str]) -> argparse.ArgumentParser:
    out = argparse.ArgumentParser(description=description.splitlines()[0])
    out.add_argument("--system", choices=list(systems), action="append")
    out.add_argument("--table", action="store_true", help="only print the table of the results")
    out.add_argument("--smoke", action="store_true", help="toy sizes, nothing is written")
    return out


def read_results(folder: Path) -> list[Any]:
    return [json.loads(file.read_text()) for file in sorted(folder.glob("*.json"))]


def number(x: float) -> float | None:
    """For JSON, which knows no infinity: `None` is a solve that failed."""
    return float(x) if np.isfinite(x) else None


def or_infinity(x: float | None) -> float:
    """What `number` was given, or infinity."""
    return np.inf if x is None else x


def median(values: Iterable[float | None]) -> float:
    return float(np.median([or_infinity(x) for x in values]))


def error(x: float | None) -> str:
    x = or_infinity(x)
    return f"{x:.1e}" if np.isfinite(x) else "failed"
