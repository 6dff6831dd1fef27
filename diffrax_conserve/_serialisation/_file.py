"""A file: a line that names the format, a JSON header, and the arrays. No pickle.

diffrax-conserve network <version of the format> <SHA-256 of all that follows>
{"kind": "DeepONet", "config": {...}, "arrays": [{"shape": ..., "dtype": ...}, ...], ...}
<the arrays, little-endian, one after the other, compressed by zlib>
"""

import hashlib
import json
import math
import os
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._files import replace_file

PathLike = str | os.PathLike[str]

_MAGIC = b"diffrax-conserve network"
_VERSION = 2


def write(path: PathLike, header: dict[str, Any], arrays: list[np.ndarray]) -> None:
    """Replaces the file as a whole. The header must be expressible in JSON."""
    shapes = [{"shape": list(x.shape), "dtype": x.dtype.name} for x in arrays]
    try:
        text = json.dumps(header | {"arrays": shapes}, allow_nan=False).encode()
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"`info` must hold only what JSON can express, but {error}. Convert arrays by "
            "`.tolist()`, and leave NaN and infinity out."
        ) from error
    raw = b"".join(x.astype(x.dtype.newbyteorder("<")).tobytes() for x in arrays)
    rest = text + b"\n" + zlib.compress(raw, 9)
    first = b"%s %d %s\n" % (_MAGIC, _VERSION, hashlib.sha256(rest).hexdigest().encode())
    replace_file(Path(path), lambda temporary: temporary.write_bytes(first + rest))


def read(path: PathLike) -> tuple[dict[str, Any], bytes]:
    """The header, and the bytes of the arrays."""
    content = Path(path).read_bytes()
    first, _, rest = content.partition(b"\n")
    words = first[len(_MAGIC) :].split()
    if not content.startswith(_MAGIC + b" ") or len(words) != 2 or not words[0].isdigit():
        if content and (_MAGIC + b" ").startswith(content[: len(_MAGIC) + 1]):
            raise ValueError(f"The file {path} is truncated: it ends in its first line.")
        raise ValueError(
            f"The file {path} does not hold a network that `diffrax_conserve.save` wrote."
        )
    version, digest = int(words[0]), words[1].decode(errors="replace")
    if version > _VERSION:
        raise ValueError(
            f"The file {path} was written by a newer version of diffrax-conserve: its format is "
            f"{version}, and this version reads up to {_VERSION}. Upgrade diffrax-conserve."
        )
    if version < _VERSION:
        raise ValueError(
            f"The file {path} was written by a version of diffrax-conserve before the first "
            "release, which this version does not read. Train the network again."
        )
    if hashlib.sha256(rest).hexdigest() != digest:
        raise ValueError(
            f"The file {path} is truncated or damaged: its contents do not match its checksum. "
            "Copy or train it again."
        )
    text, _, compressed = rest.partition(b"\n")
    return json.loads(text), zlib.decompress(compressed)


class _Entry(NamedTuple):
    shape: tuple[int, ...]
    dtype: np.dtype

    @property
    def size(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize


def split(entries: list[dict[str, Any]], raw: bytes) -> list[jax.Array]:
    """The arrays that the header lists."""
    arrays, start = [], 0
    for item in entries:
        entry = _Entry(tuple(item["shape"]), np.dtype(item["dtype"]).newbyteorder("<"))
        piece = raw[start : start + entry.size]
        arrays.append(jnp.asarray(np.frombuffer(piece, entry.dtype).reshape(entry.shape)))
        start += entry.size
    return arrays
