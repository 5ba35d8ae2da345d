"""The link's disciplines by example, for one camera and for several that share a server."""

from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from channel_emu.model.channel import Channel
from channel_emu.model.link import DISCIPLINES, Event, EventKind, Link, Transit
from channel_emu.model.nanoseconds import NEVER_NS
from channel_emu.model.settings import channel_from_mapping

MS = 10**6


def links(discipline: str, delays_ms: list[float], cameras: str = "a", **more) -> dict[str, Link]:
    section = {"service": {"law": "trace", "delays_ms": delays_ms}, "discipline": discipline, **more}
    channel = Channel(channel_from_mapping(section), 0)
    return {camera: channel.link(camera) for camera in cameras}


def play(links: dict[str, Link], offers: list[tuple[str, float]], until_ms: float = 1000) -> str:
    """What happened to whom, in order: "a0 s@2" is a start of camera a's frame 0 at 2 ms."""
    told: list[tuple[int, bool, str]] = []

    def note(camera: str, events) -> None:
        for e in events:  # at one instant what ends comes before what starts in its place
            line = f"{SIGNS.get(e.kind, str(e.kind))}{camera}{e.transit.number}@{e.at_ns / MS:g}"
            told.append((e.at_ns, e.kind is EventKind.STARTED, line))

    for camera, at_ms in offers:
        note(camera, links[camera].offer(round(at_ms * MS))[1])
        for other, link in links.items():
            if link.next_event_ns <= at_ms * MS:
                note(other, link.advance(round(at_ms * MS)))
    for camera, link in links.items():
        note(camera, link.advance(round(until_ms * MS)))
    return " ".join(line for _, _, line in sorted(told))


# s started, d delivered, b dropped busy, x superseded.
SIGNS = {"started": "s", "delivered": "d", "dropped_busy": "b", "superseded": "x"}


def test_what_a_busy_link_does_with_a_new_frame():
    """Offers: camera and instant. At 10 ms one comes as the first is done."""
    for discipline, delays_ms, offers, story in (
        # With room for two, waiting (fcfs) or in service (parallel).
        ("drop-new", [10, 5, 5, 5], "a0 a4 a10 a30", "sa0@0 ba1@4 da0@10 sa2@10 da2@15 sa3@30 da3@35"),
        ("newest-waits", [10, 5, 7], "a0 a2 a4", "sa0@0 xa1@4 da0@10 sa2@10 da2@17"),
        ("fcfs", [10, 5, 7], "a0 a1 a2 a3", "sa0@0 ba3@3 da0@10 sa1@10 da1@15 sa2@15 da2@22"),
        ("lcfs-preempt", [10, 5], "a0 a2", "sa0@0 xa0@2 sa1@2 da1@7"),
        ("parallel", [10, 5], "a0 a2 a3", "sa0@0 sa1@2 ba2@3 da1@7 da0@10"),
        # Several cameras. c waits since 2 (c1 replaces c0 and keeps its turn), a since 1.
        (
            "newest-waits",
            [10],
            "a0 a1 c2 b3 c4 a5",
            "sa0@0 xc0@4 xa1@5 da0@10 sa2@10 da2@20 sc1@20 dc1@30 sb0@30 db0@40",
        ),
        ("fcfs", [10], "a0 b1 c2 b3", "sa0@0 bb1@3 da0@10 sb0@10 db0@20 sc0@20 dc0@30"),
        ("parallel", [10], "a0 b1 c2", "sa0@0 sb0@1 bc0@2 da0@10 db0@11"),
        ("drop-new", [10], "a0 b4 b9 b10", "sa0@0 bb0@4 bb1@9 da0@10 sb2@10 db2@20"),
        ("lcfs-preempt", [10], "a0 b4", "sa0@0 xa0@4 sb0@4 db0@14"),
    ):
        several = {"server": {"shared": True}} if "b" in offers else {}
        subject = links(discipline, delays_ms, "cab", queue_limit=2, **several)  # joined in any order
        assert play(subject, [(word[0], float(word[1:])) for word in offers.split()]) == story


def test_what_others_cause_is_told_at_once():
    """b waits behind a. Whoever asks for time first, b learns of its start with its own next question."""
    subject = links("newest-waits", [10, 7], "cab", server={"shared": True})
    subject["a"].offer(0)
    assert subject["b"].offer(2 * MS)[1] == [] and subject["b"].next_event_ns == NEVER_NS
    assert [e.kind for e in subject["a"].advance(12 * MS)] == [EventKind.DELIVERED]
    assert subject["b"].next_event_ns == 10 * MS  # in the past: there is news
    assert [(e.kind, e.at_ns) for e in subject["b"].advance(12 * MS)] == [(EventKind.STARTED, 10 * MS)]
    assert subject["b"].next_event_ns == 20 * MS
    # One clock for all, held where it runs backwards: c cannot offer before what was decided already.
    assert subject["c"].offer(5 * MS)[0].offered_ns == 12 * MS and subject["c"].clock_backwards == 1
    assert subject["c"].advance(5 * MS) == [] and subject["c"].clock_backwards == 2


