"""A file: a line that names the format, a line of JSON, and the arrays. No pickle.

diffrax-conserve network <version of the format> <SHA-256 of all that follows>
{"kind": "DeepONet", "config": {...}, ..., "size": <bytes of the arrays, or null>}
<the arrays, as `equinox.tree_serialise_leaves` writes them, compressed by zlib if `size` is given>
"""

import hashlib
import io
import json
import os
import zlib
from pathlib import Path
from typing import Any, NoReturn

import jax
import jax.numpy as jnp
import numpy as np

from ..._replace_file import replace_file

PathLike = str | os.PathLike[str]

_MAGIC = b"diffrax-conserve network"
_VERSION = 3
# The largest accepted compression ratio. Arrays that compress better are stored uncompressed, so
# that no small file can unpack to a large amount of memory.
_RATIO_MAX = 16


def write(path: PathLike, header: dict[str, Any], body: bytes) -> None:
    """Writes the file atomically. The header must be expressible in JSON."""
    compressed = zlib.compress(body, 9)
    size = len(body) if len(body) <= _RATIO_MAX * len(compressed) else None
    try:
        text = json.dumps(header | {"size": size}, allow_nan=False).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(
            f"`info` must hold only what JSON can express, but {error}. Convert arrays by "
            "`.tolist()`, and leave NaN and infinity out."
        ) from error
    rest = text + b"\n" + (body if size is None else compressed)
    first = b"%s %d %s\n" % (_MAGIC, _VERSION, hashlib.sha256(rest).hexdigest().encode())
    replace_file(Path(path), lambda temporary: temporary.write_bytes(first + rest))


def read(path: PathLike) -> tuple[Any, bytes]:
    """The header, which may be any JSON value, and the bytes after it."""
    content = Path(path).read_bytes()
    first, _, rest = content.partition(b"\n")
    words = first[len(_MAGIC) : 200].split()
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
            f"{version}, and this version reads {_VERSION}. Upgrade diffrax-conserve."
        )
    if version < _VERSION:
        raise ValueError(
            f"The file {path} was written by a version of diffrax-conserve before the first "
            f"release: its format is {version}, and this version reads {_VERSION}. Train the "
            "network again."
        )
    if hashlib.sha256(rest).hexdigest() != digest:
        raise ValueError(
            f"The file {path} is truncated or damaged: its contents do not match its checksum. "
            "Copy or train it again."
        )
    text, _, body = rest.partition(b"\n")
    try:
        return json.loads(text), body
    except (ValueError, RecursionError) as error:
        refuse(path, error)


def unpacked_size(header: dict[str, Any], body: bytes) -> int:
    """The size of the arrays in bytes. Raises `ValueError` if it is too large for the file."""
    size = header["size"]
    if size is None:
        return len(body)
    if size > _RATIO_MAX * len(body):
        raise ValueError(f"its size of {size} is too large for {len(body)} compressed bytes")
    return size


def unpack(header: dict[str, Any], body: bytes) -> bytes:
    """The bytes of the arrays."""
    if header["size"] is None:
        return body
    stream = zlib.decompressobj()
    raw = stream.decompress(body, unpacked_size(header, body) + 1)
    if len(raw) != header["size"] or not stream.eof or stream.unused_data:
        raise ValueError("its arrays are not of the size that it declares")
    return raw


def refuse(path: PathLike, reason: Exception | str) -> NoReturn:
    """Raises the error for a file with the right checksum but invalid contents."""
    error = reason if isinstance(reason, Exception) else None
    while isinstance(reason, Exception) and isinstance(reason.__cause__, Exception):
        reason = reason.__cause__  # equinox's own message only names the leaf
    raise ValueError(
        f"The file {path} is malformed, though its checksum is right: {str(reason)[:300]}. "
        "`diffrax_conserve.save` does not write such files."
    ) from error


def read_leaf(file: io.BytesIO, like: Any) -> Any:
    """The next array of a file, for `equinox.tree_deserialise_leaves`.

    Its shape is compared with that of `like` before memory is allocated.
    """
    if np.lib.format.read_magic(file) != (1, 0):
        raise ValueError("an array has another version of numpy's format")
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
    if shape != like.shape or fortran or dtype.hasobject:
        raise ValueError(f"an array has shape {shape} and dtype {dtype}, not {like}")
    if dtype == np.dtype("V2"):  # numpy does not know bfloat16
        dtype = np.dtype(jnp.bfloat16)
    data = file.read(like.size * dtype.itemsize)
    with jax.numpy_dtype_promotion("standard"):
        return jnp.asarray(np.frombuffer(data, dtype).reshape(shape))
