"""Conversion and rounding of times.

The emulator's times are int64 nanoseconds since the channel's origin; float milliseconds occur only in
configurations and reports. All rounding is defined here.
"""

from __future__ import annotations

# 146 years, after the end of any run; twice as much still fits into an int64.
NEVER_NS = 2**62
_NEVER = float(NEVER_NS)


def to_ns(span_ms: float) -> int:
    """Milliseconds to the nearest nanosecond, at most NEVER_NS."""
    return saturating_round(span_ms * 1e6)


def saturating_round(span_ns: float) -> int:
    """A non-negative float of nanoseconds to the nearest int, at most NEVER_NS."""
    return NEVER_NS if span_ns >= _NEVER else int(span_ns + 0.5)


def saturating_add(instant_ns: int, span_ns: int) -> int:
    """The instant ``span_ns`` later, at most NEVER_NS."""
    return min(instant_ns + span_ns, NEVER_NS)
