"""From a stylus to a target of the flange, from there to speeds of the joints, and their limits, which are computed by
other means than the limiter's own."""

import math
from collections.abc import Iterable, Sequence

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from camera_node.robot.arm import ArmError
from camera_node.robot.arm.capsules import CapsuleModel
from camera_node.robot.arm.kinematics import UR3E, apply_calibration
from camera_node.robot.arm.settings import TeleopConfig
from camera_node.robot.simulated_controller.controller import HOME_RAD
from camera_node.robot.teleop.damped_least_squares import commanded_twist, joint_speeds
from camera_node.robot.teleop.limits import JointRates, Limiter
from camera_node.robot.teleop.mapping import Mapping
from camera_node.robot.teleop.one_euro_filter import OneEuro
from camera_node.robot.teleop.stylus import StylusSample
from camera_node.robot.teleop.teleoperator import SILENT, Command, Teleoperator
from freshfield.geometry import se3, so3_exp
from tests.support import refused

HOME = np.array(HOME_RAD)
EPS = 1e-9


def sample(t_ns: int, position: Sequence[float] = (0.0, 0.0, 0.0), clutch: bool = True) -> StylusSample:
    x, y, z = position
    return StylusSample(t_ns, (x, y, z), (1.0, 0.0, 0.0, 0.0), clutch)


def drive(operator: Teleoperator, ticks: Iterable[tuple[int, Sequence[StylusSample]]]) -> list[Command]:
    """The commands of (now_ns, samples) after one another."""
    return [operator.tick(now_ns, samples) for now_ns, samples in ticks]


def assert_within_limits(config: TeleopConfig, commands: Sequence[Command], start: NDArray[np.float64] = HOME) -> None:
    """Every limit of ``config`` at every tick, from the joints alone: speeds and accelerations are their
    differences."""
    dt_s = 1.0 / config.rate_hz
    q = np.concatenate([start[None], [c.joints for c in commands]])
    assert np.isfinite(q).all()
    low, high = np.array(UR3E.lower_rad), np.array(UR3E.upper_rad)
    assert (q >= low + config.joint_margin_rad - EPS).all()
    assert (q <= high - config.joint_margin_rad + EPS).all()
    speeds = np.diff(q, axis=0) / dt_s
    # Differences of joints lose digits: 1e-15 rad over a tick is 1e-13 rad/s, over its square 1e-11 rad/s^2.
    assert np.abs(speeds).max() <= config.speed_rad_s + EPS
    accelerations = np.diff(np.concatenate([np.zeros((1, 6)), speeds]), axis=0) / dt_s
    assert np.abs(accelerations).max() <= config.acceleration_rad_s2 + 1e-7
    flange = np.array([UR3E.forward(each)[:3, 3] for each in q])
    assert (flange >= np.array(config.workspace_low_m) - EPS).all()
    assert (flange <= np.array(config.workspace_high_m) + EPS).all()
    fastest = np.linalg.norm(np.diff(flange, axis=0), axis=1).max() / dt_s
    assert fastest <= config.speed_m_s + EPS
    apart, lowest = CapsuleModel(UR3E, config.tool_m, config.tool_radius_m).clearance(UR3E.link_frames(q))
    assert apart.min() >= config.margin_m - EPS
    assert lowest.min() >= config.floor_m - EPS


def test_all_joints_change_in_proportion_so_that_the_flange_keeps_its_direction():
    limits = JointRates(np.full(3, -3.0), np.full(3, 3.0), 1.0, 2.0, 0.01)
    wanted = np.array([0.8, -0.4, 0.1])
    first = limits.clamp(np.zeros(3), np.zeros(3), wanted)
    assert np.allclose(first / wanted, first[0] / wanted[0])
    assert first[0] == pytest.approx(0.02)


