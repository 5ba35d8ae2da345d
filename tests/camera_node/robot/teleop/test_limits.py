import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from camera_node.robot.arm import ArmError
from camera_node.robot.arm.kinematics import UR3E, apply_calibration
from camera_node.robot.teleop.limits import JointLimits, Limiter
from camera_node.robot.teleop.settings import TeleopConfig
from camera_node.robot.teleop.stylus import StylusSample
from camera_node.robot.teleop.teleoperator import SILENT, Command, Teleoperator
from tests.camera_node.robot.teleop.checks import HOME, assert_within_limits, drive, sample
from tests.support import refused


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


def test_all_joints_change_in_proportion_so_that_the_flange_keeps_its_direction():
    limits = JointLimits([-3.0] * 3, [3.0] * 3, 1.0, 2.0, 0.01)
    wanted = np.array([0.8, -0.4, 0.1])
    first = limits.clamp(np.zeros(3), np.zeros(3), wanted)
    assert np.allclose(first / wanted, first[0] / wanted[0])
    assert first[0] == pytest.approx(0.02)


@pytest.mark.parametrize("wanted", [[np.inf] * 6, np.zeros(5), None])
def test_what_is_no_speed_is_a_stop_and_counted(wanted):
    limiter = Limiter(UR3E, TeleopConfig(), HOME)
    limiter.step(np.full(6, 0.5))
    before = np.abs(limiter.v).max()
    for _ in range(5):
        limiter.step(wanted)
    assert limiter.refused["unsound"] == 5
    assert np.abs(limiter.v).max() < before


def test_an_arm_that_breaks_a_limit_standing_still_is_refused(factory):
    """The link frames of a calibrated one lie meters beside it: the limits may not take them for the arm."""
    for changes, says in (
        ({"floor_m": 0.5}, "223.3 mm high, below floor_m, 500 mm"),
        ({"margin_m": 0.1}, "forearm and wrist 3 are 61.3 mm apart, nearer than margin_m, 100 mm"),
    ):
        for arm in (UR3E, apply_calibration(UR3E, factory)):
            Limiter(arm, TeleopConfig(), HOME)
            refused(ArmError, says, Limiter, arm, TeleopConfig(**changes), HOME)


def test_joints_that_are_none_or_outside_are_refused():
    for joints, says in (
        (HOME[:5], "the arm gives no joint angles"),
        ([np.nan, *HOME[1:]], "the arm gives no joint angles"),
        ([*HOME[:5], 2 * math.pi - 0.01], r"joint 6 stands at 359\.4 degrees"),
        (HOME, r"\[0.299, -0.131, 0.303\] m, outside workspace_low_m \[0.0, 0.0, 0.4\] .*high_m \[0.45, 0.45, 0.6\]"),
    ):
        refused(ArmError, says, Limiter, UR3E, TeleopConfig(workspace_low_m=(0.0, 0.0, 0.4)), joints)


CONFIG = TeleopConfig(scale=(3.0, 3.0, 3.0), rate_hz=100.0)
TICK_NS = 10_000_000

any_float = st.floats(allow_nan=True, allow_infinity=True, width=64)
near = st.floats(-0.4, 0.4)
quaternions = st.tuples(near, near, near, near) | st.just((1.0, 0.0, 0.0, 0.0))
messages = st.builds(
    StylusSample,
    t_ns=st.integers(-(10**12), 10**13),
    position_m=st.tuples(near, near, near) | st.tuples(any_float, any_float, any_float),
    quaternion=quaternions | st.tuples(any_float, any_float, any_float, any_float),
    clutch=st.booleans(),
)
# Of one tick: what comes, how long it lasts, and what the edge's own clock does.
steps = st.sampled_from([TICK_NS] * 6 + [0, -5 * TICK_NS, 50 * TICK_NS])
ticks = st.lists(st.tuples(st.lists(messages, max_size=3), st.integers(1, 30), steps), min_size=1, max_size=12)


