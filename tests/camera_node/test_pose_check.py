"""Poses of a carried camera are compared with its images: lateness, axes, units and lacking rotations are said."""

from __future__ import annotations

import json
from functools import cache

import cv2
import numpy as np
import pytest

from camera_node import pose_check
from camera_node.settings import RecordedConfig, source_config
from camera_node.synthetic import make_scene
from camera_node.synthetic.walk import walks_through
from freshfield.geometry import OPENGL_TO_OPENCV
from freshfield.scenario import parse

PERIOD_S = 0.1


@cache
def filmed(count: int = 40) -> tuple[list[np.ndarray], float]:
    """Small gray images of a walk through the room, and their focal length."""
    scene = make_scene("room", {"people": 0, "width": 160, "height": 120, "supersample": 1})
    walk, lens = walks_through(scene, ["hand"])["hand"], scene.cameras["cam00"][0]
    images = [scene.view(lens, walk.pose(k * PERIOD_S)).image(0.0) for k in range(count)]
    small = [cv2.resize(image, (80, 60), interpolation=cv2.INTER_AREA) for image in images]
    return [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) for image in small], lens.fx / 2


def poses(late_s: float = 0.0, count: int = 40) -> np.ndarray:
    walk = walks_through(make_scene("room"), ["hand"])["hand"]
    return np.array([walk.pose(k * PERIOD_S - late_s) for k in range(count)])


def said(found: np.ndarray) -> str:
    images, focal_px = filmed()
    return pose_check.compare(images, found, focal_px, 1e3 * PERIOD_S)


@pytest.mark.stability
@pytest.mark.parametrize(
    ("late_s", "message"), [(0.0, "together"), (0.1, "some 1[0-9]{2} ms late"), (-0.2, "some 2[0-9]{2} ms early")]
)
def test_poses_of_another_instant_are_said_with_their_delay(late_s, message):
    if not late_s:
        assert "images and poses move together" in said(poses()) and "moves at 0.4" in said(poses())
        return
    with pytest.raises(ValueError, match=message):
        said(poses(late_s))


@pytest.mark.stability
def test_other_units_other_axes_and_poses_without_rotation_are_said():
    right = poses()
    millimeters, still = right.copy(), right.copy()
    millimeters[:, :3, 3] *= 1e3
    still[:, :3, :3] = np.eye(3)
    for wrong, message in (
        (millimeters, "in meters"),
        (still, "lack the rotation"),
        (right @ OPENGL_TO_OPENCV, "axes"),
    ):
        with pytest.raises(ValueError, match=message):
            said(wrong)


@pytest.mark.stability
def test_images_that_tell_nothing_are_not_held_against_the_poses():
    noise = np.random.default_rng(0).uniform(0, 255, (40, 60, 80)).astype(np.float32)
    assert "tell nothing" in pose_check.compare(list(noise), poses(), 60.0, 100.0)
    flat = [np.full((60, 80), 90.0, np.float32)] * 40
    assert "hardly move" in pose_check.compare(flat, poses(), 60.0, 100.0)


@pytest.mark.parametrize(("still", "damaged"), [(0, ()), (3, (0, 5))], ids=["whole", "stands, damaged"])
def test_a_recording_is_read_as_it_is_streamed(tmp_path, still, damaged):
    images, focal_px = filmed()
    frames = []
    for k, image in enumerate([images[0]] * still + images):
        data = cv2.imencode(".png", image.astype(np.uint8))[1].tobytes()
        (tmp_path / f"{k:03d}.png").write_bytes(data[: len(data) // 2] if k in damaged else data)
        matrix = (poses(0.1)[max(k - still, 0)] @ OPENGL_TO_OPENCV).tolist()
        frames.append({"file_path": f"{k:03d}.png", "transform_matrix": matrix, "time": 2 + k * PERIOD_S})
    data = {"fl_x": focal_px, "w": 80, "h": 60, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    cameras = {"ids": ["hand", "kept"], "held_out": ["kept"], "held_out_every": 8}
    found = parse({"cameras": cameras, "source": {"kind": "transforms", "data": str(tmp_path)}}, tmp_path / "s.yaml")
    config = source_config(found)
    assert isinstance(config, RecordedConfig)
    with pytest.raises(ValueError, match="ms late"):
        pose_check.check(found, config, None)
