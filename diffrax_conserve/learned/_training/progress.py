"""The progress line of a training."""

import sys
from collections.abc import Callable

from .state import FitState

# Called with the number of epochs done, the total number, the last loss and the best criterion.
Progress = Callable[[int, int, float, float], None]


def report(
    progress: bool | Progress,
    state: FitState,
    epochs: int,
    first: int,
    elapsed: float,
    estimate: Callable[[], float],
) -> None:
    """Calls the function `progress`, or prints a line."""
    if progress is False:
        return
    windows = state.windows
    networks = 1 if windows is None else windows.errors.size - windows.present
    done, total = state.done + state.trained * epochs, (state.trained + networks) * epochs
    # Before the first epoch there is no loss yet.
    loss = float(state.carry.losses[state.done - 1]) if state.done else float(state.criteria[0])
    best = float(state.carry.best)
    if progress is not True:
        progress(done, total, loss, best)
        return
    # On a terminal one line is overwritten; in a file there is one line for each tenth of the
    # epochs.
    terminal = sys.stderr.isatty()
    if terminal or done == total or done % max(total // 10, 1) == 0:
        end = "\r" if terminal and done < total else "\n"
        parts = [f"epoch {done:>{len(str(total))}} of {total}: loss {loss:.3e}, best {best:.3e}"]
        error = estimate() if done else 0
        if error:
            parts.append(f"estimated error {error:.1e}")
        if done > first:
            parts.append(f"{elapsed / (done - first) * (total - done):.0f} s left")
        print(", ".join(parts), end=end, file=sys.stderr, flush=True)
