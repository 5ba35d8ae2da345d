"""Lines of progress with the time that is left, from what is done of all there is to do."""

from __future__ import annotations

import time


class Progress:
    """total: all there is to do, in seconds or steps of fitting, or any other measure of work."""

    def __init__(self, total: float) -> None:
        self.total, self.done = total, 0.0
        self._began = time.perf_counter()

    def did(self, amount: float) -> None:
        """So much more is done."""
        self.done += amount

    def left(self) -> str:
        """The time left, for people."""
        spent_s = time.perf_counter() - self._began
        left_s = spent_s * max(self.total - self.done, 0.0) / max(self.done, 1e-9)
        return f"{left_s / 60:.0f} min" if left_s >= 90 else f"{left_s:.0f} s"

    def say(self, what: str, where: str, told: str) -> None:
        """One line."""
        print(f"  {what:22} {where:20} {told}; {self.left()} left", flush=True)
