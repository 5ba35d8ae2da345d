"""How long an update may fit: the reserve of a deadline, the chosen frontier point, a real field under
load."""

from __future__ import annotations

import json
import math
import multiprocessing
import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge_server.live.buffer import FrameBuffer
from edge_server.live.field_updater import FieldUpdater
from edge_server.live.update_budget import FrontierPoint, UpdateBudget, best_point, read_frontier
from edge_server.scheduler import make_policy
from tests.edge_server.fields_for_tests import tiny_field
from tests.edge_server.frames import frame


def test_a_fixed_fit_stays_what_it_is():
    budgets = UpdateBudget(250.0)
    budgets.record(budgets.next(), 900.0)
    assert budgets.next().seconds == 0.25


def drive(budgets: UpdateBudget, overheads_ms) -> int:
    """Updates whose fit keeps its budget and whose overhead is given; returns how many met the deadline."""
    met = 0
    for overhead_ms in overheads_ms:
        budget = budgets.next()
        update_ms = budget.seconds * 1e3 + overhead_ms
        budgets.record(budget, update_ms)
        met += update_ms <= budgets.deadline_ms
    return met


def test_nineteen_of_twenty_updates_meet_a_deadline_whatever_their_overhead():
    rng = np.random.default_rng(3)
    for overheads in (rng.exponential(15.0, 2000), rng.gamma(2.0, 20.0, 2000), rng.uniform(0, 80, 2000)):
        assert drive(UpdateBudget(deadline_ms=300.0), overheads) / 2000 >= 0.95


def test_the_time_to_fit_shrinks_while_the_machine_is_busy_and_comes_back():
    budgets = UpdateBudget(deadline_ms=300.0)
    drive(budgets, [5.0] * 64)
    calm = budgets.next().seconds
    drive(budgets, [90.0] * 8)
    busy = budgets.next().seconds
    drive(budgets, [5.0] * 64)
    assert calm == pytest.approx(0.294) and busy == pytest.approx(0.209)
    assert budgets.next().seconds == calm


def test_a_slow_update_is_remembered_for_sixty_four_updates():
    budgets = UpdateBudget(deadline_ms=300.0)
    drive(budgets, [5.0] * 30 + [150.0] + [5.0] * 63)
    assert budgets.next().seconds == pytest.approx(0.149)
    drive(budgets, [5.0])
    assert budgets.next().seconds == pytest.approx(0.294)


def test_more_than_is_worth_it_is_not_spent():
    budgets = UpdateBudget(250.0, 5000.0)
    assert budgets.next().seconds == 0.25


@given(st.lists(st.floats(-1e3, 1e7), max_size=80), st.floats(20.0, 1e6))
def test_there_is_always_a_budget(overheads, deadline_ms):
    budgets = UpdateBudget(deadline_ms=deadline_ms)
    drive(budgets, overheads)
    assert budgets.next().seconds >= 0.01 and math.isfinite(budgets.next().seconds)


def test_a_deadline_without_time_to_fit_is_refused():
    for deadline_ms in (0.0, 19.0, math.nan):
        with pytest.raises(ValueError, match="deadline_ms"):
            UpdateBudget(deadline_ms=deadline_ms)


def frontier_point(effort, speed, update_ms, whole, moving) -> FrontierPoint:
    return FrontierPoint(effort, {"effort": effort}, speed, update_ms, whole, moving)


POINTS = [
    frontier_point("low", 1.0, 100.0, 20.0, 18.0),
    frontier_point("low", 1.0, 400.0, 21.0, 17.5),
    frontier_point("medium", 1.0, 400.0, 24.0, 17.0),
    frontier_point("medium", 1.0, 2000.0, 24.5, 14.0),
    frontier_point("low", 4.0, 100.0, 19.0, 17.0),
    frontier_point("low", 4.0, 400.0, 19.0, 13.0),
]


