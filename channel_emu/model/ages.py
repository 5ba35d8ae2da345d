"""Mean and peak age of information of one link (thesis 5.1 to 5.6)."""

from __future__ import annotations

from collections.abc import Iterable


class RunningAge:
    """The ages of one link, in constant memory, from its deliveries in the order of time.

    deliveries: (delivered, generated) instants in ns, to begin with.
    """

    def __init__(self, deliveries: Iterable[tuple[int, int]] = ()) -> None:
        self._first_ns = self._delivered_ns = self._generated_ns = 0
        self._area = 0  # ns², whole: a float would lose the last tooth of a long run
        self._peaks_ns = 0
        self._teeth = 0
        for delivered_ns, generated_ns in deliveries:
            self.add(delivered_ns, generated_ns)

    def add(self, delivered_ns: int, generated_ns: int) -> None:
        """Add a delivery; one of an older frame than the newest one changes nothing (5.4)."""
        if self._teeth and generated_ns <= self._generated_ns:
            return
        if self._teeth:
            self._area += self._tooth(delivered_ns)
            self._peaks_ns += delivered_ns - self._generated_ns
        else:
            self._first_ns = delivered_ns
        self._teeth += 1
        self._delivered_ns, self._generated_ns = delivered_ns, generated_ns

    def mean_age_ms(self, end_ns: int) -> float | None:
        """Time average from the first delivery to ``end_ns``; None if nothing arrived before it."""
        if not self._teeth or end_ns <= self._first_ns:
            return None
        return (self._area + self._tooth(end_ns)) / 2 / (end_ns - self._first_ns) / 1e6

    def peak_age_ms(self) -> float | None:
        """Mean of the ages just before each delivery; None with fewer than two."""
        return self._peaks_ns / (self._teeth - 1) / 1e6 if self._teeth > 1 else None

    def _tooth(self, until_ns: int) -> int:
        """Twice the area under the current tooth."""
        length = until_ns - self._delivered_ns
        return length * (2 * (self._delivered_ns - self._generated_ns) + length)


def mean_of_known(values: list[float | None]) -> float | None:
    """Mean of the values that are not None, one per camera or link; None if there are none."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None
