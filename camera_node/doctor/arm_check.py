"""The arm checks of ``camera-node doctor``. Each returns what it found, or raises ValueError."""

from __future__ import annotations

import time

import numpy as np

from camera_node.doctor import doctor_constants as tuned
from camera_node.robot.arm.camera_poses import arm_model, base_matrix, load_hand_eyes, mount_on_flange
from camera_node.robot.arm.joint_states import ArmStream
from camera_node.robot.arm.settings import ArmConfig, PathConfig
from camera_node.robot.arm.tour_planning import plan_tour, viewpoints
from freshfield.clock import WallClock
from freshfield.scenario import Scenario


def hand_eye(scenario: Scenario, arm: ArmConfig) -> str:
    """Check the hand-eye calibration of each camera."""
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
    """Check that the arm sends its joint states at the requested rate."""
    stream = ArmStream(arm.host, WallClock(), arm.frequency_hz)
    stream.start()
    try:
        before = stream.received
        time.sleep(tuned.ARM_LISTEN_S)
        samples, trouble = (stream.received - before) / tuned.ARM_LISTEN_S, stream.trouble
    finally:
        stream.stop()
    if trouble:
        raise ValueError(f"{trouble}: see the teach pendant; poses are right all the same")
    if samples < tuned.ARM_LEAST_STATES * arm.frequency_hz:
        raise ValueError(
            f"{samples:.0f} joint states a second of {arm.frequency_hz:g}: is the network or this machine busy?"
        )
    return f"{arm.host}: running, {samples:.0f} joint states a second"


def path(scenario: Scenario, arm: ArmConfig, tour_path: PathConfig) -> str:
    """Check that the arm reaches most viewpoints of its tour."""
    model, base, mount = arm_model(scenario, arm), base_matrix(arm), mount_on_flange(scenario, arm)
    tour = plan_tour(model, base, mount, tour_path)
    count = len(viewpoints(tour_path))
    summary = f"the arm reaches {tour.reached} of {count} viewpoints"
    if tour.reached >= tuned.ARM_LEAST_REACHED * count:
        return summary
    raise ValueError(f"{summary}: change radius_m, elevations_deg, azimuths_deg or where the base stands")
