"""Atomic replacement of files."""

import os
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Any


def replace_file(path: Path, write: Callable[[Path], Any]) -> None:
    """Calls `write` such that no reader ever sees a partly written file.

    The target of a symbolic link is replaced, not the link. An existing file keeps its mode; the
    mode of a new one follows the umask.
    """
    path = Path(os.path.realpath(path))
    mode = path.stat().st_mode & 0o7777 if path.exists() else None
    temporary = path.with_name(f".{path.stem}-{secrets.token_hex(8)}{path.suffix}")
    flags = os.O_CREAT | os.O_EXCL | os.O_WRONLY
    os.close(os.open(temporary, flags, 0o666 if mode is None else mode))
    try:
        if mode is not None:
            temporary.chmod(mode)  # the umask may have removed some bits
        write(temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
