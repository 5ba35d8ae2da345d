"""The small parts of the live emulator: timer, histogram, wire reader, priority."""

from __future__ import annotations

import asyncio
import os
import sys
import time
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from channel_emu.live import call_flow, priority, timer
from channel_emu.live.call_flow import CallFlow
from channel_emu.live.frame_proxy import damage_payload
from channel_emu.live.histogram import Histogram
from channel_emu.live.live_link import Message
from channel_emu.live.timer import LoopTimer
from channel_emu.model.link import EventKind
from freshfield.frame import FrameRejected, from_request, to_request
from freshfield.streams import ServedCall
from freshfield.v1 import frames_pb2 as pb
from tests.channel_emu.live.emulator import frame_of


@pytest.mark.parametrize("platform", [sys.platform, "elsewhere"])
async def test_timer_fires_once_armed_and_never_early(platform: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timer.sys, "platform", platform)
    fired: list[int] = []
    woken = asyncio.Event()

    def fire() -> None:
        fired.append(time.perf_counter_ns())
        woken.set()

    subject = LoopTimer(fire)
    for span_ns in (0, 3_000_000, 20_000_000):
        woken.clear()
        begun = time.perf_counter_ns()
        subject.arm(10 * 10**9)
        subject.arm(span_ns)  # instead of what was armed before
        async with asyncio.timeout(5):
            await woken.wait()
        assert fired[-1] >= begun + span_ns
    subject.arm(30_000_000)
    subject.close()
    await asyncio.sleep(0.06)
    assert len(fired) == 3


@given(st.lists(st.floats(0, 1e6), min_size=1, max_size=300), st.sampled_from([1, 50, 95, 99, 100]))
def test_histogram_percentiles_are_within_a_bin(values: list[float], percent: int) -> None:
    histogram = Histogram()
    for value in values:
        histogram.add(value)
    exact = float(np.percentile(values, percent, method="inverted_cdf"))
    found = histogram.percentile_ms(percent)
    assert found is not None and found <= max(values)
    if exact < 9e4:
        assert exact * 0.999999 <= found <= max(exact * 1.0234, 1e-4)
    assert histogram.count == len(values) and histogram.max_ms == max(values)
    assert histogram.mean_ms == pytest.approx(np.mean(values))


def test_histogram_of_nothing_and_of_negatives() -> None:
    histogram = Histogram()
    assert histogram.percentile_ms(50) is None and histogram.mean_ms is None
    assert histogram.linear() == ([], [])
    histogram.add(-3.0)
    assert histogram.max_ms == 0.0 and histogram.percentile_ms(99) == 0.0 and histogram.linear() == ([], [])


def test_damage_changes_the_payload_and_nothing_else() -> None:
    raw = to_request(frame_of("cam00", "s", 1, 5)).SerializeToString()
    damaged = damage_payload(raw, ((0.5, 1), (0.9, 255)))
    before, after = pb.PushRequest.FromString(raw), pb.PushRequest.FromString(damaged)
    assert after.header == before.header and after.crc32c == before.crc32c
    assert sum(a != b for a, b in zip(before.payload, after.payload)) == 2
    with pytest.raises(FrameRejected, match="damaged") as refused:
        from_request(after)
    assert refused.value.reason == "crc_mismatch"


@pytest.mark.parametrize("short_slice", [True, False])
def test_without_real_time_the_priority_is_raised(monkeypatch: pytest.MonkeyPatch, short_slice: bool) -> None:
    def forbidden(*_: object) -> None:
        raise PermissionError

    asked: list[int] = []
    monkeypatch.setattr(os, "sched_setscheduler", forbidden, raising=False)
    monkeypatch.setattr(os, "nice", asked.append)
    monkeypatch.setattr(priority, "_shorten_slice", lambda: short_slice)
    assert priority.raise_priority() == ("short-slice" if short_slice else "nice")
    assert len(asked) == 1 and asked[0] < 0
    monkeypatch.setattr(os, "nice", forbidden)
    assert priority.raise_priority() == ("short-slice" if short_slice else "normal")


@pytest.mark.parametrize(
    ("machine", "system", "number"),
    [("x86_64", "Linux", 314), ("aarch64", "Linux", 274), ("riscv64", "Linux", None), ("x86_64", "Darwin", None)],
)
def test_short_slices_are_asked_for_where_the_call_is_known(monkeypatch, machine, system, number) -> None:
    library = mock.Mock()
    library.syscall.return_value = 0
    monkeypatch.setattr(priority.platform, "machine", lambda: machine)
    monkeypatch.setattr(priority.platform, "system", lambda: system)
    monkeypatch.setattr(priority.ctypes, "CDLL", lambda _: library)
    assert priority._shorten_slice() is (number is not None)
    assert [call.args[:2] for call in library.syscall.call_args_list] == ([] if number is None else [(number, 0)])


async def test_dropped_messages_hold_no_bytes() -> None:
    flow = CallFlow(0, ServedCall(mock.Mock()), None, lambda: 0)
    dropped, kept = Message(b"x" * 100, "call0", 0, flow), Message(b"y", "call0", 1, flow)
    flow.settle(dropped, EventKind.LOST)
    flow.settle(kept, EventKind.DELIVERED)
    assert dropped.raw == b"" and kept.raw == b"y"


async def test_behind_a_message_in_the_link_no_more_are_read_than_the_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(call_flow, "_MOST_BEHIND", 100)
    link, read, written = mock.Mock(calls=set()), [], []
    flow = CallFlow(0, ServedCall(mock.Mock()), link, lambda: 0)

    async def endless() -> bytes:
        read.append(len(read))
        await asyncio.sleep(0)
        return b"x"

    async def write(raw: bytes) -> None:
        written.append(raw)

    carrying = asyncio.create_task(flow.carry(endless, write))
    for _ in range(1000):
        await asyncio.sleep(0)
    assert len(read) == 100 and not written
    for message in list(flow._messages):
        flow.settle(message, EventKind.DELIVERED)
    for _ in range(1000):
        await asyncio.sleep(0)
    assert len(written) >= 100 and len(read) > 100  # it goes on
    carrying.cancel()
