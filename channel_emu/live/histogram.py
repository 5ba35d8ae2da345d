"""A histogram of durations in fixed memory, for percentiles over a run of any length."""

from __future__ import annotations

import math

import numpy as np

from channel_emu.live import live_emulator_constants as tuned

_PER_DECADE = 100  # bins of 2.3 %
_DECADES = 9  # 100 ns to 100 s
_FLOOR_MS = 1e-4


class Histogram:
    """Durations in ms: logarithmic bins, exact count, mean and maximum.

    total: another histogram that counts every duration of this one too.
    """

    def __init__(self, total: Histogram | None = None) -> None:
        self._bins = [0] * (_PER_DECADE * _DECADES + 2)
        self._total = total
        self.count = 0
        self.sum_ms = 0.0
        self.max_ms = 0.0

    def add(self, value_ms: float) -> None:
        """Count one duration; negative ones count as zero."""
        value = value_ms if value_ms > 0.0 else 0.0
        index = 0 if value < _FLOOR_MS else int(math.log10(value / _FLOOR_MS) * _PER_DECADE) + 1
        if index >= len(self._bins):
            index = -1
        histogram: Histogram | None = self
        while histogram is not None:
            histogram.count += 1
            histogram.sum_ms += value
            if value > histogram.max_ms:
                histogram.max_ms = value
            histogram._bins[index] += 1
            histogram = histogram._total

    @property
    def mean_ms(self) -> float | None:
        """Exact mean; None if empty."""
        return self.sum_ms / self.count if self.count else None

    def percentile_ms(self, percent: float) -> float | None:
        """Upper edge of the bin that holds the percentile, at most the maximum, which is that of the last bin; None if
        empty."""
        if not self.count:
            return None
        rank = max(1, math.ceil(percent / 100 * self.count))
        index = int(np.searchsorted(np.cumsum(self._bins), rank))
        last = index == len(self._bins) - 1
        return self.max_ms if last else min(_FLOOR_MS * 10 ** (index / _PER_DECADE), self.max_ms)

    def summary(self) -> dict[str, float | None]:
        """Mean, percentiles and maximum in ms; None if empty."""
        found = {f"p{p}": self.percentile_ms(p) for p in (50, 95, 99)}
        return {"mean": self.mean_ms, **found, "max": self.max_ms if self.count else None}

    def linear(self) -> tuple[list[float], list[float]]:
        """The histogram in N = ``DRAWN_BINS`` equal bins up to the percentile ``DRAWN_PERCENT``, for drawing: edges
        (N + 1,) in ms, and counts (N,); both empty without durations."""
        top = self.percentile_ms(tuned.DRAWN_PERCENT)
        if not top:
            return [], []
        edges = np.linspace(0.0, top, tuned.DRAWN_BINS + 1)
        upper = _FLOOR_MS * 10.0 ** (np.arange(len(self._bins)) / _PER_DECADE)
        upper[-1] = max(upper[-1], self.max_ms)
        # The cumulative count is known at the logarithmic edges; between them it is interpolated linearly.
        below = np.interp(edges, np.append(0.0, upper), np.append(0.0, np.cumsum(self._bins)))
        return edges.round(4).tolist(), np.diff(below).round(2).tolist()
