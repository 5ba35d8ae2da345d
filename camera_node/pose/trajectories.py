"""The poses that a scenario's ``source.trajectory`` names, by camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from camera_node.pose.providers import PoseProvider
from camera_node.pose.trajectory_file import read_tum
from camera_node.settings import TrajectoryConfig, errors_of
from freshfield.scenario import Scenario, ScenarioError

if TYPE_CHECKING:
    from camera_node.robot.arm.hand_eye_mount import HandEye


def trajectory_poses(
    scenario: Scenario, config: TrajectoryConfig, cameras: Sequence[str], base: Path, live: bool = False
) -> dict[str, PoseProvider]:
    """Poses of those ``cameras`` for which the scenario names a TUM file, below ``base``.

    live: a tracker writes the files while the cameras run; else they are whole, on the clip's time scale.
    Raises ScenarioError.
    """
    where = f"{scenario.path}: source.trajectory"
    if live and config.start_s:
        raise ScenarioError(f"{where}.start_s: is for recordings: times of a tracker are seconds since 1970")
    found: dict[str, PoseProvider] = {}
    interpolated, max_gap_ns = config.pairing == "interpolated", round(config.max_gap_ms * 1e6)
    for camera in set(cameras) & set(config.files):
        file, mount = base / config.files[camera], flange_mount(scenario, config, base)
        if live:
            from camera_node.pose.tracker import TrackerPoses

            found[camera] = TrackerPoses(file, interpolated, max_gap_ns)
        else:
            with errors_of(f"{where}.files.{camera}"):
                found[camera] = read_tum(file, interpolated, max_gap_ns, round(config.start_s * 1e9))
        if mount is not None:
            from camera_node.robot.arm.hand_eye_mount import MountedCameraPoses

            found[camera] = MountedCameraPoses(found[camera], mount)
    return found


def flange_mount(scenario: Scenario, config: TrajectoryConfig, base: Path) -> HandEye | None:
    """Where the flange that the files are of holds its camera; None: they are of the camera. Raises ScenarioError."""
    if not config.hand_eye:
        return None
    from camera_node.robot.arm.hand_eye_mount import EYE_TO_HAND, read_hand_eye

    with errors_of(f"{scenario.path}: source.trajectory.hand_eye"):
        mount = read_hand_eye(base / config.hand_eye)
        if mount.setup == EYE_TO_HAND:
            raise ValueError(f"{config.hand_eye} is {EYE_TO_HAND}: its camera stands still, nothing carries it")
    return mount
