"""``camera-node calibrate hand-eye --live --drive``: the arm moves to the poses that the session proposes.

Control is released between two moves, so an operator may move the hand with the pendant. ``roadmap`` checks
the paths against arm, camera and floor, but not against target, cable and other objects, which are unknown.
"""

from __future__ import annotations

import ctypes
import threading

from camera_node.config import ArmConfig, PathConfig
from camera_node.robot.arm.camera_poses import arm_model, base_matrix
from camera_node.robot.arm.drive import confirm_motion, connect_control, open_stream, visit_stops
from camera_node.robot.arm.joint_states import ArmError
from camera_node.robot.arm.roadmap import Roadmap
from camera_node.robot.arm.viewpoint_tour import PathError
from camera_node.robot.calibration import ArmStopped, CalibrationError
from camera_node.robot.calibration.hand_eye.samples import Array
from freshfield.scenario import Scenario


class ArmMover:
    """Moves the hand of a scenario's arm to given poses, with speed and floor of its ``path``. Asks the
    operator first, unless ``agreed_to`` or the arm is simulated. Raises ScenarioError, ArmError, and
    CalibrationError if the answer is no."""

    def __init__(self, scenario: Scenario, config: ArmConfig, agreed_to: bool) -> None:
        self._path = config.path or PathConfig()
        self._model, self._base = arm_model(scenario, config), base_matrix(config)
        self._visited: list[Array] = []
        self._stream = open_stream(config)
        try:
            self._stream.start()
            if not (agreed_to or config.simulated or confirm_motion(config.host)):
                raise CalibrationError("--drive: its space is not clear: nothing was moved")
        except BaseException:
            self._stream.stop()
            raise

    def __call__(self, hand: Array) -> None:
        """Move the hand to ``hand`` (4, 4) in base. Raises PathError if it cannot be reached, and
        ArmStopped."""
        try:
            at = self._stream.now()
            if self._stream.trouble:
                raise ArmError(self._stream.trouble)
            stops = self._route(at, hand)
            control = connect_control(self._stream.host)
            try:
                visit_stops(control, self._stream, stops, self._path, threading.Event())
            except ArmError:
                # Keep the library's object: its destructor would wait for an arm that may be gone.
                ctypes.pythonapi.Py_IncRef(ctypes.py_object(control))
                raise
        except ArmError as error:
            raise ArmStopped(str(error)) from None
        self._visited += [at, *stops]

    def close(self) -> None:
        self._stream.stop()

    def _route(self, at: Array, hand: Array) -> list[Array]:
        there = [p.joints for p in self._model.inverse(hand, at) if not p.singular]
        places = [0] * len(there) + [1] * len(self._visited)
        roadmap = Roadmap(self._model, self._base, [*there, *self._visited], places, self._path.floor_m)
        steps = roadmap.shortest_path(at, {0})
        if steps is None:
            why = "without coming near itself or the floor" if there else "at all"
            raise PathError(f"the arm does not get there {why}: another pose will be proposed")
        return [joints for joints, _ in steps]
