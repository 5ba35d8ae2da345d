"""One line for several cameras: by example and by property."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from channel_emu.model.channel import Channel
from channel_emu.model.link import DISCIPLINES, Event, EventKind, Link
from channel_emu.model.nanoseconds import NEVER_NS
from channel_emu.model.settings import channel_from_mapping
from channel_emu.virtual.simulate import simulate
from tests.channel_emu.virtual.test_simulate import same

MS = 10**6


def shared(discipline: str, delays_ms: list[float], **more: object) -> dict[str, Link]:
    section = {
        "service": {"law": "trace", "delays_ms": delays_ms},
        "discipline": discipline,
        "server": {"shared": True},
        **more,
    }
    channel = Channel(channel_from_mapping(section), 0)
    return {camera: channel.link(camera) for camera in "cab"}  # joined in any order


def play(links: dict[str, Link], offers: list[tuple[str, float]], until_ms: float = 1000) -> list[str]:
    """What happened to whom, in order: "a0 delivered 10" is camera a's frame 0 at 10 ms."""
    told: list[tuple[int, bool, str]] = []

    def note(camera: str, events: list[Event]) -> None:
        for e in events:  # at one instant what ends comes before what starts in its place
            line = f"{camera}{e.transit.number} {e.kind} {e.at_ns / MS:g}"
            told.append((e.at_ns, e.kind is EventKind.STARTED, line))

    for camera, at_ms in offers:
        note(camera, links[camera].offer(round(at_ms * MS))[1])
        for other, link in links.items():
            if link.next_event_ns <= at_ms * MS:
                note(other, link.advance(round(at_ms * MS)))
    for camera, link in links.items():
        note(camera, link.advance(round(until_ms * MS)))
    return [line for _, _, line in sorted(told)]


def started(lines: list[str]) -> list[str]:
    return [line.split()[0] for line in lines if " started " in line]


OFFERS = [("a", 0), ("a", 1), ("c", 2), ("b", 3), ("c", 4), ("a", 5)]


@pytest.mark.parametrize(
    ("discipline", "offers", "limit", "served", "dropped"),
    [
        # c waits since 2 (c1 replaces c0 and keeps its turn), a since 1.
        ("newest-waits", OFFERS, 9, "a0 a2 c1 b0", "a1 superseded 5"),
        ("fcfs", OFFERS, 9, "a0 a1 c0 b0 c1 a2", None),
        ("fcfs", [("a", 0), ("b", 1), ("c", 2), ("b", 3)], 2, "a0 b0 c0", "b1 dropped_busy 3"),
        ("parallel", [("a", 0), ("b", 1), ("c", 2)], 2, "a0 b0", "c0 dropped_busy 2"),
        ("drop-new", [("a", 0), ("b", 4), ("b", 10)], 9, "a0 b1", "b0 dropped_busy 4"),
        ("lcfs-preempt", [("a", 0), ("b", 4)], 9, "a0 b0", "a0 superseded 4"),
    ],
)
def test_order_of_service(
    discipline: str, offers: list[tuple[str, float]], limit: int, served: str, dropped: str | None
) -> None:
    lines = play(shared(discipline, [10], queue_limit=limit), offers)
    assert started(lines) == served.split()
    assert dropped is None or dropped in lines


def test_what_others_cause_is_told_at_once() -> None:
    """b waits behind a. Whoever asks for time first, b learns of its start with its own next question."""
    links = shared("newest-waits", [10, 7])
    links["a"].offer(0)
    assert links["b"].offer(2 * MS)[1] == [] and links["b"].next_event_ns == NEVER_NS
    assert [e.kind for e in links["a"].advance(12 * MS)] == [EventKind.DELIVERED]
    assert links["b"].next_event_ns == 10 * MS  # in the past: there is news
    assert [(e.kind, e.at_ns) for e in links["b"].advance(12 * MS)] == [(EventKind.STARTED, 10 * MS)]
    assert links["b"].next_event_ns == 20 * MS
    # One clock for all: c cannot offer before what was decided already.
    assert links["c"].offer(5 * MS)[0].offered_ns == 12 * MS and links["c"].clock_backwards == 1


