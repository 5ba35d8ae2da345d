"""Channels with a name: the thesis's numbers, to be overridden key by key in a scenario."""

from __future__ import annotations

from typing import Any

# s = G is the low-traffic state, s = B the high-traffic one (6.24).
_STATES = ["low", "high"]


def _ch6(mean_sojourn_ms: float) -> dict[str, Any]:
    return {
        "arrivals": {"process": "poisson", "rate_per_ms": [1 / 120, 1 / 30]},
        "chain": {"mu1_per_ms": 1 / mean_sojourn_ms, "mu2_per_ms": 1 / mean_sojourn_ms, "states": _STATES},
        "service": {"law": "exponential", "mean_ms": [30.0, 60.0]},
        "service_state": "at-start",
        "discipline": "newest-waits",
    }


def _ch6_one_state(arrivals_every_ms: float, mean_delay_ms: float) -> dict[str, Any]:
    return {
        "arrivals": {"process": "poisson", "rate_per_ms": 1 / arrivals_every_ms},
        "service": {"law": "exponential", "mean_ms": mean_delay_ms},
        "discipline": "newest-waits",
    }


PRESETS: dict[str, dict[str, Any]] = {
    # Nothing happens: every frame arrives as it is offered.
    "ideal": {},
    # 5.5: C = 30 ms, exponential delays of mean 60 ms, D/G/1/0.
    "ch5": {
        "arrivals": {"process": "periodic", "period_ms": 30.0},
        "service": {"law": "exponential", "mean_ms": 60.0},
        "discipline": "drop-new",
    },
    # 6.2.5 and 6.5: Gilbert-Elliott, arrivals 1/120 and 1/30 a ms, delay rates 1/30 and 1/60 a ms in low and
    # high traffic, mu1 = mu2 = 1/30 a ms.
    "ch6": _ch6(30.0),
    # 6.5.1: one traffic state for good.
    "ch6-high": _ch6_one_state(60.0, 60.0),
    "ch6-low": _ch6_one_state(120.0, 30.0),
    # As ch6, but a state lasts 3 s: its memory outlives a decision, so there is something to learn.
    "ch6-slow": _ch6(3000.0),
    # In both states of ch6 a buffer fills about equally fast (few frames and short delays, many and
    # long ones), so that the best wait is the same. Here only delays differ, tenfold, and a state lasts 3 s:
    # what is best depends on the state, which the ages tell.
    "swing": {
        "arrivals": {"process": "periodic", "period_ms": 30.0},
        "chain": {"mu1_per_ms": 1 / 3000, "mu2_per_ms": 1 / 3000, "states": _STATES},
        "service": {"law": "exponential", "mean_ms": [15.0, 150.0]},
        "service_state": "at-start",
        "discipline": "newest-waits",
    },
}