@pytest.mark.parametrize("rate_hz", [20.0, 125.0, 500.0])
def test_a_joint_comes_to_rest_at_its_end_and_holds_no_other(rate_hz):
    end = 2 * math.pi - 0.05
    config, start = TeleopConfig(rate_hz=rate_hz), np.array([*HOME[:5], end - 0.5])
    limiter, commands = Limiter(UR3E, config, start), list[Command]()
    for _ in range(round(3 * rate_hz)):
        commands.append(Command(*limiter.step([0.05, 0.0, 0.0, 0.0, 0.0, 0.8]), ""))
    assert_within_limits(config, commands, start)
    assert end - 1e-3 < limiter.q[5] <= end and limiter.q[0] == pytest.approx(HOME[0] + 0.15, abs=0.01)
    assert not any(limiter.refused.values())


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
            clutch, late = k > 2 and (rng.random() > 0.02), int(rng.integers(0, 3)) * TICK_NS * (k > 2)
            sent = [] if rng.random() < 0.1 and k > 2 else [sample(k * TICK_NS + 1 - late, position, clutch)]
            commands += drive(operator, [(k * TICK_NS, sent)])
        assert_within_limits(config, commands)
        runs.append(np.array([c.joints for c in commands]))
    assert np.array_equal(*runs) and np.abs(runs[0] - HOME).max() > 0.05
    assert operator.mapping.counts["pressed"] > 0


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


FLANGE = UR3E.forward(HOME)
QUICK = TeleopConfig(filter_hz=1000.0)  # lets a sample pass at once, nearly
MS = 1_000_000


def settle(mapping: Mapping, position, first: int, quaternion=(1.0, 0.0, 0.0, 0.0)) -> np.ndarray:
    for k in range(20):
        mapping.add_sample(StylusSample((first + k) * 10 * MS, position, quaternion, True), FLANGE)
    assert mapping.target is not None
    return mapping.target


def pressed(**changed) -> Mapping:
    """A mapping whose clutch has been let go once."""
    mapping = Mapping(msgspec.structs.replace(QUICK, **changed))
    mapping.add_sample(sample(1, (0.3, 0.1, 0.2), clutch=False), FLANGE)
    return mapping


@pytest.mark.parametrize("follows", [True, False])
def test_the_scaled_map_and_an_orientation_that_follows_or_not(follows):
    """(4.1), with axes turned by 90 degrees."""
    mapping = pressed(scale=(2.0, 1.0, 0.5), yaw_deg=90.0, orientation=follows)
    settle(mapping, (0.3, 0.1, 0.2), 1)
    target = settle(mapping, (0.33, 0.11, 0.16), 100, (np.cos(0.1), np.sin(0.1), 0.0, 0.0))
    expected = FLANGE[:3, 3] + np.array([2.0 * -0.01, 1.0 * 0.03, 0.5 * -0.04])
    assert target[:3, 3] == pytest.approx(expected, abs=1e-6)
    turned = so3_exp([0.0, 0.2, 0.0]) if follows else np.eye(3)
    assert np.allclose(target[:3, :3], turned @ FLANGE[:3, :3], atol=1e-6)


def test_pressing_the_clutch_commands_no_motion_wherever_the_stylus_is():
    mapping = Mapping(QUICK)
    mapping.add_sample(sample(1), FLANGE)
    assert mapping.target is None, "held from the beginning, it was never let go"
    for k in range(2, 60):
        mapping.add_sample(sample(k * MS, (0.01 * k, 0.0, 0.0), clutch=False), FLANGE)
    assert mapping.target is None
    mapping.add_sample(sample(61 * MS, (0.6, 0.0, 0.0)), FLANGE)
    assert mapping.target is not None and np.allclose(mapping.target, FLANGE)
    mapping.add_sample(sample(62 * MS, (0.0, 0.0, 0.0)), FLANGE)
    assert mapping.counts["jumps"] == 1 and np.allclose(mapping.target, FLANGE), "found elsewhere, it is anchored anew"


def test_silence_lets_go_and_asks_for_a_new_press_on_any_clock():
    mapping = pressed()
    mapping.add_sample(sample(10**15, (0.3, 0.1, 0.2)), FLANGE)
    mapping.silence()
    mapping.silence()
    assert mapping.counts["silences"] == 1 and mapping.target is None
    assert mapping.add_sample(sample(5), FLANGE), "the stylus was started anew: its clock begins again"
    assert mapping.target is None
    mapping.add_sample(sample(6, clutch=False), FLANGE)
    mapping.add_sample(sample(7), FLANGE)
    assert mapping.target is not None


