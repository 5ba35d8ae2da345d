"""Motion of a camera in the synthetic world that a simulated arm carries (thesis 4.2, 4.3).

Its image is rendered from the arm's true joints at the frame's instant, which the simulated controller knows. The
frame's pose is computed as on a real bench: joint states with their own stamps, paired by time, forward
kinematics and hand-eye calibration. The difference of both is the pose error.
"""

from __future__ import annotations

import io
import json
import socket
import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from camera_node.pose.providers import PoseGapError, PoseProvider
from camera_node.robot.arm.camera_poses import arm_model, base_matrix, camera_poses, load_hand_eyes
from camera_node.robot.arm.kinematics import ArmModel
from camera_node.robot.arm.settings import ArmConfig
from camera_node.robot.simulated_controller import TRUTH_PORT
from camera_node.robot.simulated_controller import simulated_controller_constants as tuned
from camera_node.robot.simulated_controller.joint_motion import STEP_S
from freshfield.geometry import Array, Pose
from freshfield.scenario import Scenario

_MAX_OFFSET_NS = 2 * round(STEP_S * 1e9)  # between the requested instant and the arm's answer


class TruthClient:
    """True joint angles of a simulated arm. Connects at the first request, and again after a failure. Thread-safe."""

    def __init__(self, host: str) -> None:
        self.host = host
        # One connection: the file for requests, and the buffer for answers, as an unbuffered file reads byte by byte.
        self._link: tuple[socket.SocketIO, io.BufferedReader] | None = None
        self._lock = threading.Lock()

    def joints(self, t_ns: int) -> Array:
        """Joint angles (6,) at ``t_ns``. Raises PoseGapError without an answer for this instant."""
        with self._lock:
            return self._ask(t_ns)

    def _ask(self, t_ns: int) -> Array:
        try:
            if self._link is None:
                with socket.create_connection((self.host, TRUTH_PORT), tuned.TRUTH_TIMEOUT_S) as connected:
                    file = connected.makefile("rwb", buffering=0)
                self._link = file, io.BufferedReader(file)
            requests, answers = self._link
            requests.write(b"%d\n" % t_ns)
            answer = answers.readline()
            if not answer.endswith(b"\n"):
                raise OSError("it closed the connection")
        except OSError as error:
            self._link = None
            raise PoseGapError(
                f"simulated arm at {self.host}: {error}: is camera-node simulate-arm running there?"
            ) from None
        known = json.loads(answer)
        offset_ns = abs(known["t_ns"] - t_ns)
        if offset_ns > _MAX_OFFSET_NS:
            raise PoseGapError(
                f"simulated arm at {self.host}: what it knows nearest is {offset_ns / 1e6:.0f} ms away: is "
                "this machine too busy to simulate it?"
            )
        return np.array(known["q"])


@dataclass(frozen=True)
class FlangeMotion:
    """Motion of one camera on the flange, which carries it through the synthetic world.

    poses: the camera's, as they are known of a real arm. truth: of the simulated one.
    base: true world-from-base (4, 4). mount: true flange-from-camera (4, 4).
    """

    poses: PoseProvider
    truth: TruthClient
    arm: ArmModel
    base: Array
    mount: Array
    lap_s: float | None = None

    def pose(self, t_s: float) -> Array:
        """True camera-to-world (4, 4). Raises PoseGapError."""
        return self.base @ self.arm.forward(self.truth.joints(round(t_s * 1e9))) @ self.mount

    def measured(self, t_s: float) -> tuple[Pose, int]:
        """See ``PoseProvider.at``."""
        return self.poses.at(round(t_s * 1e9))


def open_flange(scenario: Scenario, config: ArmConfig, cameras: Sequence[str]) -> dict[str, FlangeMotion]:
    """Connect to the arm that carries ``cameras``. Raises ScenarioError and ArmError."""
    mounts = load_hand_eyes(scenario, config, cameras)
    poses = camera_poses(scenario, config, cameras)
    truth, arm, base = TruthClient(config.host), arm_model(scenario, config), base_matrix(config)
    return {c: FlangeMotion(poses[c], truth, arm, base, mounts[c].transform) for c in cameras}
