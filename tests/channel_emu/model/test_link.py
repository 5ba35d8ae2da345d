"""The link's disciplines, by example and by property: what is offered ends somewhere, exactly once."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from channel_emu.model.channel import Channel
from channel_emu.model.link import DISCIPLINES, Event, EventKind, Link
from channel_emu.model.settings import channel_from_mapping

MS = 10**6


def link(discipline: str, delays_ms: list[float], **more) -> Link:
    section = {"service": {"law": "trace", "delays_ms": delays_ms}, "discipline": discipline, **more}
    return Channel(channel_from_mapping(section), 0).link("cam00")


def play(subject: Link, offers_ms: list[float], until_ms: float = 1000) -> list[tuple[str, float, int]]:
    """(what, when in ms, frame) of everything that happened."""
    events: list[Event] = []
    for at in offers_ms:
        events += subject.offer(round(at * MS))[1]
    events += subject.advance(round(until_ms * MS))
    return [(str(e.kind), e.at_ns / MS, e.transit.number) for e in events]


# Delays in ms, instants of the offers, and what happens: s started, d delivered, b dropped busy, x superseded.
STORIES = {
    "drop-new": ([10, 5, 5, 5], [0, 4, 10, 30], "s0@0 b1@4 d0@10 s2@10 d2@15 s3@30 d3@35"),
    "newest-waits": ([10, 5, 7, 5], [0, 2, 4], "s0@0 x1@4 d0@10 s2@10 d2@17"),
    "fcfs": ([10, 5, 7, 5], [0, 1, 2, 3], "s0@0 b3@3 d0@10 s1@10 d1@15 s2@15 d2@22"),
    "lcfs-preempt": ([10, 5], [0, 2], "s0@0 x0@2 s1@2 d1@7"),
    "parallel": ([10, 5], [0, 2, 3], "s0@0 s1@2 b2@3 d1@7 d0@10"),
}
SIGNS = {"started": "s", "delivered": "d", "dropped_busy": "b", "superseded": "x"}


@pytest.mark.parametrize("discipline", STORIES)
def test_what_a_busy_link_does_with_a_new_frame(discipline: str) -> None:
    """With room for two: waiting (fcfs) or in service (parallel). At 10 ms one comes as the first is done."""
    delays_ms, offers_ms, story = STORIES[discipline]
    told = play(link(discipline, delays_ms, queue_limit=2), offers_ms)
    assert " ".join(f"{SIGNS[kind]}{number}@{at:g}" for kind, at, number in told) == story


def test_a_fault_that_delays_nothing_leaves_the_delay_to_the_nanosecond() -> None:
    subject = link("fcfs", [10], faults={"corruption": {"probability": 1.0}})
    assert subject.offer(0)[0].due_ns == 10 * MS


def test_a_late_caller_gets_the_punctual_decisions() -> None:
    """Told of 30 ms at once, newest-waits starts the waiting frame when the first was due, not when told."""
    subject = link("newest-waits", [10, 5])
    assert subject.offer(0)[0].drawn_ns == 10 * MS
    assert subject.offer(2 * MS)[0].drawn_ns is None
    events = subject.advance(30 * MS)
    assert [(e.kind, e.at_ns / MS) for e in events] == [("delivered", 10), ("started", 10), ("delivered", 15)]


def test_sampling_takes_the_newest_offered_frame() -> None:
    config = channel_from_mapping({"preset": "ch6-low", "service": "none"})
    subject = Channel(config, 3).link("cam00")
    transits = [subject.offer(i * 10 * MS)[0] for i in range(4000)]
    subject.advance(40_000 * MS)
    counts = Counter(str(t.outcome) for t in transits)
    assert set(counts) <= {"skipped", "delivered", "None"} and counts["None"] <= 1
    # Sampled at the first arrival after each offer: one per 120 ms on average, and each within its period.
    assert counts["delivered"] == pytest.approx(4000 * (1 - 2.718281828 ** (-10 / 120)), rel=0.12)
    for t in transits:
        if t.outcome is EventKind.DELIVERED:
            assert t.started_ns is not None and 0 <= t.started_ns - t.offered_ns <= 10 * MS


@pytest.mark.parametrize("discipline", DISCIPLINES)
def test_a_flush_breaks_off_what_is_inside_and_frees_the_line(discipline: str) -> None:
    subject = link(discipline, [10, 50, 50, 50])
    events = [e for at in (0, 12, 14) for e in subject.offer(at * MS)[1]]
    events += subject.flush(20 * MS)
    events += subject.offer(21 * MS)[1] + subject.advance(100 * MS)
    ends = Counter(str(e.kind) for e in events if e.kind is not EventKind.STARTED)
    assert ends["delivered"] == 2 and ends["broken"] >= 1 and sum(ends.values()) == 4
    assert [e.at_ns for e in events if e.kind is EventKind.DELIVERED] == [10 * MS, 71 * MS]
    assert subject.resets == 0 and subject.in_flight == 0
    assert subject.flush(100 * MS) == []


def test_a_change_keeps_due_instants_and_lets_in_what_waits_to_be_sampled() -> None:
    section = {
        "arrivals": {"process": "poisson", "rate_per_ms": [1.0, 0.0]},
        "discipline": "parallel",
        "service": "det:50ms",
    }
    section |= {
        "chain": {"mu1_per_ms": 1e-9, "mu2_per_ms": 1e-9, "initial": "s1"},
        "faults": {"reset": {"at_ms": [500]}},
    }
    channel = Channel(channel_from_mapping(section), 0)
    subject = channel.link("cam00")
    sampled = subject.offer(0)[0]
    subject.advance(30 * MS)
    waiting = subject.offer(40 * MS)[0]
    assert sampled.started_ns is not None and waiting.started_ns is None
    channel.set_by_hand(20.0, 0.0)
    channel.change(subject, 40 * MS)
    assert (waiting.started_ns, waiting.due_ns) == (40 * MS, 60 * MS)
    subject.advance(100 * MS)
    assert sampled.ended_ns == sampled.started_ns + 50 * MS and waiting.outcome is EventKind.DELIVERED
    assert subject.offer(600 * MS)[0].due_ns == 620 * MS and subject.resets == 0  # no other fault is in force
    channel.set_by_hand(0.0, 1.0)
    lost = subject.pending()[0]
    channel.change(subject, 610 * MS)
    assert subject.advance(700 * MS)[-1].transit is lost and lost.outcome is EventKind.LOST
    assert lost.ended_ns == 620 * MS
    channel.set_by_scenario()
    channel.change(subject, 700 * MS)
    again = subject.offer(800 * MS)[0]
    subject.advance(900 * MS)
    assert again.drawn_ns == 50 * MS and again.started_ns > again.offered_ns and channel.by_hand is None


def test_what_is_due_at_the_flush_arrives() -> None:
    subject = link("drop-new", [10])
    subject.offer(0)
    assert [str(e.kind) for e in subject.flush(10 * MS)] == ["delivered"]


def test_a_clock_that_runs_backwards_is_held_and_counted() -> None:
    subject = link("drop-new", [10])
    subject.offer(50 * MS)
    transit, _ = subject.offer(20 * MS)
    assert transit.offered_ns == 50 * MS and transit.outcome is EventKind.DROPPED_BUSY
    assert subject.clock_backwards == 1
    assert subject.advance(10 * MS) == [] and subject.clock_backwards == 2
    assert [e.at_ns for e in subject.advance(60 * MS)] == [60 * MS]


@dataclass
class Story:
    subject: Link
    offers_ns: list[int]
    looks_ns: list[int]


DELAYS_MS = st.sampled_from([0, 1e-6, 1, 7.5, 1e3, 1e15])


@st.composite
def stories(draw: st.DrawFn, faults: bool = True) -> Story:
    """Any channel, any offers, and any pattern of asking in between."""
    section: dict = {
        "discipline": draw(st.sampled_from(DISCIPLINES)),
        "queue_limit": draw(st.integers(1, 4)),
        "service": {"law": "trace", "delays_ms": draw(st.lists(DELAYS_MS, min_size=1, max_size=5))},
    }
    if draw(st.booleans()):
        section["chain"] = {"mu1_per_ms": draw(st.sampled_from([1e-9, 0.1, 10.0])), "mu2_per_ms": 0.2}
        section["service"] = {"law": "exponential", "mean_ms": [draw(st.sampled_from([0.0, 1.0, 50.0])), 5.0]}
        section["service_state"] = draw(st.sampled_from(["at-start", "modulated"]))
    if draw(st.booleans()):
        section["arrivals"] = {"process": "poisson", "rate_per_ms": draw(st.sampled_from([1e-9, 0.2, 1e9]))}
    if faults:
        section["faults"] = draw(
            st.fixed_dictionaries(
                {},
                optional={
                    "loss": st.just({"probability": 0.3}),
                    "duplication": st.just({"probability": 0.3}),
                    "corruption": st.just({"probability": 0.5}),
                    "reset": st.just({"mean_interval_ms": 40.0}),
                    "blackout": st.just({"every_ms": 20.0, "for_ms": 3.0}),
                    "bandwidth": st.just({"megabits_per_s": 8.0}),
                },
            )
        )
    gaps = draw(st.lists(st.sampled_from([0, 1, MS, 5 * MS, 33 * MS, 400 * MS]), min_size=1, max_size=40))
    offers = [sum(gaps[: i + 1]) for i in range(len(gaps))]
    looks = draw(st.lists(st.integers(0, offers[-1] + 100 * MS), max_size=8))
    seed = draw(st.integers(0, 2**63 - 1))
    return Story(Channel(channel_from_mapping(section), seed).link("cam00"), offers, looks)


def tell(story: Story) -> tuple[list, list[Event]]:
    """Play a story: the transits and every event, in order."""
    steps = sorted([(t, 0) for t in story.looks_ns] + [(t, 1) for t in story.offers_ns])
    transits, events = [], []
    for at_ns, is_offer in steps:
        if is_offer:
            transit, found = story.subject.offer(at_ns, None, 20_000)
            transits.append(transit)
        else:
            found = story.subject.advance(at_ns)
        events += found
    return transits, events + story.subject.advance(story.offers_ns[-1] + 50 * MS)


@settings(max_examples=70, deadline=None)
@given(stories())
def test_every_frame_ends_exactly_once(story: Story) -> None:
    transits, events = tell(story)
    subject = story.subject
    ends = Counter(e.transit.number for e in events if e.kind not in (EventKind.STARTED, EventKind.DUPLICATED))
    assert max(ends.values(), default=0) <= 1
    assert len(transits) == sum(ends.values()) + subject.in_flight == subject.offered
    assert {t.number for t in subject.pending()} == {t.number for t in transits} - set(ends)
    by_kind = Counter(e.kind for e in events)
    by_kind.pop(EventKind.STARTED, None)
    assert by_kind == Counter({EventKind(k): n for k, n in subject.counts.items() if n})
    for t in transits:
        assert (t.outcome is None) == (t.number not in ends)


@settings(max_examples=70, deadline=None)
@given(stories())
def test_what_each_discipline_promises(story: Story) -> None:
    _, events = tell(story)
    discipline, inside, most = story.subject.discipline, 0, 0
    delivered = []
    started: set[int] = set()
    for e in events:
        if e.kind is EventKind.STARTED:
            started.add(e.transit.number)
            inside += 1
            most = max(most, inside)
        elif e.kind is not EventKind.DUPLICATED and e.transit.number in started:
            inside -= 1
        if e.kind is EventKind.DELIVERED:
            delivered.append(e.transit.number)
    assert most <= (story.subject.server.queue_limit if discipline == "parallel" else 1)
    if discipline != "parallel":
        assert delivered == sorted(delivered)
    if discipline in ("newest-waits", "lcfs-preempt"):
        assert story.subject.counts[EventKind.DROPPED_BUSY] == 0
    if discipline == "drop-new":
        assert story.subject.counts[EventKind.SUPERSEDED] == 0


@settings(max_examples=50, deadline=None)
@given(stories(), st.lists(st.integers(0, 600 * MS), max_size=10))
def test_decisions_do_not_depend_on_when_one_looks(story: Story, looks_ns: list[int]) -> None:
    import copy

    other = Story(copy.deepcopy(story.subject), story.offers_ns, looks_ns)

    def fates(transits: list) -> list[tuple]:
        return [(t.started_ns, t.due_ns, t.outcome, t.ended_ns, t.state, t.flips) for t in transits]

    end_ns = story.offers_ns[-1] + 5000 * MS
    first, second = tell(story)[0], tell(other)[0]
    story.subject.advance(end_ns)
    other.subject.advance(end_ns)
    assert fates(first) == fates(second)