@pytest.mark.parametrize(
    "change", [{"p": (np.nan, 0.0, 0.0)}, {"p": (0.0, 0.0, 10.1)}, {"q": (0.0, 0.0, 0.0, 0.0)}, {"t": -5}, {"t": 2**63}]
)
def test_what_is_no_pose_and_what_is_old_is_counted_and_changes_nothing(change):
    assert StylusSample(2**63 - 1, (0.0, 0.0, -10.0), (1.9, 0.0, 0.0, 0.0), True).is_valid()
    mapping = pressed()
    mapping.add_sample(sample(2, (0.3, 0.1, 0.2)), FLANGE)
    before = mapping.target.copy()
    bad = {"t": 5, "p": (0.0, 0.0, 0.0), "q": (1.0, 0.0, 0.0, 0.0), **change}
    assert not mapping.add_sample(StylusSample(bad["t"], bad["p"], bad["q"], True), FLANGE)
    assert mapping.counts["refused"] == 1
    assert not mapping.add_sample(sample(2), FLANGE) and not mapping.add_sample(sample(1), FLANGE)
    assert mapping.counts["refused"] == 3 and np.array_equal(mapping.target, before)


@pytest.mark.parametrize("axis", np.eye(3))
def test_the_filter_follows_each_part_by_its_own_speed(axis):
    def share(hz: float) -> float:
        return 0.02 * np.pi * hz / (0.02 * np.pi * hz + 1.0)

    def turned(angle_rad: float) -> np.ndarray:
        return np.array([np.cos(angle_rad / 2), *np.sin(angle_rad / 2) * axis])

    filtered = OneEuro(2.0, 3.0)
    filtered(np.zeros(3), turned(0.5), 0.01)
    position, quaternion = filtered(0.02 * axis, turned(0.7), 0.01)  # 2 m/s, 20 rad/s
    assert position == pytest.approx(0.02 * share(2.0 + 3.0 * share(2.0) * 2.0) * axis)
    assert quaternion == pytest.approx(turned(0.5 + 0.2 * share(2.0 + 3.0 * share(2.0) * 20.0)))
    for faulty_s, taken_s in ((60.0, 0.5), (0.0, 1e-4), (-3.0, 1e-4)):  # of a clock that leaps
        found = []
        for dt_s in (faulty_s, taken_s):
            filtered.reset()
            filtered(np.zeros(3), turned(0.5), 0.01)
            found.append(filtered(0.1 * axis, turned(0.7), dt_s)[0])
        np.testing.assert_array_equal(*found)


TWIST = TeleopConfig(gain_per_s=4.0, speed_m_s=0.2, speed_rad_s=6.0, acceleration_rad_s2=40.0)


def moved(q, shift, turn=(0.0, 0.0, 0.0)):
    """The flange's pose at ``q``, shifted and turned in the base's axes."""
    flange = UR3E.forward(q)
    return se3(so3_exp(turn) @ flange[:3, :3], flange[:3, 3] + shift)


@pytest.mark.parametrize("wrist", [np.pi / 2, 0.2, 0.05, 0.0])
def test_speeds_follow_the_twist_exactly_but_near_a_singularity(wrist):
    q = HOME.copy()
    q[4] = wrist
    target = moved(q, [0.01, 0.0, -0.02], [0.0, 0.03, 0.01])
    twist, jacobian = commanded_twist(UR3E, TWIST, q, target), UR3E.jacobian(q)
    least = np.linalg.svd(jacobian)[1][-1]
    damping = 0.05 * (1.0 - (least / 0.08) ** 2) if least < 0.08 else 0.0
    expected = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping**2 * np.eye(6), twist)
    found = joint_speeds(UR3E, TWIST, q, target)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert (damping > 0.0) == (wrist < 0.3) and np.abs(found).max() < 2.0
    slow = TeleopConfig(gain_per_s=4.0, speed_m_s=0.2, speed_rad_s=0.01, acceleration_rad_s2=2.0)
    np.testing.assert_allclose(joint_speeds(UR3E, slow, q, target), found * 0.01 / np.abs(found).max())
