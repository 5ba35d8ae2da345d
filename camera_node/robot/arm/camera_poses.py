"""The arm of a scenario: its kinematic model, hand-eye calibrations, and the poses of its cameras."""

from __future__ import annotations

import logging
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from camera_node.pose.providers import FixedPose, PoseProvider
from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND, EYE_TO_HAND, HandEye, MountedCameraPoses, read_hand_eye
from camera_node.robot.arm.kinematics import MODELS, ArmModel, apply_calibration
from camera_node.robot.arm.settings import ArmConfig
from camera_node.settings import beside, errors_of, source_config
from freshfield.clock import WallClock
from freshfield.geometry import Pose, se3, so3_exp
from freshfield.scenario import Scenario, ScenarioError

log = logging.getLogger("camera-node")


def require_arm(scenario: Scenario) -> ArmConfig:
    """The arm of a scenario. Raises ScenarioError if it has none."""
    arm: ArmConfig | None = getattr(source_config(scenario), "arm", None)
    if arm is None:
        raise ScenarioError(f"{scenario.path}: source.arm: missing: this scenario has no arm")
    return arm


def arm_model(scenario: Scenario, config: ArmConfig) -> ArmModel:
    """The arm's model, with the robot's own calibration if the scenario names one. Raises ScenarioError."""
    model = MODELS[config.robot]
    if config.calibration is None:
        return model
    with errors_of(f"{scenario.path}: source.arm.calibration"):
        return apply_calibration(model, beside(scenario, config.calibration))


def base_matrix(config: ArmConfig) -> NDArray[np.float64]:
    """World-from-base (4, 4)."""
    return se3(so3_exp([0, 0, np.deg2rad(config.base_yaw_deg)]), config.base_m)


def load_hand_eyes(scenario: Scenario, config: ArmConfig, cameras: Iterable[str]) -> dict[str, HandEye]:
    """Hand-eye calibrations of those ``cameras`` that ``config`` lists, by camera; the identity for a camera
    without a file yet. Raises ScenarioError."""
    where = f"{scenario.path}: source.arm.cameras"
    for camera in config.cameras:
        if camera not in scenario.cameras:
            raise ScenarioError(f"{where}: {camera!r} is not one of the scenario's cameras")
    found = {}
    for camera in cameras:
        if camera not in config.cameras:
            continue
        file = config.cameras[camera]
        if file is None:
            found[camera] = HandEye(EYE_IN_HAND, np.eye(4))
            continue
        with errors_of(f"{where}.{camera}"):
            found[camera] = read_hand_eye(beside(scenario, file))
    return found


def watching(scenario: Scenario, config: ArmConfig, cameras: Iterable[str]) -> dict[str, NDArray[np.float64]]:
    """Camera-to-world (4, 4) of those ``cameras`` of the arm's that stand still and watch it (eye-to-hand), by camera.
    Raises ScenarioError."""
    mounts, base = load_hand_eyes(scenario, config, cameras), base_matrix(config)
    return {camera: base @ mount.transform for camera, mount in mounts.items() if mount.setup == EYE_TO_HAND}


def mount_on_flange(scenario: Scenario, config: ArmConfig) -> NDArray[np.float64]:
    """Flange-from-camera (4, 4) of the first camera on the arm. Raises ScenarioError if there is none."""
    for mount in load_hand_eyes(scenario, config, config.cameras).values():
        if mount.setup != EYE_TO_HAND:
            return mount.transform
    raise ScenarioError(f"{scenario.path}: source.arm.cameras: none of them is on the arm")


def camera_poses(scenario: Scenario, config: ArmConfig | None, cameras: Iterable[str]) -> dict[str, PoseProvider]:
    """Poses of those ``cameras`` that ``config`` lists, by camera. Connects to the arm if one of them is on
    its flange. Raises ScenarioError and ArmError."""
    if config is None:
        return {}
    mounts, fixed = load_hand_eyes(scenario, config, cameras), watching(scenario, config, cameras)
    model, base = arm_model(scenario, config), base_matrix(config)
    poses: dict[str, PoseProvider] = {camera: FixedPose(Pose.from_matrix(at)) for camera, at in fixed.items()}
    if moving := [camera for camera in mounts if camera not in fixed]:
        from camera_node.robot.arm.joint_states import ArmStream, FlangePoses

        stream = ArmStream(
            config.host, WallClock(), config.frequency_hz, config.pairing == "interpolated", config.max_gap_ms
        )
        stream.start()
        log.info("arm at %s: connected; it carries %s", config.host, ", ".join(moving))
        flange = FlangePoses(stream, model, base)
        poses.update({camera: MountedCameraPoses(flange, mounts[camera]) for camera in moving})
    return poses
