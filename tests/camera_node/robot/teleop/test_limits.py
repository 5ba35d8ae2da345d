from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera_node.robot.arm.kinematics import UR3E
from camera_node.robot.teleop import TeleopError
from camera_node.robot.teleop.limits import JointLimits, Limiter
from camera_node.robot.teleop.settings import TeleopConfig
from tests.camera_node.robot.teleop.checks import EPS, HOME


def stop_way(v: float, change: float, dt: float) -> float:
    """The sum that the limiter inverts in closed form, added up."""
    way = 0.0
    while v > 0.0:
        way += v * dt
        v -= change
    return way


@given(room=st.floats(0.0, 20.0), acceleration=st.floats(0.05, 40.0), rate_hz=st.floats(20.0, 500.0))
def test_the_fastest_speed_stops_exactly_within_the_room(room, acceleration, rate_hz):
    dt = 1.0 / rate_hz
    limits = JointLimits([0.0], [1.0], 1e9, acceleration, dt)
    (fastest,) = limits._max_stoppable_speed(np.array([room]))
    change = limits._change
    assert stop_way(fastest, change, dt) <= room * (1 + 1e-9) + 1e-12
    # And nothing faster does: the closed form is no bound but the value.
    assert stop_way(fastest + 1e-6, change, dt) > room * (1 - 1e-9)


@given(st.lists(st.floats(-1e6, 1e6) | st.sampled_from([math.inf, -math.inf]), min_size=1, max_size=80))
def test_a_joint_by_itself_never_breaks_a_limit(wanted):
    limits, dt = JointLimits([-0.02], [0.05], 0.7, 3.0, 0.01), 0.01
    q, v = np.zeros(1), np.zeros(1)
    for each in wanted:
        after = limits.clamp(q, v, np.clip([each], -1e9, 1e9))
        assert abs(after - v)[0] <= 3.0 * dt + 1e-12 and abs(after)[0] <= 0.7
        q, v = q + after * dt, after
        assert -0.02 <= q[0] <= 0.05


def test_a_joint_reaches_its_limit_and_rests_there():
    limits, dt = JointLimits([-1.0], [1.0], 0.7, 3.0, 0.01), 0.01
    q, v = np.zeros(1), np.zeros(1)
    for _ in range(400):
        v = limits.clamp(q, v, np.array([5.0]))
        q = q + v * dt
    assert q[0] == pytest.approx(1.0, abs=1e-6)
    assert abs(v[0]) < 1e-6


def test_all_joints_change_in_proportion_so_that_the_flange_keeps_its_direction():
    limits = JointLimits([-3.0] * 3, [3.0] * 3, 1.0, 2.0, 0.01)
    wanted = np.array([0.8, -0.4, 0.1])
    first = limits.clamp(np.zeros(3), np.zeros(3), wanted)
    assert np.allclose(first / wanted, first[0] / wanted[0])
    assert first[0] == pytest.approx(0.02)


@pytest.mark.parametrize("wanted", [np.full(6, np.nan), [np.inf] * 6, np.zeros(5), None])
def test_what_is_no_speed_is_a_stop_and_counted(wanted):
    limiter = Limiter(UR3E, TeleopConfig(), HOME)
    limiter.step(np.full(6, 0.5))
    before = np.abs(limiter.v).max()
    for _ in range(5):
        limiter.step(wanted)
    assert limiter.refused["unsound"] == 5
    assert np.abs(limiter.v).max() < before


@pytest.mark.parametrize(
    "changes, part",
    [
        ({"workspace_low_m": (0.0, 0.0, 0.4)}, "outside the workspace"),
        ({"floor_m": 0.5}, "below floor_m"),
        ({"margin_m": 0.1}, "nearer than margin_m"),
    ],
)
def test_an_arm_that_breaks_a_limit_standing_still_is_refused(changes, part):
    with pytest.raises(TeleopError, match=part):
        Limiter(UR3E, TeleopConfig(**changes), HOME)
    for none in (HOME[:5], [np.nan, *HOME[1:]]):
        with pytest.raises(TeleopError, match="the arm gives no joint angles"):
            Limiter(UR3E, TeleopConfig(**changes), none)
    with pytest.raises(TeleopError, match=r"joint 6 stands at 359\.4 degrees"):
        Limiter(UR3E, TeleopConfig(), [*HOME[:5], 2 * math.pi - 0.01])


def test_a_stop_is_what_was_let_through_with_the_tick_before():
    limits = JointLimits([-9.0] * 6, [9.0] * 6, 2.0, 1.0, 0.01)
    v = np.array([0.5, -0.3, 0.0, 0.011, -1.7, 2.0])
    path, speeds = limits.stop(np.zeros(6), v)
    q, now = np.zeros(6), v
    for k in range(1, len(path)):
        now = limits.stopping(now)
        q = q + now * 0.01
        assert np.allclose(path[k], q, atol=EPS) and np.allclose(speeds[k], now, atol=EPS)
    assert not now.any()
