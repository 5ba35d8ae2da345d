"""Clocks that jump, and a camera that never reports: ages stay finite and updates go on being chosen."""

from __future__ import annotations

import math

import numpy as np
import pytest

from edge_server.live.buffer import FrameBuffer
from edge_server.live.ingest import FrameAdmission
from edge_server.scheduler import POLICIES, Epoch, make_policy
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


class Edge:
    """The part of the edge that time goes through: gate, buffer, one policy."""

    def __init__(self, policy: str) -> None:
        self.gate = FrameAdmission(CAMERAS, [])
        self.buffer = FrameBuffer(CAMERAS)
        self.policy = make_policy(policy, None, np.random.default_rng(1))
        self.plan = None
        self.refused: list[str] = []
        self.selected: list[tuple[int, tuple[str, ...]]] = []

    def receive(self, made, now_ns: int) -> None:
        try:
            self.gate.admit(made, now_ns)
        except FrameRejected as error:
            self.refused.append(error.reason)
        else:
            self.buffer.put(made, now_ns)

    def decide(self, now_ns: int) -> None:
        newest = self.buffer.newest()
        generated = {c: item.generated_ns for c, item in newest.items()}
        received = {c: item.received_ns for c, item in newest.items()}
        epoch = Epoch(now_ns, len(self.selected), generated, received_ns=received)
        assert all(math.isfinite(epoch.age_ms(c)) for c in generated)
        self.plan = self.plan or self.policy.plan(epoch)
        if now_ns >= self.plan.wait_until_ns and (chosen := self.policy.select(epoch, self.plan)):
            self.selected.append((now_ns, chosen))
            self.plan = None


def run(policy: str, restarts: bool) -> tuple[Edge, dict[int, float | None]]:
    """cam01 has a right clock, cam02 jumps, the third never reports. With ``restarts`` the node's own clock
    jumps and each jump begins a new session; without, its clock runs on and the estimated offset jumps.
    Returns the edge and the age of cam02 at each step."""
    edge, ages = Edge(policy), {}
    for number, at_ms in enumerate(range(0, END_MS, STEP_MS)):
        captured_ns = START_NS + at_ms * MS
        now_ns = captured_ns + LATENCY_MS * MS
        wrong_ns = error_ms(at_ms) * MS
        edge.receive(frame("cam01", number, captured_ns), now_ns)
        jumped = {"generated_ns": captured_ns, "clock_offset_ns": wrong_ns}
        if restarts:
            session = sum(t <= at_ms for t in JUMPS)
            jumped = {"generated_ns": captured_ns + wrong_ns, "session": f"s{session}"}
        edge.receive(frame("cam02", number, clock_uncertainty_ns=UNKNOWN_NS, **jumped), now_ns)
        edge.decide(now_ns)
        shown = edge.buffer.ages_ms(now_ns)
        assert shown["never"] is None and shown["cam01"] == LATENCY_MS
        assert shown["cam02"] is None or math.isfinite(shown["cam02"])
        ages[at_ms] = shown["cam02"]
    return edge, ages


@pytest.mark.parametrize("restarts", [False, True])
def test_ages_are_right_again_with_the_first_frame_after_a_jump(restarts):
    edge, ages = run("all", restarts)
    for at_ms, age_ms in ages.items():
        if error_ms(at_ms) == 0:
            assert age_ms == LATENCY_MS, at_ms
    # Ahead within the tolerance is believed; behind, the last good frame grows old; a day ahead is refused.
    assert ages[3000] == LATENCY_MS - 1100
    assert ages[7950] == LATENCY_MS + 2000
    assert edge.refused == ["from_future"] * (1000 // STEP_MS)
    assert edge.buffer.stale_on_arrival == 2000 // STEP_MS


@pytest.mark.parametrize("restarts", [False, True])
@pytest.mark.parametrize("policy", POLICIES)
def test_selection_goes_on_through_every_jump(policy, restarts):
    edge, _ = run(policy, restarts)
    times_ms = [(now - START_NS) / MS for now, _ in edge.selected]
    assert times_ms[0] < 1200 and np.diff(times_ms).max() <= 1200 and times_ms[-1] > END_MS - 1200
    used = {c for _, chosen in edge.selected for c in chosen}
    assert used <= {"cam01", "cam02"} and "cam01" in used
    assert all(chosen for _, chosen in edge.selected)
    after = {c for now, chosen in edge.selected if now > START_NS + 10_000 * MS for c in chosen}
    assert after == {"cam01", "cam02"}  # the camera whose clock was wrong is used again
