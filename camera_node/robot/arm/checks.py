"""What ``camera-node doctor`` checks of an arm. Each check returns what it found, or raises ValueError."""

from __future__ import annotations

import time

import numpy as np

from camera_node.config import ArmConfig, PathConfig
from camera_node.robot.arm.camera_poses import arm_model, base_matrix, load_hand_eyes
from camera_node.robot.arm.hand_eye_mount import EYE_TO_HAND
from camera_node.robot.arm.joint_states import ArmStream
from camera_node.robot.arm.viewpoint_tour import plan_tour, viewpoints
from freshfield.clock import WallClock
from freshfield.scenario import Scenario

_LISTEN_S = 0.5
_LEAST_REACHED = 0.6  # of a tour's viewpoints; with fewer, a side of the target stays unseen


def hand_eye(scenario: Scenario, arm: ArmConfig) -> str:
    """The hand-eye calibration of each camera."""
    model = arm_model(scenario, arm)
    mounts = load_hand_eyes(scenario, arm, arm.cameras)
    for camera, mount in mounts.items():
        if mount.details.get("example") and not arm.simulated:
            raise ValueError(
                f"{arm.cameras[camera]}: still the example's, not this bench's: camera-node calibrate "
                f"hand-eye --live {scenario.path} --camera {camera} --board SPEC --out FILE (with {camera}: "
                "null)"
            )
    where = [
        f"{camera} {mount.setup}, {1e3 * float(np.linalg.norm(mount.transform[:3, 3])):.0f} mm away"
        for camera, mount in mounts.items()
    ]
    own = "" if arm.calibration else "; the robot's own calibration.conf is not given: expect millimeters"
    return f"{model.name}: {', '.join(where)}{own if not arm.simulated else ''}"


def joint_states(arm: ArmConfig) -> str:
    """Whether the arm sends its joint states at the rate that was asked for."""
    stream = ArmStream(arm.host, WallClock(), arm.frequency_hz)
    stream.start()
    try:
        before = stream.status()["samples"]
        time.sleep(_LISTEN_S)
        status = stream.status()
    finally:
        stream.stop()
    if status["trouble"]:
        raise ValueError(f"{status['trouble']}: see the teach pendant; poses are right all the same")
    samples = (status["samples"] - before) / _LISTEN_S
    if samples < 0.8 * arm.frequency_hz:
        raise ValueError(
            f"{samples:.0f} joint states a second of {arm.frequency_hz:g}: is the network or this "
            "machine busy?"
        )
    return f"{arm.host}: running, {samples:.0f} joint states a second"


def path(scenario: Scenario, arm: ArmConfig, tour_path: PathConfig) -> str:
    """Whether the arm reaches most viewpoints of its tour."""
    carried = [m for m in load_hand_eyes(scenario, arm, arm.cameras).values() if m.setup != EYE_TO_HAND]
    if not carried:
        raise ValueError("no camera is on the hand: there is nothing to drive")
    model, base, mount = arm_model(scenario, arm), base_matrix(arm), carried[0].transform
    found = plan_tour(model, base, mount, tour_path)
    count = len(viewpoints(tour_path))
    said = f"the arm reaches {found.reached} of {count} viewpoints"
    if found.reached >= _LEAST_REACHED * count:
        return said
    rings = ", ".join(
        f"{elevation_deg:g} degrees {reached} of {count // len(tour_path.elevations_deg)}"
        for elevation_deg, reached in zip(tour_path.elevations_deg, found.reached_by_ring(tour_path))
    )
    raise ValueError(
        f"{said} ({rings}): change radius_m, elevations_deg, azimuths_deg or where the base stands"
    )
