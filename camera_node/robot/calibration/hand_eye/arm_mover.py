"""``camera-node calibrate hand-eye --live --drive``: the arm goes by itself where the session wants the hand.

Between two moves nobody holds the arm's controls: whoever stands by may bring the hand elsewhere with the
pendant. Ways are tested as ``drive-arm`` tests them (``robot.arm.roadmap``): arm, camera and floor
are known, the target, the cable and whatever else stands there are not.
"""

from __future__ import annotations

import ctypes
import threading

import numpy as np

from camera_node.config import ArmConfig, PathConfig
from camera_node.pose.providers import PoseGapError
from camera_node.robot.arm.camera_poses import arm_model, base_matrix
from camera_node.robot.arm.drive import DriveLimits, confirm_motion, connect_control, open_stream, visit_stops
from camera_node.robot.arm.joint_states import ArmError
from camera_node.robot.arm.roadmap import Roadmap
from camera_node.robot.arm.viewpoint_tour import PathError
from camera_node.robot.calibration import ArmStopped, CalibrationError
from camera_node.robot.calibration.hand_eye.samples import Array
from freshfield.clock import WallClock
from freshfield.scenario import Scenario


class Mover:
    """Brings the hand of a scenario's arm to poses. Asks first, as ``drive-arm`` does, unless ``agreed_to``
    or the arm is simulated; speed and floor are those of its ``path``. Raises ScenarioError, ArmError, and
    CalibrationError where the answer is no."""

    def __init__(self, scenario: Scenario, config: ArmConfig, agreed_to: bool) -> None:
        path = config.path or PathConfig()
        self._model, self._base = arm_model(scenario, config), base_matrix(config)
        self._floor_m, self._pace = path.floor_m, DriveLimits.of(config, path)
        self._been: list[Array] = []
        self._stream = open_stream(config)
        try:
            self._stream.start()
            if not (agreed_to or config.simulated or confirm_motion(config.host)):
                raise CalibrationError("--drive: its space is not clear: nothing was moved")
        except BaseException:
            self._stream.stop()
            raise

    def __call__(self, hand: Array) -> None:
        """Go where the hand is at ``hand`` (4, 4), in base, and come to rest there. Raises PathError for a
        pose that cannot be had, and ArmStopped."""
        try:
            at, _ = self._stream.at(WallClock().now_ns(), 0.0)
            if self._stream.trouble:
                raise ArmError(self._stream.trouble)
            stops = self._way(at, hand)
            control = connect_control(self._stream.host)
            try:
                visit_stops(control, self._stream, stops, self._pace, threading.Event())
            except ArmError:
                # The library's destructor would wait for an arm that may be gone: it is never called.
                ctypes.pythonapi.Py_IncRef(ctypes.py_object(control))
                raise
        except (ArmError, PoseGapError) as error:
            raise ArmStopped(str(error)) from None
        self._been += [at, *stops]

    def close(self) -> None:
        self._stream.stop()

    def _way(self, at: Array, hand: Array) -> list[Array]:
        there = [p.joints for p in self._model.inverse(hand, at) if not p.singular]
        places = [0] * len(there) + [1] * len(self._been)
        roadmap = Roadmap(self._model, self._base, [*there, *self._been], places, self._floor_m)
        way = roadmap.shortest_path(np.asarray(at), {0})
        if way is None:
            why = "without coming near itself or the floor" if there else "at all"
            raise PathError(f"the arm does not get there {why}: another pose will be proposed")
        return [joints for joints, _ in way]
