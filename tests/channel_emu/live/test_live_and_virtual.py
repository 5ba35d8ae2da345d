"""The wall clock adds the delay error to virtual time, and nothing else."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest

from channel_emu.model import trace
from channel_emu.model.ages import RunningAge
from channel_emu.model.channel import Channel
from channel_emu.model.link import EventKind
from channel_emu.model.trace import Record
from channel_emu.virtual.simulate import offer_all
from tests.channel_emu.decided_again import offers
from tests.channel_emu.live.emulator import CAMERAS, emulate, run
from tests.channel_emu.live.test_frame_stream import FAST, frame_account

CHAPTER_5 = {"preset": "ch5", "service": {"law": "exponential", "mean_ms": 8.0}}
PARALLEL = {"service": {"law": "exponential", "mean_ms": 12.0}, "discipline": "parallel"}
# Median delay error that a busy machine may have: cameras, emulator and edge share one event loop here.
TYPICAL_MS = 10.0


async def record(out: Path, section: dict, period_s: float, frames: int, **options) -> None:
    async with emulate(out, section, trace=out / "t.jsonl", **options) as r:
        await asyncio.gather(*(c.stream(frames, period_s) for c in r.cameras.values()))
        await r.settled()


def late_ms(records: list[Record]) -> np.ndarray:
    """The emulator's delay error, frame by frame."""
    return np.array([(r.actual_ns - r.ended_ns) / 1e6 for r in records if r.actual_ns is not None and r.ended_ns])


# Losses by state, and a line of a rate.
LOSSY = {**FAST, "faults": {"loss": [0.1, 0.5], "bandwidth": 400.0}}


@pytest.mark.parametrize("section", [FAST, LOSSY], ids=["ch6", "lossy"])
def test_ages_live_are_those_of_virtual_time_and_the_delay_error(tmp_path: Path, section: dict) -> None:
    """The trace's offers in virtual time deliver each frame when it is due, live a moment later: the age is
    greater by that moment, weighted by what the frame was worth."""
    run(record(tmp_path, section, 0.005, 100))
    found = trace.read(tmp_path / "t.jsonl")
    end_ns = max(max(r.offered_ns, r.ended_ns or 0, r.actual_ns or 0) for r in found.records)
    _, virtual = offer_all(Channel(found.config, found.seed), offers(found), end_ns)
    for camera, records in found.by_camera().items():
        assert [r.outcome for r in records] == [t.outcome for t in virtual[camera]]
        # A frame that leaves the link while the edge is stalled is broken and has no actual instant.
        came = [r for r in records if r.actual_ns is not None]
        due = [virtual[camera][r.number] for r in came]
        assert len(came) > 15
        live = RunningAge((r.actual_ns, r.offered_ns) for r in came)
        # Over the same span: the first tooth begins where the live one does.
        begin_ns = came[0].actual_ns
        virtual_age = RunningAge((max(t.due_ns, begin_ns), t.offered_ns) for t in due)
        live_ms, expected_ms = live.mean_age_ms(end_ns), virtual_age.mean_age_ms(end_ns)
        assert live_ms is not None and expected_ms is not None
        assert 0 <= live_ms - expected_ms <= late_ms(came).max()
    assert np.median(late_ms(found.records)) < TYPICAL_MS


def test_a_trace_replayed_twice_is_decided_and_delivered_alike(tmp_path: Path) -> None:
    """Two live replays at different paces and seeds: the decisions are the recording's, each delivery as
    long after its offer as recorded, later by the delay error alone."""
    first, second = tmp_path / "1", tmp_path / "2"
    run(record(tmp_path / "0", FAST, 0.004, 60))
    recorded = trace.read(tmp_path / "0" / "t.jsonl")
    run(record(first, CHAPTER_5, 0.006, 60, seed=11, replay=recorded))
    run(record(second, PARALLEL, 0.009, 60, seed=12, replay=recorded))
    frame_account(first)
    replays = [trace.read(out / "t.jsonl").by_camera() for out in (first, second)]
    apart_ms, errors_ms = [], []
    for camera in CAMERAS:
        then = recorded.by_camera()[camera]
        one, two = replays[0][camera], replays[1][camera]
        for known, a, b in zip(then, one, two, strict=True):
            assert known.outcome == a.outcome == b.outcome
            assert known.drawn_ns == a.drawn_ns == b.drawn_ns
            if known.outcome != EventKind.DELIVERED:
                continue
            lasted = [_lasted(r) for r in (known, a, b)]
            assert lasted[0] == lasted[1] == lasted[2]
            if a.actual_ns is None or b.actual_ns is None:  # the edge was stalled meanwhile
                continue
            apart_ms.append(abs((a.actual_ns - a.offered_ns) - (b.actual_ns - b.offered_ns)) / 1e6)
        errors_ms += [late_ms(one), late_ms(two)]
    error = np.concatenate(errors_ms)
    assert len(apart_ms) > 40 and max(apart_ms) <= error.max()
    assert np.median(apart_ms) < TYPICAL_MS


def _lasted(record: Record) -> int:
    assert record.ended_ns is not None
    return record.ended_ns - record.offered_ns
