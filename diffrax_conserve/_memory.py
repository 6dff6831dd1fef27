"""What is found once and needed again, as long as it is among the latest."""

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any


class Memory:
    """What was found, by its key. The least recently used is forgotten, and found again if it is
    needed, so that a process that traces ever new functions does not grow with their number."""

    def __init__(self, most: int = 256):
        self._most, self._found = most, OrderedDict[Any, tuple[Any]]()
        self._lock = threading.Lock()

    def __call__(self, key: Any, find: Callable[[], Any]) -> Any:
        with self._lock:
            found = self._found.get(key)
        found = found or (find(),)  # which may ask for others
        with self._lock:
            found = self._found.setdefault(key, found)
            self._found.move_to_end(key)
            if len(self._found) > self._most:
                self._found.popitem(last=False)
        return found[0]

    def __len__(self) -> int:
        return len(self._found)
