"""Videos with a calibration: real files, exact frames, poses and pixel centres."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera_node.settings import source_config
from camera_node.sources.datasets.photo import ImageOptions
from camera_node.sources.datasets.records import DatasetError
from camera_node.sources.datasets.video import Clip, load_dataset
from camera_node.sources.registry import open_sources
from camera_node.sources.rig_calibration import load_calibration
from freshfield.geometry import look_at, se3_inverse
from freshfield.scenario import ScenarioError, parse
from tests.conftest import data_dir

FRAMES = 40


def write_rig(folder: Path, cameras: int = 2, width: int = 64, height: int = 48, faster: float = 0.0) -> Path:
    """Videos whose frame k has the brightness 16 + 6 k, and their calibration JSON. faster: more frames a second from
    camera to camera."""
    (folder / "videos").mkdir(parents=True)
    rig = {}
    for c in range(cameras):
        file = str(folder / f"videos/cam{c:02d}.mp4")
        writer = cv2.VideoWriter(file, cv2.VideoWriter.fourcc(*"mp4v"), 20.0 + faster * c, (width, height))
        for k in range(FRAMES):
            writer.write(np.full((height, width, 3), 16 + 6 * k, np.uint8))
        writer.release()
        world_to_camera = se3_inverse(look_at([3, c, 1], [0, 0, 0]))
        rig[f"cam{c:02d}"] = {
            "width": width,
            "height": height,
            "K": [[50 * width / 64, 0, width / 2 - 0.5], [0, 51 * width / 64, height / 2 - 0.5], [0, 0, 1]],
            "dist_k1k2p1p2": [0.01, 0, 0, 0],
            "R_world_to_cam": world_to_camera[:3, :3].tolist(),
            "t_world_to_cam": world_to_camera[:3, 3].tolist(),
        }
    file = folder / "calibration_opencv.json"
    file.write_text(json.dumps(rig))
    return file


def video_scenario(data: Path, cameras: int = 2, **source):
    section = {"kind": "video", "data": str(data), **source}
    return parse({"cameras": {"count": cameras, "held_out": ["cam00"]}, "source": section}, Path("v.yaml"))


def opened(scenario, cameras=None):
    return open_sources(scenario, source_config(scenario), cameras or scenario.cameras)


def shade(shot) -> int:
    """The frame's number, off its brightness (the codec darkens by about three counts)."""
    return round((float(shot.image.mean()) - 13) / 6)


def test_pixel_centres_gain_a_half_and_poses_are_inverted(tmp_path):
    rig = load_calibration(write_rig(tmp_path))
    camera = rig["cam01"]
    assert (camera.intrinsics.cx, camera.intrinsics.cy) == (32.0, 24.0)
    np.testing.assert_allclose(camera.pose.matrix(), look_at([3, 1, 1], [0, 0, 0]), atol=1e-9)


def test_opencv_projects_to_the_same_pixels():
    """cv2.projectPoints with the file's own numbers, shifted by half a pixel, is our projection."""
    file = data_dir("pose2sim_single_person") / "calibration_opencv.json"
    raw = json.loads(file.read_text())
    points = np.random.default_rng(0).uniform([-2, -1, 0], [0, 1, 2], (50, 3))
    for name, camera in load_calibration(file).items():
        entry = raw[name]
        k, d = np.array(entry["K"]), np.array(entry["dist_k1k2p1p2"])
        r, t = np.array(entry["R_world_to_cam"]), np.array(entry["t_world_to_cam"])
        theirs, _ = cv2.projectPoints(points, cv2.Rodrigues(r)[0], t, k, d)
        local = points @ se3_inverse(camera.pose.matrix())[:3, :3].T + se3_inverse(camera.pose.matrix())[:3, 3]
        np.testing.assert_allclose(camera.intrinsics.project(local), theirs[:, 0] + 0.5, atol=0.01)
        np.testing.assert_allclose(camera.pose.translation_m, entry["camera_center_m"], atol=1e-3)


def test_any_order_gives_the_same_frames():
    clip = Clip(data_dir("pose2sim_single_person") / "videos/cam03.mp4")
    forwards = {k: clip.frame(k, 34, 60) for k in range(0, 100, 3)}
    for k in (99, 0, 42, 41 + 1, 6, 90, 3):
        np.testing.assert_array_equal(clip.frame(k, 34, 60), forwards[k])
    assert (clip.count, clip.fps, clip.width, clip.height) == (100, 60.0, 1088, 1920)


