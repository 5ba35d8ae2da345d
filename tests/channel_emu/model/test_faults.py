from __future__ import annotations

import numpy as np
import pytest

from channel_emu.model.channel import Channel
from channel_emu.model.faults.corruption import damage, damage_frame
from channel_emu.model.link import EventKind, Link
from channel_emu.model.settings import channel_from_mapping
from freshfield.v1 import frames_pb2

MS = 10**6


def link(faults: dict, delay_ms: float = 1.0, camera: str = "cam00", discipline: str = "drop-new") -> Link:
    service = {"law": "deterministic", "mean_ms": delay_ms}
    section = {"service": service, "faults": faults, "discipline": discipline}
    return Channel(channel_from_mapping(section), 11).link(camera)


def offer_many(subject: Link, count: int, size: int = 1000) -> list:
    transits = [subject.offer(i * 10 * MS, None, size)[0] for i in range(count)]
    subject.advance(count * 10 * MS)
    return transits


def test_loss_takes_its_share_and_its_time() -> None:
    transits = offer_many(link({"loss": {"probability": 0.2}}), 4000)
    lost = [t for t in transits if t.outcome is EventKind.LOST]
    assert len(lost) == pytest.approx(800, abs=4 * (4000 * 0.16) ** 0.5)
    assert all(t.ended_ns == t.offered_ns + MS for t in lost)


def test_cameras_lose_independently() -> None:
    links = [link({"loss": {"probability": 0.5}}, camera=camera) for camera in ("cam00", "cam01")]
    lost = [[t.outcome is EventKind.LOST for t in offer_many(each, 2000)] for each in links]
    assert abs(np.corrcoef(lost)[0, 1]) < 5 / 2000**0.5


def test_duplication_is_an_event_beside_the_delivery() -> None:
    subject = link({"duplication": {"probability": 1.0}})
    events = subject.offer(0)[1] + subject.advance(5 * MS)
    assert [e.kind for e in events] == [EventKind.STARTED, EventKind.DELIVERED, EventKind.DUPLICATED]
    assert subject.counts == {"delivered": 1, "duplicated": 1}


def test_corruption_flips_the_bytes_it_says() -> None:
    transits = offer_many(link({"corruption": {"probability": 0.3, "count": 3}}), 2000)
    hit = [t for t in transits if t.flips]
    assert len(hit) == pytest.approx(600, abs=4 * (2000 * 0.21) ** 0.5)
    payload = bytes(range(256)) * 4
    for t in hit[:50]:
        damaged = damage(payload, t.flips)
        changed = sum(a != b for a, b in zip(payload, damaged))
        assert len(t.flips) == 3 and len(damaged) == len(payload) and 1 <= changed <= 3
    assert damage(b"", hit[0].flips) == b""
    masks = [mask for t in hit for _, mask in t.flips]  # even from 1 to 255
    assert (min(masks), max(masks)) == (1, 255) and len(set(masks)) > 240
    assert np.mean(masks) == pytest.approx(128, abs=4 * 73.6 / len(masks) ** 0.5)


def test_blackout_loses_what_is_on_the_way_during_a_window() -> None:
    subject = link({"blackout": {"windows_ms": [[100, 200]]}}, delay_ms=20)
    fates = {at: subject.offer(at * MS)[0] for at in (0, 79, 100, 150, 190, 220)}
    subject.advance(1000 * MS)
    lost = [at for at, t in fates.items() if t.outcome is EventKind.LOST]
    assert lost == [100, 150, 190]  # 79 arrives at 99; 100 and later overlap the window; 220 starts after it
    subject = link({"blackout": {"every_ms": 100, "for_ms": 10}}, delay_ms=20)
    fates = {at: subject.offer(at * MS)[0] for at in (0, 69, 95, 160, 185, 350)}
    subject.advance(1000 * MS)
    assert [at for at, t in fates.items() if t.outcome is EventKind.LOST] == [95, 185]
    subject = link({"blackout": {"windows_ms": [[0, 1000]], "cameras": ["another"]}}, delay_ms=20)
    fate = subject.offer(0)[0]
    subject.advance(1000 * MS)
    assert fate.outcome is EventKind.DELIVERED


def test_resets_break_what_is_inside_at_their_instants() -> None:
    subject = link({"reset": {"at_ms": [50, 55]}}, delay_ms=20, discipline="fcfs")
    fates = [subject.offer(at * MS)[0] for at in (0, 35, 45, 60)]
    subject.advance(100 * MS)
    assert [str(t.outcome) for t in fates] == ["delivered", "broken", "broken", "delivered"]
    assert subject.resets == 2 and fates[1].ended_ns == 50 * MS
    subject = link({"reset": {"mean_interval_ms": 100.0}})
    subject.advance(100_000 * MS)
    assert subject.resets == pytest.approx(1000, abs=4 * 1000**0.5)


def test_bandwidth_adds_the_time_of_the_bytes() -> None:
    subject = link({"bandwidth": {"megabits_per_s": 8.0}})  # 1000 bytes a ms
    transit, _ = subject.offer(0, None, 20_000)
    assert transit.due_ns == (1 + 20) * MS


def test_losses_follow_the_state_in_which_transmission_starts() -> None:
    section = {"preset": "ch6", "arrivals": "as-offered", "discipline": "parallel", "faults": {"loss": [0.1, 0.6]}}
    transits = offer_many(Channel(channel_from_mapping(section), 3).link("a"), 6000)
    for state, chance in ((0, 0.1), (1, 0.6)):
        lost = [t.outcome is EventKind.LOST for t in transits if t.state == state]
        assert len(lost) > 2000
        assert np.mean(lost) == pytest.approx(chance, abs=4 * (chance * (1 - chance) / len(lost)) ** 0.5)


def test_an_unlisted_fault_changes_no_draw() -> None:
    """The same delays with and without faults: their numbers come from streams of their own."""
    section = {"service": {"law": "exponential", "mean_ms": 3.0}, "discipline": "parallel"}
    plain = Channel(channel_from_mapping(section), 4).link("a")
    section["faults"] = {"loss": {"probability": 0.5}}
    lossy = Channel(channel_from_mapping(section), 4).link("a")
    assert [t.due_ns for t in offer_many(plain, 200)] == [t.due_ns for t in offer_many(lossy, 200)]


def test_image_and_depth_are_damaged_as_one_run_of_bytes() -> None:
    places = tuple(((k + 0.5) / 100, 255) for k in range(100))
    request = frames_pb2.PushRequest(payload=bytes(80), depth=frames_pb2.Depth(payload=bytes(20)))
    damage_frame(request, places)
    assert (request.payload, request.depth.payload) == (b"\xff" * 80, b"\xff" * 20)
    plain = frames_pb2.PushRequest(payload=bytes(100))
    damage_frame(plain, places)
    assert plain == frames_pb2.PushRequest(payload=damage(bytes(100), places)) and not plain.HasField("depth")
