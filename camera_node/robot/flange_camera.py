"""A camera in the synthetic world, carried by a simulated arm (thesis 4.2, 4.3).

It renders from the arm's true joints at the frame's instant, which the simulated controller knows. The
frame's pose is computed as on a real bench: joint states with their own stamps, paired by time, forward
kinematics and hand-eye calibration. The difference of both is the pose error.
"""

from __future__ import annotations

import contextlib
import json
import socket
import threading
from collections.abc import Mapping
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from camera_node.pose.providers import Closable, PoseGapError, PoseProvider
from camera_node.robot.arm.camera_poses import arm_model, base_matrix, camera_poses, load_hand_eyes
from camera_node.robot.arm.kinematics import ArmModel
from camera_node.robot.simulated_controller import TRUTH_PORT
from camera_node.robot.simulated_controller.joint_motion import STEP_S
from camera_node.settings import ArmConfig
from camera_node.sources.base import Shot, Source
from camera_node.synthetic import Scene
from camera_node.synthetic.effects import NO_EFFECTS, Effects
from freshfield.geometry import Pinhole
from freshfield.scenario import Scenario, ScenarioError

Array = NDArray[np.float64]

_TIMEOUT_S = 1.0
_MAX_OFFSET_NS = 2 * round(STEP_S * 1e9)  # between the requested instant and the arm's answer


class TruthClient:
    """True joint angles of a simulated arm. Connects at the first request, and again after a failure. Thread-safe."""

    def __init__(self, host: str) -> None:
        self.host = host
        self._socket: socket.socket | None = None
        self._lock = threading.Lock()

    def joints(self, t_ns: int) -> Array:
        """Joint angles (6,) at ``t_ns``. Raises PoseGapError without an answer for this instant."""
        with self._lock:
            return self._ask(t_ns)

    def _ask(self, t_ns: int) -> Array:
        try:
            if self._socket is None:
                self._socket = socket.create_connection((self.host, TRUTH_PORT), _TIMEOUT_S)
            self._socket.sendall(b"%d\n" % t_ns)
            answer = b""
            while not answer.endswith(b"\n"):
                part = self._socket.recv(4096)
                if not part:
                    raise OSError("it closed the connection")
                answer += part
        except OSError as error:
            self.close()
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

    def close(self) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.close()
        self._socket = None


class FlangeCamera(Source):
    """One camera on the flange. base: true world-from-base (4, 4). mount: true flange-from-camera (4, 4)."""

    def __init__(
        self,
        camera: str,
        fps: Fraction,
        scene: Scene,
        lens: Pinhole,
        effects: Effects,
        poses: PoseProvider,
        truth: TruthClient,
        arm: ArmModel,
        base: Array,
        mount: Array,
    ) -> None:
        self.camera, self.fps = camera, fps
        self.intrinsics = lens
        self._scene, self._lens, self._effects = scene, lens, effects
        self._poses, self._truth = poses, truth
        self._arm, self._base, self._mount = arm, base, mount

    def read(self, content: int) -> Shot:
        """Render the image at the tick's instant. Raises PoseGapError."""
        t_ns = content * 10**9 * self.fps.denominator // self.fps.numerator
        true_pose = self._base @ self._arm.forward(self._truth.joints(t_ns)) @ self._mount
        pose, gap_ns = self._poses.at(t_ns)
        view = self._scene.view(self._lens, true_pose)
        image = view.image((t_ns % round(self._scene.period_s * 1e9)) * 1e-9)
        if self._effects.image:
            image = self._effects.apply(image, content, t_ns * 1e-9)
        return Shot(image, self._effects.reported_pose(pose, content, t_ns * 1e-9), self.intrinsics, gap_ns)

    def close(self) -> None:
        """Disconnect from the arm."""
        if isinstance(self._poses, Closable):
            self._poses.close()
        self._truth.close()


def open_flange_cameras(
    scenario: Scenario,
    config: ArmConfig,
    fps: Fraction,
    seen: Mapping[str, tuple[Scene, Pinhole]],
    effects: Mapping[str, Effects | None],
) -> dict[str, Source]:
    """Connect to the arm and open the cameras on its flange. seen: each camera's scene and lens.
    Raises ScenarioError and ArmError."""
    for camera in seen:
        made = effects.get(camera)
        if made is not None and made.depth:
            names = ", ".join(type(effect).__module__.rsplit(".", 1)[1] for effect in made.depth)
            raise ScenarioError(
                f"{scenario.path}: source.effects: {names}: not for a camera that an arm carries ({camera}): "
                "they take the camera to stand still"
            )
    mounts = load_hand_eyes(scenario, config, seen)
    poses = camera_poses(scenario, config, seen)
    truth, arm, base = TruthClient(config.host), arm_model(scenario, config), base_matrix(config)
    return {
        camera: FlangeCamera(
            camera,
            fps,
            scene,
            lens,
            effects.get(camera) or NO_EFFECTS,
            poses[camera],
            truth,
            arm,
            base,
            mounts[camera].transform,
        )
        for camera, (scene, lens) in seen.items()
    }
