"""Clocks that jump, and a camera that never reports: ages are right again with the first good frame."""

from __future__ import annotations

import pytest

from edge_server.live.buffer import FrameBuffer
from edge_server.live.ingest import FrameAdmission
from freshfield.frame import FrameRejected
from tests.edge_server.frames import frame

pytestmark = pytest.mark.stability

MS = 1_000_000
START_NS = 1_700_000_000_000 * MS
STEP_MS = 50
LATENCY_MS = 20
# A node that has not measured its offset says so with an hour of uncertainty.
UNKNOWN_NS = 3600 * 10**9
CAMERAS = ["cam01", "cam02", "never"]

# cam02's error on the edge's clock in ms, by time in ms: right, ahead within what an unknown clock is given,
# right again, far behind, right, ahead by a day, right.
JUMPS = {0: 0, 2000: 1100, 4000: 0, 6000: -20 * 60_000, 8000: 0, 9000: 86_400_000, 10_000: 0}
END_MS = 12_000


def error_ms(at_ms: int) -> int:
    return JUMPS[max(t for t in JUMPS if t <= at_ms)]


def run(restarts: bool) -> tuple[dict[int, float | None], list[str], FrameBuffer]:
    """cam01 has a right clock, cam02 jumps, the third never reports. With ``restarts`` the node's own clock
    jumps and each jump begins a new session; without, its clock runs on and the estimated offset jumps.
    Returns the age of cam02 at each step, why frames were refused, and the buffer."""
    gate, buffer = FrameAdmission(CAMERAS, []), FrameBuffer(CAMERAS)
    ages: dict[int, float | None] = {}
    refused: list[str] = []
    for number, at_ms in enumerate(range(0, END_MS, STEP_MS)):
        captured_ns = START_NS + at_ms * MS
        now_ns = captured_ns + LATENCY_MS * MS
        wrong_ns = error_ms(at_ms) * MS
        jumped = {"generated_ns": captured_ns, "clock_offset_ns": wrong_ns}
        if restarts:
            session = sum(t <= at_ms for t in JUMPS)
            jumped = {"generated_ns": captured_ns + wrong_ns, "session": f"s{session}"}
        jumping = frame("cam02", number, clock_uncertainty_ns=UNKNOWN_NS, **jumped)
        for made in (frame("cam01", number, captured_ns), jumping):
            try:
                gate.admit(made, now_ns)
            except FrameRejected as error:
                refused.append(error.reason)
            else:
                buffer.put(made, now_ns)
        shown = buffer.ages_ms(now_ns)
        assert shown["never"] is None and shown["cam01"] == LATENCY_MS
        ages[at_ms] = shown["cam02"]
    return ages, refused, buffer


@pytest.mark.parametrize("restarts", [False, True])
def test_ages_are_right_again_with_the_first_frame_after_a_jump(restarts):
    ages, refused, buffer = run(restarts)
    assert all(age_ms == LATENCY_MS for at_ms, age_ms in ages.items() if error_ms(at_ms) == 0)
    # Ahead within the tolerance is believed; behind, the last good frame grows old; a day ahead is refused.
    assert ages[3000] == LATENCY_MS - 1100
    assert ages[7950] == LATENCY_MS + 2000
    assert refused == ["from_future"] * (1000 // STEP_MS)
    assert buffer.stale_on_arrival == 2000 // STEP_MS