def test_the_best_point_that_fits_is_chosen():
    assert best_point(POINTS, 150.0, 1.0) == POINTS[0]
    assert best_point(POINTS, 500.0, 1.0) == POINTS[2]
    assert best_point(POINTS, 9000.0, 1.0) == POINTS[2]  # longer updates show an older world
    assert best_point(POINTS, 500.0, 3.0) == POINTS[4]  # a faster scene: the speed nearest in ratio
    assert best_point(POINTS, 30.0, 1.0) == POINTS[0]  # nothing is as short: the quickest


def test_of_points_that_seeds_cannot_tell_apart_the_quickest_is_chosen():
    unsure = [replace(p, error_db=1.0) for p in POINTS]  # the best leads by 1.5, of which 1.4 may be chance
    assert best_point(unsure, 500.0, 1.0) == unsure[2]
    unsure = [replace(p, error_db=1.2) for p in POINTS]
    assert best_point(unsure, 500.0, 1.0) == unsure[0]
    assert best_point(unsure, 500.0, 3.0) == unsure[4]


def test_points_are_read_and_errors_say_what_to_do(tmp_path):
    shipped = read_frontier(None, "ngp")
    assert len({p.effort for p in shipped}) >= 2 and all(p.update_ms > 0 for p in shipped)
    with pytest.raises(ValueError, match="edge-server frontier --field nothing"):
        read_frontier(None, "nothing")
    for text in ("", "[]", "{}", '{"updates": [{}]}', '{"updates": 3}', '{"updates": [], "updates": []}'):
        (tmp_path / "f.json").write_text(text)
        with pytest.raises(ValueError, match=r"f\.json: not a frontier"):
            read_frontier(tmp_path / "f.json", "ngp")
    with pytest.raises(ValueError, match=r"missing\.json"):
        read_frontier(tmp_path / "missing.json", "ngp")
    row = {
        "field": "splat",
        "effort": "low",
        "options": {},
        "speed_m_per_s": 1.0,
        "update_s": 0.1,
        "psnr_db": 30.0,
        "psnr_moving_db": 20.0,
        "shown_psnr_db": 25.0,
        "shown_psnr_moving_db": 15.0,
    }
    layers = row | {"effort": "layers", "options": {"layers": True}, "shown_psnr_db": 29.0}
    (tmp_path / "f.json").write_text(json.dumps({"updates": [row, layers]}))
    (plain,), (layered,) = (read_frontier(tmp_path / "f.json", "splat", layers=known) for known in (False, True))
    assert plain.psnr_db == 25.0 and plain.mean_db == 20.0, "by what was shown"
    assert layered.psnr_db == 29.0 and layered.effort == "layers"
    with pytest.raises(ValueError, match="for ngp in layers"):
        read_frontier(tmp_path / "f.json", "ngp", layers=True)
    (tmp_path / "f.json").write_text(json.dumps({"updates": []}))
    with pytest.raises(ValueError, match="nothing was measured"):
        read_frontier(tmp_path / "f.json", "ngp")


def burn(stop) -> None:
    while not stop.is_set():
        np.linalg.norm(np.arange(1000.0))


@pytest.mark.slow
def test_a_real_field_meets_its_deadline_while_others_keep_the_machine_busy():
    buffer = FrameBuffer(("cam01", "cam02"))
    updates = FieldUpdater(buffer, make_policy("all", None, np.random.default_rng(0)), tiny_field(), start_ns=0)
    updates.field.warm_up()
    for camera in buffer.cameras:
        buffer.put(frame(camera, generated_ns=0), 1)
    budgets, met = UpdateBudget(deadline_ms=250.0), 0
    spawn = multiprocessing.get_context("spawn")
    stop = spawn.Event()
    others = [spawn.Process(target=burn, args=(stop,), daemon=True) for _ in range(2)]
    for process in others:
        process.start()
    try:
        for _ in range(60):
            began = time.perf_counter()
            selection = updates.select(updates.plan(10), 10)
            budget = budgets.next()
            updates.fit(selection, budget)
            updates.field.snapshot()
            update_ms = (time.perf_counter() - began) * 1e3
            budgets.record(budget, update_ms)
            met += update_ms <= budgets.deadline_ms
    finally:
        stop.set()
        for process in others:
            process.join()
    assert met >= 0.95 * 60
