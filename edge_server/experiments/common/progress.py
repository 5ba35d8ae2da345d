"""Lines of progress with the time that is left."""

from __future__ import annotations

import time


class Progress:
    """Progress of a long computation.

    total: amount of work, in seconds, fitting steps or any other unit.
    """

    def __init__(self, total: float) -> None:
        self.total, self.done = total, 0.0
        self._began = time.perf_counter()

    def advance(self, amount: float) -> None:
        """Count ``amount`` more as done."""
        self.done += amount

    def time_left(self) -> str:
        """The time left at the pace so far, for people."""
        spent_s = time.perf_counter() - self._began
        left_s = spent_s * max(self.total - self.done, 0.0) / max(self.done, 1e-9)
        return f"{left_s / 60:.0f} min" if left_s >= 90 else f"{left_s:.0f} s"

    def report(self, what: str, where: str, result: str) -> None:
        """Print one line."""
        print(f"  {what:22} {where:20} {result}; {self.time_left()} left", flush=True)
