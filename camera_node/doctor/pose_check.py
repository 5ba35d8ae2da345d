"""The part of ``camera-node doctor`` that compares how a carried camera's images move with how its poses turn.

Where a camera turns, its image shifts by the focal length times the angle. So the shifts from image to image, found by
phase correlation, follow the turns of the poses. If they follow those of another instant, the poses are late or early.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.doctor import doctor_constants as tuned
from camera_node.settings import RecordedConfig
from camera_node.sources.base import Source, pixels
from camera_node.sources.registry import open_sources
from freshfield.geometry import Array, so3_log
from freshfield.scenario import Scenario


def check(scenario: Scenario, config: RecordedConfig, data: Path | None) -> str:
    """What the poses of each training camera that moves are worth, in words; "" if none moves. Raises ValueError
    or OSError."""
    if scenario.held_out_every:  # whole paths, of which held-out captures are a part
        scenario = replace(scenario, cameras=scenario.training, held_out=(), held_out_every=1)
    said = []
    for camera, source in open_sources(scenario, config, scenario.training, data).items():
        images, poses, focal_px, period_ms = _captures(source, config.codec)
        if len(images) >= tuned.POSES_LEAST_CAPTURES:
            said.append(f"{camera} {compare(images, poses, focal_px, period_ms)}")
    return "; ".join(said)


def compare(images: list[NDArray[np.float32]], poses: Array, focal_px: float, period_ms: float) -> str:
    """One line on the poses of consecutive captures.

    images: gray (H, W). poses: (N, 4, 4), camera-to-world. focal_px: of the images. period_ms: between two captures.
    Raises ValueError.
    """
    window = cv2.createHanningWindow(images[0].shape[::-1], cv2.CV_32F)
    shifts = np.array([cv2.phaseCorrelate(a, b, window)[0] for a, b in pairwise(images)])
    turns = np.array([so3_log(a[:3, :3].T @ b[:3, :3]) for a, b in pairwise(poses)])
    expected = focal_px * np.stack([-turns[:, 1], turns[:, 0]], axis=1)
    steps_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    speed, rate = 1e3 * float(np.median(steps_m)) / period_ms, np.rad2deg(np.linalg.norm(turns, axis=1).mean())
    said = f"moves at {speed:.2g} m/s, turns at {1e3 * rate / period_ms:.2g} degrees/s"
    if speed > tuned.POSES_FAST_M_PER_S:
        raise ValueError(f"{said}: are its poses in meters?")
    if shifts.std(axis=0).max() < tuned.POSES_MOVE_PX:
        return f"{said}; its images hardly move"
    if not turns.any():
        raise ValueError(f"{said}, while its images shift: do its poses lack the rotation?")
    lags = np.arange(-tuned.POSES_LARGEST_LAG, tuned.POSES_LARGEST_LAG + tuned.POSES_LAG_STEP, tuned.POSES_LAG_STEP)
    found = np.array([_correlation(shifts, expected, lag) for lag in lags])
    now, best = float(found[len(lags) // 2]), int(found.argmax())
    late_ms = float(lags[best]) * period_ms
    for axis, direction in enumerate(("sideways", "up and down")):
        if _correlation(shifts[:, [axis]], expected[:, [axis]], 0.0) < -tuned.POSES_AGREE:
            raise ValueError(f"{said}, but its images move the other way {direction}: are its axes OpenCV's?")
    if found[best] < tuned.POSES_AGREE:
        return f"{said}; its images tell nothing of its turns (correlation {found[best]:.2f})"
    if abs(late_ms) > tuned.POSES_LATE_MS and found[best] > now + tuned.POSES_GAIN:
        early = "late" if late_ms > 0 else "early"
        raise ValueError(
            f"{said}; its poses are some {abs(late_ms):.0f} ms {early}: its images move as they do, at another time "
            f"(correlation {found[best]:.2f} instead of {now:.2f}); shift their times (source.trajectory.start_s)"
        )
    return f"{said}; images and poses move together (correlation {found[best]:.2f})"


def _correlation(shifts: Array, expected: Array, lag: float) -> float:
    """Correlation of both axes' shifts (N, 2) with what the poses expect ``lag`` captures later."""
    place = np.arange(len(shifts))
    inside = (place + lag >= 0) & (place + lag <= place[-1])
    later = np.stack([np.interp(place[inside] + lag, place, axis) for axis in expected.T], axis=1)
    a, b = later - later.mean(axis=0), shifts[inside] - shifts[inside].mean(axis=0)
    return float((a * b).sum() / max(np.sqrt((a * a).sum() * (b * b).sum()), 1e-12))


def _captures(source: Source, codec: str) -> tuple[list[NDArray[np.float32]], Array, float, float]:
    """Small gray images and poses of consecutive captures, the images' focal length, and the time between two, ms; none
    of a camera that stands still."""
    images: list[NDArray[np.float32]] = []
    poses: list[Array] = []
    ticks: list[int] = []
    focal_px = 1.0
    for tick in range(tuned.POSES_CAPTURES):
        if len(images) == tuned.POSES_LEAST_CAPTURES and _equal(poses):
            break
        if tick and source.content(tick) < source.content(tick - 1):
            break  # the recording plays back, where late poses are early
        if tick and source.content(tick) == source.content(tick - 1):
            continue  # the rate is higher than the recording's
        try:
            shot = source.read(source.content(tick))
        except ValueError:  # before the first pose of a trajectory, after its last, or a damaged file: others report it
            if len(images) >= tuned.POSES_LEAST_CAPTURES:
                break
            images, poses, ticks = [], [], []  # shifts are found between consecutive captures
            continue
        lens = shot.intrinsics
        gray = cv2.cvtColor(pixels(shot, codec)[..., :3], cv2.COLOR_RGB2GRAY)
        size = (tuned.POSES_WIDTH_PX, max(1, round(tuned.POSES_WIDTH_PX * lens.height / lens.width)))
        images.append(cv2.resize(gray, size, interpolation=cv2.INTER_AREA).astype(np.float32))
        poses.append(shot.pose.matrix())
        ticks.append(tick)
        focal_px = lens.fx * tuned.POSES_WIDTH_PX / lens.width
    source.release()
    if _equal(poses):
        return [], np.empty((0, 4, 4)), 1.0, 1.0
    return images, np.array(poses), focal_px, 1e3 * (ticks[-1] - ticks[0]) / (len(ticks) - 1) / float(source.fps)


def _equal(poses: list[Array]) -> bool:
    return all(np.array_equal(pose, poses[0]) for pose in poses)