def test_the_source_plays_back_and_forth_at_its_own_pace(tmp_path):
    source = opened(video_scenario(write_rig(tmp_path), fps=10, scale=2))["cam01"]
    assert source.contents == FRAMES and source.fps == 10
    ticks = list(range(60))
    expected = [min(2 * k % 78, 78 - 2 * k % 78) for k in ticks]
    seen = [shade(source.read(source.content(k))) for k in ticks]
    assert seen == expected
    assert source.read(0).image.shape == (24, 32, 3) and source.intrinsics.cx == 16.0
    source.release()
    assert shade(source.read(31)) == 31


def test_a_trajectory_gives_the_poses(tmp_path):
    file = write_rig(tmp_path)
    lines = ["# t tx ty tz qx qy qz qw"] + [f"{100 + k / 10} {k} 0 0 0 0 0 1" for k in range(11)]
    (tmp_path / "cam01.txt").write_text("\n".join(lines))
    trajectory = {"files": {"cam01": "cam01.txt"}, "start_s": 100.0, "max_gap_ms": 51}
    sources = opened(video_scenario(file, trajectory=trajectory))
    assert sources["cam00"].read(9).pose_gap_ns == 0  # the calibration's
    shot = sources["cam01"].read(9)  # 0.45 s: between two samples
    assert shot.pose.translation_m == pytest.approx((4.5, 0, 0)) and shot.pose_gap_ns == 50_000_000
    with pytest.raises(ValueError, match="nearest pose"):
        sources["cam01"].read(30)  # 1.5 s: half a second after the last sample
    # The same as poses of a hand that holds the camera (4.7), whose clock is 50 ms ahead.
    mount = {"transform": [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "time_offset_s": 0.05}
    (tmp_path / "hand.yaml").write_text(json.dumps(mount))
    held = opened(video_scenario(file, trajectory={**trajectory, "hand_eye": "hand.yaml"}))["cam01"].read(9)
    assert held.pose.translation_m == pytest.approx((5.5, 0, 0)) and held.pose_gap_ns == 0
    with pytest.raises(ScenarioError, match=r"trajectory.hand_eye.*none.yaml"):
        opened(video_scenario(file, trajectory={**trajectory, "hand_eye": "none.yaml"}))
    with pytest.raises(ScenarioError, match=r"trajectory.files.cam01.*none.txt"):
        opened(video_scenario(file, trajectory={"files": {"cam01": "none.txt"}}))


def test_the_data_set_lists_every_frame_of_every_camera():
    dataset = load_dataset(data_dir("pose2sim_single_person"), ImageOptions(8))
    assert len(dataset) == 400 and dataset.cameras == ("cam01", "cam02", "cam03", "cam04")
    record = dataset.of("cam03")[59]
    assert record.time_s == pytest.approx(59 / 60)
    assert record.read().shape == (record.intrinsics.height, record.intrinsics.width, 3) == (240, 136, 3)


def test_videos_of_different_rates_are_refused_streamed_or_not(tmp_path):
    file = write_rig(tmp_path, faster=10.0)
    for opens in (load_dataset, lambda path: opened(video_scenario(path))):
        with pytest.raises(DatasetError, match=r"differ in frame rate: 20, 30; re-encode"):
            opens(file)


def test_what_does_not_fit_is_named(tmp_path):
    file = write_rig(tmp_path / "a")
    rig = json.loads(file.read_text())
    rig["cam01"]["width"] = 65
    file.write_text(json.dumps(rig))
    with pytest.raises(DatasetError, match="64 x 48, calibrated for 65 x 48"):
        opened(video_scenario(file))
    rig["cam01"].update(width=64, R_world_to_cam=np.diag([1.0, 1, -1]).tolist())
    file.write_text(json.dumps(rig))
    with pytest.raises(DatasetError, match=r"cam01\.R_world_to_cam"):
        opened(video_scenario(file))
    (tmp_path / "b/videos").mkdir(parents=True)
    with pytest.raises(DatasetError, match=r"expected one calib\*.json, found none"):
        opened(video_scenario(tmp_path / "b"))
    (tmp_path / "a/videos/cam00.mp4").write_bytes(b"no video at all")
    rig["cam01"].pop("R_world_to_cam")
    file.write_text(json.dumps(rig))
    with pytest.raises(DatasetError, match=r"cam00.mp4: OpenCV cannot open"):
        opened(video_scenario(file))


def test_a_camera_without_a_pose_is_missed_only_where_it_is_used(tmp_path):
    file = write_rig(tmp_path)
    rig = json.loads(file.read_text())
    rig["cam01"].pop("R_world_to_cam")
    file.write_text(json.dumps(rig))
    assert opened(video_scenario(file), ["cam00"])["cam00"].read(0).pose.translation_m == pytest.approx((3, 0, 1))
    with pytest.raises(ScenarioError, match=r"trajectory.files.cam01: missing, and the calibration has no pose"):
        opened(video_scenario(file))
    with pytest.raises(DatasetError, match="cam01: R_world_to_cam is missing"):
        load_dataset(file)
