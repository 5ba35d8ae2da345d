"""Records both streams of a guided calibration: hand poses and detected target poses.

Each keeps its own stamps, and ``time_offset`` estimates the offset between them (camera delay, transport of
the joint states) from the motion.
"""

from __future__ import annotations

from dataclasses import replace

from camera_node.config import ArmConfig
from camera_node.robot.arm.camera_poses import arm_model
from camera_node.robot.arm.joint_states import ArmStream
from camera_node.robot.calibration.files import Track, sorted_track
from camera_node.robot.calibration.hand_eye.samples import Array
from camera_node.robot.calibration.hand_eye.session import GOOD_SPREAD_DEG, MIN_POSES, HandEyeStep
from freshfield.clock import WallClock
from freshfield.scenario import Scenario

# Motion with the target in sight. The offset's deviation falls with the square root of its duration.
MIN_SECONDS = 10.0
_GAP_NS = 125_000_000  # longest gap between two detections that counts as motion


class StreamRecorder:
    """Records poses (4, 4) with their stamps (ns). One thread may add hands while another adds targets."""

    def __init__(self) -> None:
        self._hands: list[tuple[int, Array]] = []
        self._targets: list[tuple[int, Array]] = []
        self._seen_ns = 0

    def add_hand(self, t_ns: int, pose: Array) -> None:
        """pose: hand in base."""
        self._hands.append((t_ns, pose))

    def add_target(self, t_ns: int, pose: Array) -> None:
        """pose: target in camera."""
        if self._targets:
            gap_ns = t_ns - self._targets[-1][0]
            self._seen_ns += gap_ns if 0 < gap_ns <= _GAP_NS else 0
        self._targets.append((t_ns, pose))

    @property
    def seen_s(self) -> float:
        """Seconds with the target in sight."""
        return self._seen_ns / 1e9

    def with_stream_advice(self, step: HandEyeStep) -> HandEyeStep:
        """The step with advice for recording streams. ``std_mm`` does not count, because it contains the
        unknown offset."""
        varied = step.count >= MIN_POSES and step.diversity.axis_spread_deg >= GOOD_SPREAD_DEG
        if not varied:
            return step
        if self.seen_s >= MIN_SECONDS:
            return replace(step, enough=True, advice="enough")
        left = f"keep moving, irregularly, the target in sight: {MIN_SECONDS - self.seen_s:.0f} s more"
        return replace(step, enough=False, advice=left)

    def hand(self) -> Track:
        """The hand's stream. Raises CalibrationError for fewer than two poses."""
        return sorted_track(*_columns(self._hands), "joint states")

    def target(self) -> Track:
        """The target's stream. Raises CalibrationError for fewer than two poses."""
        return sorted_track(*_columns(self._targets), "sightings of the target")


def follow_arm(scenario: Scenario, config: ArmConfig, tracks: StreamRecorder) -> ArmStream:
    """Record the scenario's arm into ``tracks``, as hand poses in its base, until the stream is stopped.
    Raises ScenarioError and ArmError."""

    def add_hand(t_ns: int, joints: Array) -> None:
        tracks.add_hand(t_ns, model.forward(joints))

    model = arm_model(scenario, config)
    stream = ArmStream(config.host, WallClock(), config.frequency_hz, on_sample=add_hand)
    stream.start()
    return stream


def _columns(rows: list[tuple[int, Array]]) -> tuple[list[int], list[Array]]:
    return [t_ns for t_ns, _ in list(rows)], [pose for _, pose in list(rows)]