@pytest.mark.stability
@settings(max_examples=25)
@given(ticks)
def test_limits_hold_whatever_is_sent(script):
    operator = Teleoperator(UR3E, CONFIG, HOME)
    now_ns, commands = 10**12, list[Command]()
    for samples, repeats, step_ns in script:
        commands += drive(operator, [(now_ns, samples)])
        for _ in range(repeats):
            now_ns += step_ns
            commands += drive(operator, [(now_ns, [])])
    still = False
    while not still:
        command, still = operator.stop()
        commands.append(command)
        assert len(commands) < 1000, "the arm did not come to rest"
    assert_within_limits(CONFIG, commands)


@pytest.mark.stability
@settings(max_examples=2)
@given(seed=st.integers(0, 2**32 - 1))
def test_limits_hold_while_an_operator_pulls_everywhere(seed):
    """Sound messages, so that the arm does move: wide swings, a clutch that chatters, lost and late ones. The same
    messages give the same motion to the last bit."""
    config = TeleopConfig(
        scale=(4.0, 4.0, 4.0), rate_hz=100.0, speed_rad_s=3.0, acceleration_rad_s2=8.0, speed_m_s=1.0, gain_per_s=15.0
    )
    runs = []
    for _ in range(2):
        rng, operator = np.random.default_rng(seed), Teleoperator(UR3E, config, HOME)
        position, way, commands = np.zeros(3), np.zeros(3), []
        for k in range(250):
            way = rng.normal(0.0, 0.015, 3) if k % 25 == 0 else way
            position = np.clip(position + way, -0.5, 0.5)
            clutch, late = k > 2 and (rng.random() > 0.02), int(rng.integers(0, 3)) * TICK_NS
            sent = [] if rng.random() < 0.1 else [sample(k * TICK_NS + 1 - late, position, clutch)]
            commands += drive(operator, [(k * TICK_NS, sent)])
        assert_within_limits(config, commands)
        runs.append(np.array([c.joints for c in commands]))
    assert np.array_equal(*runs) and np.abs(runs[0] - HOME).max() > 0.05
    assert operator.mapping.counts.engaged > 0


@pytest.mark.stability
@pytest.mark.parametrize("way", [(0.0, 0.0, -0.004), (-0.004, 0.0, 0.0)])
def test_a_push_into_the_floor_and_into_itself_leaves_the_flange_at_rest_inside(way):
    config = TeleopConfig(rate_hz=50.0)
    operator = Teleoperator(UR3E, config, HOME)
    sent = [sample(k * 20_000_000 + 1, np.array(way) * min(k, 200), k > 0) for k in range(500)]
    commands = drive(operator, [(k * 20_000_000, [each]) for k, each in enumerate(sent)])
    assert_within_limits(config, commands)
    assert np.ptp(UR3E.forward([c.joints for c in commands[-50:]])[:, :3, 3], axis=0).max() < 0.005


@pytest.mark.stability
def test_silence_brings_the_arm_to_rest_within_its_limits():
    operator = Teleoperator(UR3E, CONFIG, HOME)
    sent = [sample(1, clutch=False)] + [sample(k * TICK_NS, (0.001 * k, 0.0, 0.0)) for k in range(1, 60)]
    commands = drive(operator, [(k * TICK_NS, [each]) for k, each in enumerate(sent)])
    assert np.abs(commands[-1].speeds).max() > 0.1, "it moves"
    silent = drive(operator, [((60 + k) * TICK_NS, []) for k in range(80)])
    assert_within_limits(CONFIG, commands + silent)
    # 200 ms of the watchdog, and at most speed / acceleration to stop.
    assert [c.state for c in silent].index(SILENT) == 20
    states = drive(Teleoperator(UR3E, CONFIG, HOME), [(0, [sample(1)]), (200_000_000, []), (200_000_001, [])])
    assert states[1].state != SILENT == states[2].state
    assert not np.any([c.speeds for c in silent[20 + 41 :]])
    # The stylus comes back, far away and with its clutch held: nothing moves.
    back = drive(operator, [((150 + k) * TICK_NS, [sample(k + 1, (0.3, 0.2, 0.1))]) for k in range(40)])
    assert not np.any([c.speeds for c in back])