def test_a_reset_breaks_one_camera_and_frees_the_line():
    subject = links("fcfs", [50], "cab", server={"shared": True}, faults={"reset": {"mean_interval_ms": 1e9}})
    subject["a"]._next_reset_ns = 20 * MS  # at an instant of our choice
    subject["a"]._update_next_event()
    assert play(subject, [("a", 0), ("b", 1), ("a", 2)]) == "sa0@0 brokena0@20 brokena1@20 sb0@20 db0@70"
    assert subject["a"].resets == 1 and subject["b"].resets == 0


def test_sampling_takes_the_newest_offered_frame():
    subject = Channel(channel_from_mapping({"preset": "ch6-low", "service": "none"}), 3).link("cam00")
    transits = [subject.offer(i * 10 * MS)[0] for i in range(4000)]
    subject.advance(40_000 * MS)
    counts = Counter(str(t.outcome) for t in transits)
    # Sampled at the first arrival after each offer: one per 120 ms on average, and each within its period.
    assert counts["delivered"] == pytest.approx(4000 * (1 - 2.718281828 ** (-10 / 120)), rel=0.12)
    for t in transits:
        if t.outcome is EventKind.DELIVERED:
            assert t.started_ns is not None and 0 <= t.started_ns - t.offered_ns <= 10 * MS


@pytest.mark.parametrize("discipline", DISCIPLINES)
def test_a_flush_breaks_off_what_is_inside_and_frees_the_line(discipline):
    """What is due at the instant of the flush arrives."""
    subject = links(discipline, [20, 50, 50, 50])["a"]
    events = [e for at in (0, 18, 19) for e in subject.offer(at * MS)[1]]
    events += subject.flush(20 * MS)
    events += subject.offer(21 * MS)[1] + subject.advance(100 * MS)
    ends = Counter(str(e.kind) for e in events if e.kind is not EventKind.STARTED)
    expected = {"drop-new": 0, "newest-waits": 1, "fcfs": 2, "lcfs-preempt": 1, "parallel": 2}[discipline]
    assert ends["broken"] == expected and sum(ends.values()) == 4
    first = [] if discipline == "lcfs-preempt" else [20 * MS]
    assert [e.at_ns for e in events if e.kind is EventKind.DELIVERED] == [*first, 71 * MS]
    assert subject.in_flight == 0 and subject.flush(100 * MS) == []


def test_a_change_keeps_due_instants_and_lets_in_what_waits_to_be_sampled():
    section = {
        "arrivals": {"process": "poisson", "rate_per_ms": [1.0, 0.0]},
        "discipline": "parallel",
        "service": "det:50ms",
        "chain": {"mu1_per_ms": 1e-9, "mu2_per_ms": 1e-9, "initial": "s1"},
        "faults": {"reset": {"at_ms": [500]}},
    }
    channel = Channel(channel_from_mapping(section), 0)
    subject = channel.link("cam00")
    sampled = subject.offer(0)[0]
    subject.advance(30 * MS)
    waiting = subject.offer(40 * MS)[0]
    channel.set_by_hand(20.0, 0.0)
    channel.change(subject, 40 * MS)
    assert (waiting.started_ns, waiting.due_ns) == (40 * MS, 60 * MS)
    subject.advance(100 * MS)
    assert sampled.ended_ns == sampled.started_ns + 50 * MS
    lost = subject.offer(600 * MS)[0]
    assert lost.due_ns == 620 * MS and subject.resets == 0  # no other fault is in force
    channel.set_by_hand(0.0, 1.0)
    channel.change(subject, 610 * MS)
    subject.advance(700 * MS)
    assert (lost.outcome, lost.ended_ns) == (EventKind.LOST, 620 * MS)
    channel.set_by_scenario()
    channel.change(subject, 700 * MS)
    again = subject.offer(800 * MS)[0]
    subject.advance(900 * MS)
    assert again.drawn_ns == 50 * MS and again.started_ns > again.offered_ns


CAMERAS = "abc"
FAULTS = {"loss": 0.3, "duplication": 0.3, "corruption": 0.5, "reset": 40.0}
FAULTS |= {"blackout": {"every_ms": 20.0, "for_ms": 3.0}, "bandwidth": {"megabits_per_s": 8.0}}
TIMES = st.lists(st.tuples(st.integers(0, 1500), st.sampled_from(CAMERAS)), max_size=8)


Story = tuple[dict, int, list[tuple[int, str]]]
"""A channel, a seed, and what is offered: (instant in ns, camera)."""


