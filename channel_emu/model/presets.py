"""Named channels (those of the thesis and others), which a scenario may override key by key."""

from __future__ import annotations

from typing import Any, NamedTuple


class Preset(NamedTuple):
    """about: one line for people. channel: its section, in the short notation."""

    about: str
    channel: dict[str, Any]


def _two_states(sojourn_ms: int) -> str:
    """s = G is the low-traffic state, s = B the high-traffic one (6.24)."""
    return f"mu1=1/{sojourn_ms},mu2=1/{sojourn_ms},states=low/high"


_CH6 = {"arrivals": "mmpp:1/120ms,1/30ms", "service": "exp:30ms,exp:60ms", "discipline": "newest-waits"}

PRESETS = {
    "ideal": Preset("no delay, no loss: every frame arrives when it is offered", {}),
    "ch5": Preset(
        "thesis 5.5: a frame every 30 ms, one is sent at a time, the others are dropped (D/G/1/0)",
        {"arrivals": "periodic:30ms", "service": "exp:60ms", "discipline": "drop-new"},
    ),
    "ch6": Preset(
        "thesis 6.2.5 and 6.5: Gilbert-Elliott traffic of 30 ms a state, Poisson sampling, the newest waits",
        {**_CH6, "chain": _two_states(30)},
    ),
    "ch6-high": Preset(
        "thesis 6.5.1: high traffic only", {**_CH6, "arrivals": "poisson:1/60ms", "service": "exp:60ms"}
    ),
    "ch6-low": Preset("thesis 6.5.1: low traffic only", {**_CH6, "arrivals": "poisson:1/120ms", "service": "exp:30ms"}),
    "ch6-slow": Preset(
        "as ch6, but a state lasts 3 s: longer than a decision, so a policy can exploit it",
        {**_CH6, "chain": _two_states(3000)},
    ),
    # In both states of ch6 a buffer fills about equally fast (few frames with short delays, or many with
    # long ones), so the best wait is the same. Here only the delays differ, tenfold, and a state lasts 3 s:
    # the best wait depends on the state, which can be inferred from the frames' ages.
    "swing": Preset(
        "delays of 15 and 150 ms alternate, 3 s per state: the best decision depends on the state",
        {**_CH6, "arrivals": "periodic:30ms", "service": "exp:15ms,exp:150ms", "chain": _two_states(3000)},
    ),
    "gilbert-elliott": Preset(
        "losses in bursts: a good state of 1 s loses 1 % of the frames, a bad one of 100 ms loses half",
        {
            "arrivals": "periodic:30ms",
            "service": "det:20ms",
            "discipline": "parallel",
            "chain": "mu1=1/1000,mu2=1/100,states=good/bad",
            "faults": {"loss": [0.01, 0.5]},
        },
    ),
}


def preset(name: str) -> dict[str, Any]:
    """The ``channel:`` section of one of PRESETS. Raises ValueError for another name."""
    if name not in PRESETS:
        raise ValueError(f"expected one of {', '.join(PRESETS)}, got {name!r}")
    return dict(PRESETS[name].channel)