def test_a_reset_breaks_one_camera_and_frees_the_line() -> None:
    links = shared("fcfs", [50], faults={"reset": {"mean_interval_ms": 1e9}})
    links["a"]._next_reset_ns = 20 * MS  # at an instant of our choice
    links["a"]._update_next_event()
    lines = play(links, [("a", 0), ("b", 1), ("a", 2)])
    assert lines == ["a0 started 0", "a0 broken 20", "a1 broken 20", "b0 started 20", "b0 delivered 70"]
    assert links["a"].resets == 1 and links["b"].resets == 0


def test_a_camera_has_one_link() -> None:
    channel = Channel(channel_from_mapping({"server": {"shared": True}}), 0)
    channel.link("a")
    with pytest.raises(ValueError, match="a has a link to this server already"):
        channel.link("a")


SECTIONS = [{"discipline": discipline, "server": {"shared": True}} for discipline in DISCIPLINES]


@pytest.mark.parametrize("discipline", DISCIPLINES)
def test_a_shared_line_for_one_camera_is_a_line_of_its_own(discipline: str) -> None:
    own = channel_from_mapping({"preset": "ch6", "discipline": discipline})
    alone = channel_from_mapping({"preset": "ch6", "discipline": discipline, "server": {"shared": True}})
    a, b = (simulate(config, 1, 20, 3).runs[0] for config in (own, alone))
    assert same(a, b)


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from(SECTIONS),
    st.lists(st.sampled_from([0.0, 1.0, 7.5, 1e12]), min_size=1, max_size=4),
    st.lists(st.tuples(st.sampled_from("abc"), st.sampled_from([0, 1, 5, 33])), min_size=1, max_size=40),
    st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 200)), max_size=6),
    st.booleans(),
)
def test_every_frame_ends_once_and_looking_changes_nothing(
    section: dict, delays_ms: list[float], gaps: list[tuple[str, int]], looks: list[tuple[str, int]], faults: bool
) -> None:
    chance = {"loss": {"probability": 0.3}, "reset": {"mean_interval_ms": 40.0}}
    section = {
        "service": {"law": "trace", "delays_ms": delays_ms},
        "queue_limit": 3,
        "faults": chance if faults else {},
        **section,
    }
    fates = []
    for extra in ([], looks):
        channel = Channel(channel_from_mapping(section), 1)
        links = {camera: channel.link(camera) for camera in "abc"}
        steps = [(sum(gap for _, gap in gaps[: i + 1]), 1, i) for i in range(len(gaps))]
        steps += [(at, 0, k) for k, (_, at) in enumerate(extra)]
        transits, ends = [], Counter()
        for at_ms, is_offer, i in sorted(steps):
            if is_offer:
                transit, events = links[gaps[i][0]].offer(at_ms * MS)
                transits.append(transit)
            else:
                events = links[extra[i][0]].advance(at_ms * MS)
            ends.update(id(e.transit) for e in events if e.kind is not EventKind.STARTED)
        for link in links.values():
            events = link.advance(2000 * MS)
            ends.update(id(e.transit) for e in events if e.kind is not EventKind.STARTED)
        assert max(ends.values(), default=0) <= 1
        assert len(transits) == len(ends) + sum(link.in_flight for link in links.values())
        server = links["a"].server
        assert server.busy <= (3 if section["discipline"] == "parallel" else 1)
        assert server.waiting == sum(len(link.waiting) for link in links.values())
        assert server.busy or not server.waiting
        fates.append([(t.offered_ns, t.started_ns, t.due_ns, t.outcome, t.ended_ns) for t in transits])
    assert fates[0] == fates[1]