@st.composite
def stories(draw: st.DrawFn) -> Story:
    section: dict = {
        "discipline": draw(st.sampled_from(DISCIPLINES)),
        "queue_limit": draw(st.integers(1, 4)),
        "server": {"shared": draw(st.booleans())},
        "faults": draw(st.fixed_dictionaries({}, optional={name: st.just(about) for name, about in FAULTS.items()})),
    }
    if draw(st.booleans()):
        section["chain"] = {"mu1_per_ms": draw(st.sampled_from([1e-9, 0.1, 10.0])), "mu2_per_ms": 0.2}
        section["service"] = {"law": "exponential", "mean_ms": [draw(st.sampled_from([0.0, 1.0, 50.0])), 5.0]}
        section["service_state"] = draw(st.sampled_from(["at-start", "modulated"]))
    else:
        delays_ms = st.lists(st.sampled_from([0, 1e-6, 1, 7.5, 1e3, 1e15]), min_size=1, max_size=5)
        section["service"] = {"law": "trace", "delays_ms": draw(delays_ms)}
    if draw(st.booleans()):
        section["arrivals"] = {"process": "poisson", "rate_per_ms": draw(st.sampled_from([1e-9, 0.2, 1e9]))}
    gap = st.tuples(st.sampled_from([0, 1, MS, 5 * MS, 33 * MS, 400 * MS]), st.sampled_from(CAMERAS))
    gaps = draw(st.lists(gap, min_size=1, max_size=40))
    offers = [(sum(ns for ns, _ in gaps[: i + 1]), camera) for i, (_, camera) in enumerate(gaps)]
    return section, draw(st.integers(0, 2**63 - 1)), offers


def tell(story: Story, looks_ms: list[tuple[int, str]]) -> tuple[dict[str, Link], list[Transit], list[Event]]:
    """Play a story: the links, what was offered, and every event. At every step no server is busier than it may be,
    nor idle while a frame waits."""
    section, seed, offers = story
    channel = Channel(channel_from_mapping(section), seed)
    links = {camera: channel.link(camera) for camera in CAMERAS}
    steps = [(at_ms * MS, 0, camera) for at_ms, camera in looks_ms] + [(at, 1, camera) for at, camera in offers]
    steps += [(offers[-1][0] + 5000 * MS, 2, camera) for camera in CAMERAS]
    transits, events = [], []
    for at_ns, kind, camera in sorted(steps, key=lambda step: step[:2]):
        if kind == 1:
            transit, found = links[camera].offer(at_ns, None, 20_000)
            transits.append(transit)
        else:
            found = links[camera].advance(at_ns)
        events += found
        limit = section["queue_limit"] if section["discipline"] == "parallel" else 1
        for server in {id(link.server): link.server for link in links.values()}.values():
            assert server.busy <= limit and (server.busy or not server.waiting)
            assert server.waiting == sum(len(link.waiting) for link in server.links)
    return links, transits, events


@settings(max_examples=100, deadline=None)
@given(stories(), TIMES)
def test_every_frame_ends_exactly_once_as_its_discipline_promises(story, looks_ms):
    links, transits, events = tell(story, looks_ms)
    beside = (EventKind.STARTED, EventKind.DUPLICATED)
    ends = Counter(id(e.transit) for e in events if e.kind not in beside)
    assert max(ends.values(), default=0) <= 1
    pending = [t for link in links.values() for t in link.pending()]
    assert {id(t) for t in pending} == {id(t) for t in transits} - set(ends)
    assert len(pending) == sum(link.in_flight for link in links.values())
    assert all((t.outcome is None) == (id(t) not in ends) for t in transits)
    counts = sum((link.counts for link in links.values()), Counter())
    assert Counter(e.kind for e in events if e.kind is not EventKind.STARTED) == counts
    section, _, offers = story
    discipline = section["discipline"]
    if discipline in ("newest-waits", "lcfs-preempt"):
        assert counts[EventKind.DROPPED_BUSY] == 0
    if discipline == "drop-new":
        assert counts[EventKind.SUPERSEDED] == 0
    for camera in CAMERAS if discipline != "parallel" else "":
        mine = [t for (_, other), t in zip(offers, transits) if other == camera]
        came = sorted((t.ended_ns, t.started_ns, t.number) for t in mine if t.outcome is EventKind.DELIVERED)
        assert came == sorted(came, key=lambda each: each[-1]), "frames of one camera keep their order"


@settings(max_examples=60, deadline=None)
@given(stories(), TIMES)
def test_decisions_do_not_depend_on_when_one_looks(story, looks_ms):
    seen, unseen = (
        [(t.started_ns, t.due_ns, t.outcome, t.ended_ns, t.state, t.flips) for t in tell(story, looks)[1]]
        for looks in (looks_ms, [])
    )
    assert seen == unseen
