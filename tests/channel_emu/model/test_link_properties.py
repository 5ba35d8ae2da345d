"""Any channel, any offers: what is offered ends somewhere, exactly once, and looking changes nothing."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from hypothesis import given, settings
from hypothesis import strategies as st

from channel_emu.model.channel import Channel
from channel_emu.model.link import DISCIPLINES, Event, EventKind, Link, Transit
from channel_emu.model.settings import channel_from_mapping

MS = 10**6
CAMERAS = "abc"
FAULTS = {
    "loss": st.just({"probability": 0.3}),
    "duplication": st.just({"probability": 0.3}),
    "corruption": st.just({"probability": 0.5}),
    "reset": st.just({"mean_interval_ms": 40.0}),
    "blackout": st.just({"every_ms": 20.0, "for_ms": 3.0}),
    "bandwidth": st.just({"megabits_per_s": 8.0}),
}
TIMES = st.lists(st.tuples(st.integers(0, 1500), st.sampled_from(CAMERAS)), max_size=8)


@dataclass
class Story:
    section: dict
    seed: int
    offers: list[tuple[int, str]]
    """(instant in ns, camera)"""


@st.composite
def stories(draw: st.DrawFn) -> Story:
    section: dict = {
        "discipline": draw(st.sampled_from(DISCIPLINES)),
        "queue_limit": draw(st.integers(1, 4)),
        "server": {"shared": draw(st.booleans())},
        "faults": draw(st.fixed_dictionaries({}, optional=FAULTS)),
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
    return Story(section, draw(st.integers(0, 2**63 - 1)), offers)


def tell(story: Story, looks_ms: list[tuple[int, str]]) -> tuple[dict[str, Link], list[Transit], list[Event]]:
    """Play a story: the links, what was offered, and every event. At every step no server is busier than it may be,
    nor idle while a frame waits."""
    channel = Channel(channel_from_mapping(story.section), story.seed)
    links = {camera: channel.link(camera) for camera in CAMERAS}
    steps = [(at_ms * MS, 0, camera) for at_ms, camera in looks_ms] + [(at, 1, camera) for at, camera in story.offers]
    steps += [(story.offers[-1][0] + 5000 * MS, 2, camera) for camera in CAMERAS]
    transits, events = [], []
    for at_ns, kind, camera in sorted(steps, key=lambda step: step[:2]):
        if kind == 1:
            transit, found = links[camera].offer(at_ns, None, 20_000)
            transits.append(transit)
        else:
            found = links[camera].advance(at_ns)
        events += found
        limit = story.section["queue_limit"] if story.section["discipline"] == "parallel" else 1
        for server in {id(link.server): link.server for link in links.values()}.values():
            assert server.busy <= limit and (server.busy or not server.waiting)
            assert server.waiting == sum(len(link.waiting) for link in server.links)
    return links, transits, events


@settings(max_examples=100, deadline=None)
@given(stories(), TIMES)
def test_every_frame_ends_exactly_once_as_its_discipline_promises(story: Story, looks_ms: list) -> None:
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
    discipline = story.section["discipline"]
    if discipline in ("newest-waits", "lcfs-preempt"):
        assert counts[EventKind.DROPPED_BUSY] == 0
    if discipline == "drop-new":
        assert counts[EventKind.SUPERSEDED] == 0
    for camera in CAMERAS if discipline != "parallel" else "":
        mine = [t for (_, other), t in zip(story.offers, transits) if other == camera]
        came = sorted((t.ended_ns, t.started_ns, t.number) for t in mine if t.outcome is EventKind.DELIVERED)
        assert came == sorted(came, key=lambda each: each[-1]), "frames of one camera keep their order"


@settings(max_examples=60, deadline=None)
@given(stories(), TIMES)
def test_decisions_do_not_depend_on_when_one_looks(story: Story, looks_ms: list) -> None:
    seen, unseen = (
        [(t.started_ns, t.due_ns, t.outcome, t.ended_ns, t.state, t.flips) for t in tell(story, looks)[1]]
        for looks in (looks_ms, [])
    )
    assert seen == unseen
