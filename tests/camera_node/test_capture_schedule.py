"""When captures are due: by frame rate, and once through a recording."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from camera_node.capture_schedule import OnceSchedule, PartialSchedule, RateSchedule

NOW_NS = 1_763_000_000_123_456_789
TIMES = [0, 33_000_000, 66_000_001, 250_000_000]


def walk(schedule, now_ns, steps, late_ns=0):
    """RateSchedule and due times as a node makes them: each capture ends ``late_ns`` after it was due."""
    tick, out = schedule.first(now_ns), []
    missed = 0
    while tick is not None and len(out) < steps:
        due_ns = schedule.due_ns(tick)
        out.append((tick, due_ns))
        tick, m = schedule.next(tick, due_ns + late_ns)
        missed += m
    return out, missed


@given(st.fractions(Fraction(1, 10), 200, max_denominator=1001), st.integers(0, 2**62), st.integers(0, 10**10))
def test_ticks_are_due_after_now_and_follow_each_other(fps, now_ns, phase_ns):
    schedule = RateSchedule(fps, phase_ns)
    found, missed = walk(schedule, now_ns, 5)
    assert found[0][1] > now_ns >= schedule.due_ns(found[0][0] - 1) and missed == 0 and schedule.due_ns(0) == phase_ns
    assert [tick for tick, _ in found] == list(range(found[0][0], found[0][0] + 5))


def test_a_late_node_skips_to_the_newest_tick_but_plays_a_recording_once_whole():
    found, missed = walk(RateSchedule(Fraction(10)), NOW_NS, 3, late_ns=350_000_000)
    assert [b[0] - a[0] for a, b in pairwise(found)] == [3, 3] and missed == 6
    for late_ns in (0, 10**10):
        found, missed = walk(OnceSchedule(TIMES, NOW_NS), NOW_NS + 5, 10, late_ns)
        assert found == [(k, NOW_NS + t) for k, t in enumerate(TIMES)] and missed == 0


@given(st.integers(2, 9), st.integers(0, 2**60), st.integers(0, 10**9))
def test_captures_that_are_held_out_are_left_out_and_the_others_counted_without_a_gap(every, now_ns, late_ns):
    whole, part = RateSchedule(Fraction(10), 70_000_000), PartialSchedule(Fraction(10), 70_000_000, every)
    tick = part.first(now_ns)
    at = part.whole(tick)
    own = [whole.due_ns(k) for k in range(at - every, at + 2 * every + 12) if k % every]
    assert part.due_ns(tick) == min(due_ns for due_ns in own if due_ns > now_ns)
    later_ns = part.due_ns(tick) + late_ns
    after, missed = part.next(tick, later_ns)
    between = [due_ns for due_ns in own if part.due_ns(tick) < due_ns <= later_ns]
    assert after is not None and missed == max(0, len(between) - 1)
    assert part.due_ns(after) == (between[-1] if between else min(due_ns for due_ns in own if due_ns > later_ns))
