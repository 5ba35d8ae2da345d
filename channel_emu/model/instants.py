"""Instants and spans of the emulator: int64 nanoseconds since the channel's origin, exact in any order.

Milliseconds (float) exist in configurations and reports only. Rounding happens in one place, so that the
kernel and the Python link arrive at the same integer.
"""

from __future__ import annotations

NS_PER_MS = 1_000_000
# 146 years: "not before the end of any run", with room to add to without overflowing an int64.
NEVER_NS = 2**62
_NEVER = float(NEVER_NS)


def to_ns(span_ms: float) -> int:
    """Milliseconds to the nearest nanosecond, saturating at NEVER_NS (an endless delay stays one)."""
    return saturate(span_ms * 1e6)


def saturate(span_ns: float) -> int:
    """A non-negative float of nanoseconds to the nearest int, saturating at NEVER_NS."""
    return NEVER_NS if span_ns >= _NEVER else int(span_ns + 0.5)


def later(instant_ns: int, span_ns: int) -> int:
    """instant + span, never beyond NEVER_NS."""
    return min(instant_ns + span_ns, NEVER_NS)
