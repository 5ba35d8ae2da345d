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


def offer_many(subject: Link, count: int) -> list:
    transits = [subject.offer(i * 10 * MS, None, 1000)[0] for i in range(count)]
    subject.advance(count * 10 * MS)
    return transits


def fates(subject: Link, at_ms: tuple[int, ...]) -> list[str]:
    """What becomes of frames that are offered at some instants."""
    transits = [subject.offer(at * MS)[0] for at in at_ms]
    subject.advance(1000 * MS)
    return [str(t.outcome) for t in transits]


def test_loss_takes_its_share_and_its_time_of_each_camera_alone():
    transits = [offer_many(link({"loss": {"probability": 0.2}}, camera=c), 4000) for c in ("cam00", "cam01")]
    lost = [[t.outcome is EventKind.LOST for t in each] for each in transits]
    assert sum(lost[0]) == pytest.approx(800, abs=4 * (4000 * 0.16) ** 0.5)
    assert all(t.ended_ns == t.offered_ns + MS for t in transits[0])
    assert abs(np.corrcoef(lost)[0, 1]) < 5 / 4000**0.5


def test_losses_follow_the_state_in_which_transmission_starts():
    section = {"preset": "ch6", "arrivals": "as-offered", "discipline": "parallel", "faults": {"loss": [0.1, 0.6]}}
    transits = offer_many(Channel(channel_from_mapping(section), 3).link("a"), 6000)
    for state, chance in ((0, 0.1), (1, 0.6)):
        lost = [t.outcome is EventKind.LOST for t in transits if t.state == state]
        assert len(lost) > 2000
        assert np.mean(lost) == pytest.approx(chance, abs=4 * (chance * (1 - chance) / len(lost)) ** 0.5)


def test_duplication_is_an_event_beside_the_delivery():
    subject = link({"duplication": {"probability": 1.0}})
    events = subject.offer(0)[1] + subject.advance(5 * MS)
    assert [e.kind for e in events] == [EventKind.STARTED, EventKind.DELIVERED, EventKind.DUPLICATED]
    assert subject.counts == {"delivered": 1, "duplicated": 1}


def test_corruption_flips_the_bytes_it_says():
    hit = [t for t in offer_many(link({"corruption": {"probability": 0.3, "count": 3}}), 2000) if t.flips]
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


def test_image_and_depth_are_damaged_as_one_run_of_bytes():
    places = tuple(((k + 0.5) / 100, 255) for k in range(100))
    request = frames_pb2.PushRequest(payload=bytes(80), depth=frames_pb2.Depth(payload=bytes(20)))
    damage_frame(request, places)
    assert (request.payload, request.depth.payload) == (b"\xff" * 80, b"\xff" * 20)


def test_blackout_loses_what_is_on_the_way_during_a_window():
    for blackout, at_ms, lost in (
        # 79 arrives at 99; 100 and later overlap the window; 220 starts after it.
        ({"windows_ms": [[100, 200]]}, (0, 79, 100, 150, 190, 220), {100, 150, 190}),
        ({"windows_ms": [[100, 200]]}, (80, 200), {80}),  # the first arrives as it begins, the second starts as it ends
        ({"every_ms": 100, "for_ms": 10}, (0, 69, 95, 160, 185, 270, 350), {95, 185, 270}),
        ({"windows_ms": [[0, 1000]], "cameras": ["another"]}, (0,), set()),
    ):
        found = fates(link({"blackout": blackout}, delay_ms=20), at_ms)
        assert found == ["lost" if at in lost else "delivered" for at in at_ms]


def test_resets_break_what_is_inside_at_their_instants():
    subject = link({"reset": {"at_ms": [50, 55]}}, delay_ms=20, discipline="fcfs")
    assert fates(subject, (0, 35, 45, 60)) == ["delivered", "broken", "broken", "delivered"]
    assert subject.resets == 2
    subject = link({"reset": {"mean_interval_ms": 100.0}})
    subject.advance(100_000 * MS)
    assert subject.resets == pytest.approx(1000, abs=4 * 1000**0.5)


def test_bandwidth_adds_the_time_of_the_bytes():
    subject = link({"bandwidth": {"megabits_per_s": 8.0}})  # 1000 bytes a ms
    assert subject.offer(0, None, 20_000)[0].due_ns == (1 + 20) * MS


def test_an_unlisted_fault_changes_no_draw():
    """The same delays with and without faults: their numbers come from streams of their own."""
    section = {"service": {"law": "exponential", "mean_ms": 3.0}, "discipline": "parallel"}
    plain = Channel(channel_from_mapping(section), 4).link("a")
    section["faults"] = {"loss": {"probability": 0.5}, "corruption": {"probability": 1.0}}
    lossy = Channel(channel_from_mapping(section), 4).link("a")
    assert [t.due_ns for t in offer_many(plain, 200)] == [t.due_ns for t in offer_many(lossy, 200)]
