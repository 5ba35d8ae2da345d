"""Named channels (those of the thesis and others), which a scenario may override key by key, and channels
read from files of other tools."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any, NamedTuple

from channel_emu.model.notation import NotationError, read_text


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

FROM_FILES = {
    "mahimahi:FILE": "a Mahimahi trace: a line for each instant, in ms, at which 1500 bytes may leave",
    "errant:FILE:OPERATOR/COUNTRY/RAT/QUALITY": "of ERRANT's profiles.csv: half its latency, its upload rate",
}
"""Presets that are read from files of other tools."""


def preset(name: str, folder: Path) -> dict[str, Any]:
    """The ``channel:`` section of a preset.

    name: of PRESETS, or of the form of FROM_FILES. folder: what a file name in it is relative to.
    Raises NotationError if it is unknown, or its file cannot be read.
    """
    if name in PRESETS:
        return dict(PRESETS[name].channel)
    kind, _, rest = name.partition(":")
    if kind == "mahimahi" and rest:
        words = read_text(folder / rest).split()
        if not all(word.isdecimal() for word in words):
            raise NotationError(f"{rest}: expected a whole number of ms a line, as Mahimahi has them")
        return {"discipline": "fcfs", "faults": {"mahimahi": [int(word) for word in words]}}
    if kind == "errant" and rest.count(":") == 1:
        path, _, profile = rest.partition(":")
        return _errant(folder / path, profile)
    raise NotationError(f"expected one of {', '.join([*PRESETS, *FROM_FILES])}, got {name!r}")


_MOST_KBPS = 1e6  # above any operator of ERRANT; bounds the trace, in which 12 kbps are a packet a second


def _errant(path: Path, profile: str) -> dict[str, Any]:
    """Gamma delays with half the mean and standard deviation of the profile's round trip, followed by a line
    of the profile's upload rate, on which packets queue."""
    try:
        rows = list(csv.DictReader(read_text(path).splitlines()))
        found = {"/".join(list(row.values())[:4]).lower(): row for row in rows}
        if profile.lower() not in found:
            raise NotationError(f"{path}: no profile {profile!r}; write it like {next(iter(found), '-')}")
        row = found[profile.lower()]
        mean_ms, deviation_ms = float(row["latency_ms_avg"]) / 2, float(row["latency_ms_stdev"]) / 2
        service = {"law": "gamma", "mean_ms": mean_ms, "shape": (mean_ms / deviation_ms) ** 2}
        upload_kbps = float(row["upload_kbps"])
        if not 0.0 < upload_kbps <= _MOST_KBPS:
            raise NotationError(f"{path}: {profile}: upload_kbps is {upload_kbps:g}, expected up to {_MOST_KBPS:g}")
        packets_per_s = upload_kbps / 12  # of 1500 bytes
        span_s = 1 + int(1000 / packets_per_s)  # 1000 packets or more, so rounding to a whole one is harmless
        count = max(1, round(packets_per_s * span_s))
    except NotationError:
        raise
    except (csv.Error, KeyError, TypeError, ArithmeticError, ValueError) as error:
        raise NotationError(f"{path}: not profiles of ERRANT: {error}") from None
    times_ms = [-(-(i + 1) * span_s * 1000 // count) for i in range(count)]
    return {"service": service, "discipline": "parallel", "faults": {"mahimahi": {"opportunities_ms": times_ms}}}
