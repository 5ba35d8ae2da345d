"""The wall clock adds the delay error to virtual time, and nothing else."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np

from channel_emu.model import trace
from channel_emu.model.link import EventKind
from channel_emu.model.trace import Record
from tests.channel_emu.live.emulator import CAMERAS, emulate
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


async def test_a_trace_replayed_twice_is_decided_and_delivered_alike(tmp_path: Path) -> None:
    """Two live replays at different paces and seeds: the decisions are the recording's, each delivery as
    long after its offer as recorded, later by the delay error alone."""
    first, second = tmp_path / "1", tmp_path / "2"
    await record(tmp_path / "0", FAST, 0.004, 60)
    recorded = trace.read(tmp_path / "0" / "t.jsonl")
    await record(first, CHAPTER_5, 0.006, 60, seed=11, replay=recorded)
    await record(second, PARALLEL, 0.009, 60, seed=12, replay=recorded)
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
