"""The update loop: decisions in virtual time, and the same code as a thread on the wall clock."""

import time

import numpy as np
import pytest

from edge_server.fields import Budget, FitReport
from edge_server.live.buffer import FrameBuffer
from edge_server.live.field_updater import FieldUpdater
from edge_server.live.loop import UpdateLoop
from edge_server.live.state import Controls
from edge_server.scheduler import make_policy
from freshfield.clock import Clock, VirtualClock, WallClock
from tests.edge_server.frames import frame, tiny_field
from tests.support import refused, wait_until

MS = 1_000_000


def updates(cameras=("cam01", "cam02"), field=None, **more) -> FieldUpdater:
    made = make_policy("all", None, np.random.default_rng(0))
    return FieldUpdater(FrameBuffer(cameras), made, field or tiny_field(), start_ns=0, **more)


def fed_to(u: FieldUpdater) -> list[list[tuple[str, int]]]:
    """What the field is given at each fit instead of learning: cameras and milliseconds."""
    fed = []
    u.field.fit = lambda views, budget: fed.append([(v.camera, v.generated_ns // MS) for v in views])
    return fed


def test_on_arrivals_nothing_is_selected_twice_and_a_field_that_wants_it_gets_every_frame():
    field = tiny_field()
    field.frame_s, field.most_pixels = 0.0, 1001
    u = updates(field=field, on_arrivals=True)
    assert u.decoder.most_pixels == 500  # of each camera
    fed = fed_to(u)
    for at in (10, 20, 30):
        u.buffer.put(frame("cam01", sequence=at, generated_ns=at * MS), at * MS)
    u.buffer.put(frame("cam02", generated_ns=25 * MS), 31 * MS)
    selection = u.select(u.plan(40 * MS), 40 * MS)
    assert selection.arrivals == 4
    views, _ = u.fit(selection, Budget(steps=1))
    assert [v.camera for v in views] == ["cam01", "cam02"]
    assert fed == [[("cam01", 10), ("cam01", 20), ("cam01", 30), ("cam02", 25)]]
    assert u.select(u.plan(50 * MS), 50 * MS) is None
    u.buffer.put(frame("cam02", sequence=1, generated_ns=45 * MS), 60 * MS)
    again = u.select(u.plan(60 * MS), 60 * MS)
    assert again.arrivals == 1 and again.others == () and len(again.items) == 2


def test_a_frame_that_arrives_during_a_selection_is_used_by_the_next_one_and_once(monkeypatch):
    u = updates(cameras=("cam01",))
    u.on_arrivals = True
    u.buffer.put(frame(generated_ns=10 * MS), 10 * MS)
    follow, late = u._follow_field, [frame(sequence=1, generated_ns=20 * MS)]

    def meanwhile():
        follow()
        if late:
            u.buffer.put(late.pop(), 20 * MS)

    monkeypatch.setattr(u, "_follow_field", meanwhile)
    found = [u.select(u.plan(30 * MS), 30 * MS) for _ in range(3)]
    assert [s and [(i.sequence, s.arrivals) for i in s.items] for s in found] == [[(0, 1)], [(1, 1)], None]


def test_what_there_is_no_time_for_is_neither_decoded_nor_used():
    cameras = tuple(f"cam{k:02d}" for k in range(8))
    u = updates(cameras=cameras)
    u.field.frame_s = 0.01
    u.buffer.keep_every_frame(True)
    fed = fed_to(u)
    for at in (10, 20):
        for camera in cameras:
            u.buffer.put(frame(camera, sequence=at, generated_ns=at * MS), at * MS)
    decode, decoded = u.decoder._decode, []
    u.decoder._decode = lambda item: decoded.append(item) or decode(item)
    budget = Budget(seconds=0.17)
    selection = u.select(u.plan(40 * MS), 40 * MS, budget)
    views, _ = u.fit(selection, budget)
    assert len(fed[0]) == len(decoded) == 10  # .6 of the budget: the newest of all, and two others
    assert [v.camera for v in views] == list(cameras)
    assert (u.buffer.shed, u.buffer.held_back, u.buffer.arrivals) == (0, 6, 16)
    for camera in cameras:
        u.buffer.put(frame(camera, sequence=50, generated_ns=50 * MS), 50 * MS)
    u.field.moving_shares = {camera: 0.01 * k for k, camera in enumerate(cameras)}
    u.on_arrivals, short = True, Budget(seconds=1e-3)
    assert [u._most_new(short, None), u._most_new(budget, None)] == [4, 10]
    views, _ = u.fit(u.select(u.plan(60 * MS), 60 * MS, short), short)
    assert [v.camera for v in views] == list(cameras[4:])  # before which most moves
    # The newest frames of the others wait, before older ones, and are taken although nothing has arrived since.
    assert len(decoded) == 14 and u.buffer.held_back == 10
    assert u.fit(u.select(u.plan(61 * MS), 61 * MS, short), short)
    assert [item.camera for item in decoded[14:]] == list(cameras[:4])
    for left in (2, 0):
        u.fit(u.select(u.plan(62 * MS), 62 * MS, short), short)
        assert u.buffer.held_back == left
    assert (len(decoded), u.buffer.shed) == (24, 0)
    assert u.select(u.plan(63 * MS), 63 * MS, short) is None
    u.publication(selection, views, FitReport(0, 0.1, 0.0, 0, 0), selection.now_ns + 210 * MS)
    assert u._most_new(short, None) == 12, "an update that takes longer than its budget takes in more"
    for at in (70, 80):
        u.buffer.put(frame(cameras[0], sequence=at, generated_ns=at * MS), at * MS)
    u.reset()
    assert len(u.select(u.plan(90 * MS), 90 * MS).others) == 0  # frames of the scene that was forgotten


class Running:
    """A loop on the wall clock, with what it published and its status lines."""

    def __init__(self, u: FieldUpdater, grace_ms: float = 0.0, clock: Clock | None = None) -> None:
        self.published, self.lines, self.saved = [], [], []
        self.clock = clock or WallClock()
        self.controls = Controls(u.policy.name, u.policy.value)
        told = (lambda p, r, v: self.published.append((p, r)), self.lines.append, self.saved.append, lambda event: None)
        self.loop = UpdateLoop(u, self.clock, self.controls, 100.0, grace_ms, *told)

    def until(self, condition) -> None:
        wait_until(condition, lambda: f"never happened; the loop said {self.lines[-3:]}", 60.0)


def test_the_loop_publishes_renders_pauses_switches_resets_and_saves(tmp_path):
    u = updates()
    run = Running(u, grace_ms=50.0)
    run.loop.start()
    now = run.clock.now_ns()
    u.buffer.put(frame("cam01", generated_ns=now), now)
    run.until(lambda: len(run.published) >= 2)
    publication, renderer = run.published[0]
    assert publication.selected == ("cam01",)
    assert np.isfinite(renderer.render(np.eye(4), frame().intrinsics).color).all()

    run.controls.paused = True
    run.until(lambda: run.lines[-1] == "paused")
    u.buffer._takes, shed = 1, u.buffer.shed
    u.buffer.keep_every_frame(True)  # as for a field that wants them
    run.until(lambda: u.buffer._unselected is None)
    for sequence in range(1, 20):
        u.buffer.put(frame("cam01", sequence=sequence, generated_ns=now + sequence), now + sequence)
    assert u.buffer.shed == shed, "time was not what they lacked"
    count = len(run.published)
    time.sleep(0.4)
    assert len(run.published) == count
    run.controls.chosen = make_policy("threshold", 0.0, np.random.default_rng(0))
    run.controls.reset_requested = True
    future = run.loop.request_checkpoint(tmp_path / "field.npz")
    run.controls.paused = False
    assert future.result(30) == tmp_path / "field.npz"
    assert run.saved == [tmp_path / "field.npz"]
    run.until(lambda: len(run.published) > count)
    assert run.published[-1][0].omega_ms == 0.0 and not run.controls.reset_requested
    run.loop.stop()
    assert not run.loop.alive


@pytest.mark.parametrize("where", ["checkpoint", "fit"])
def test_a_field_that_fails_ends_the_loop_and_tells_who_asked_for_a_checkpoint(where, tmp_path):
    u = updates(cameras=("cam01",))
    run = Running(u)

    def broken(*_):
        raise RuntimeError("its thread has failed")

    now = run.clock.now_ns()
    u.buffer.put(frame("cam01", generated_ns=now), now)
    if where == "fit":
        u.field.fit = broken
    else:
        run.loop._on_checkpoint = broken
        future = run.loop.request_checkpoint(tmp_path / "field.npz")
    run.loop.start()
    run.loop._thread.join(60)
    assert isinstance(run.loop.failure, RuntimeError)
    if where == "checkpoint":
        refused(RuntimeError, "thread has failed", future.result, 30)


@pytest.mark.parametrize(("learns_each", "expected"), [(100, [10, 40, 70]), (2, [19, 49]), (4, [13, 43, 73]), (1, [])])
def test_updates_without_time_to_learn_are_warned_of_again_every_half_minute(learns_each, expected, caplog):
    """Also where one learns now and then."""
    clock = VirtualClock()
    starved = Running(updates(), clock=clock).loop
    told = []
    for second in range(75):  # one update a second
        clock.advance_to(second * 1000 * MS)
        starved._warn_of_haste(FitReport(0, 0.1, 0.0, 0, 0, short=second % learns_each > 0))
        told += [second] * (len(caplog.records) - len(told))
    assert told == expected
