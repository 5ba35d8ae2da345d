"""Videos with a calibration: real files, exact frames, poses and pixel centers."""

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera_node.sources.datasets.records import DatasetError
from camera_node.sources.datasets.video import Clip, load_dataset
from camera_node.sources.rig_calibration import load_calibration
from freshfield.geometry import look_at, se3_inverse
from freshfield.scenario import ScenarioError, parse
from tests.camera_node.sources.datasets.photos import opened
from tests.support import refused

FRAMES = 40


def write_rig(folder: Path, cameras: int = 2) -> Path:
    """Videos whose frame k has the brightness 16 + 6 k, 20 frames a second, and their calibration JSON."""
    (folder / "videos").mkdir(parents=True)
    rig = {}
    for c in range(cameras):
        file = str(folder / f"videos/cam{c:02d}.mp4")
        writer = cv2.VideoWriter(file, cv2.VideoWriter.fourcc(*"mp4v"), 20.0, (64, 48))
        for k in range(FRAMES):
            writer.write(np.full((48, 64, 3), 16 + 6 * k, np.uint8))
        writer.release()
        world_to_camera = se3_inverse(look_at([3, c, 1], [0, 0, 0]))
        place = {"R_world_to_cam": world_to_camera[:3, :3].tolist(), "t_world_to_cam": world_to_camera[:3, 3].tolist()}
        lens = {"K": [[50, 0, 31.5], [0, 51, 23.5], [0, 0, 1]], "dist_k1k2p1p2": [0.01, 0, 0, 0]}
        rig[f"cam{c:02d}"] = {"width": 64, "height": 48, **lens, **place}
    file = folder / "calibration_opencv.json"
    file.write_text(json.dumps(rig))
    return file


def video_scenario(data: Path, cameras: int = 2, **source):
    section = {"kind": "video", "data": str(data), **source}
    return parse({"cameras": {"count": cameras, "held_out": ["cam00"]}, "source": section}, Path("v.yaml"))


def shade(shot) -> int:
    """The frame's number, off its brightness (the codec darkens by about three counts)."""
    return round((float(shot.image.mean()) - 13) / 6)


def test_the_source_plays_back_and_forth_at_its_own_pace(tmp_path):
    source = opened(video_scenario(write_rig(tmp_path), fps=10, scale=2))["cam01"]
    assert source.contents == FRAMES and source.fps == 10
    seen = [shade(source.read(source.content(k))) for k in range(60)]
    assert seen == [min(2 * k % 78, 78 - 2 * k % 78) for k in range(60)]
    assert source.read(0).image.shape == (24, 32, 3) and source.intrinsics.cx == 16.0
    np.testing.assert_allclose(source.read(0).pose.matrix(), look_at([3, 1, 1], [0, 0, 0]), atol=1e-9)
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
    for wrong, key in (({"hand_eye": "none.yaml"}, "hand_eye"), ({"files": {"cam01": "none.txt"}}, "files.cam01")):
        with pytest.raises(ScenarioError, match=rf"trajectory.{key}.*none"):
            opened(video_scenario(file, trajectory={**trajectory, **wrong}))


def test_a_carried_camera_s_video_needs_its_field_of_view_and_a_trajectory(tmp_path):
    write_rig(tmp_path, cameras=1)
    (tmp_path / "videos" / "poses.txt").write_text("\n".join(f"{k / 10} {k} 0 0 0 0 0 1" for k in range(21)))
    source = {"kind": "video", "data": str(tmp_path / "videos/cam00.mp4"), "scale": 2}
    cameras = {"ids": ["hand", "kept"], "held_out": ["kept"], "held_out_every": 8}
    fov, trajectory = {"horizontal_fov_deg": 90.0}, {"trajectory": {"files": {"hand": "poses.txt"}}}

    def found(**more):
        return opened(parse({"cameras": cameras, "source": {**source, **more}}, Path("v.yaml")))

    hand, kept = found(**fov, **trajectory).values()
    assert hand.intrinsics.fx == pytest.approx(16.0) and (hand.intrinsics.width, hand.intrinsics.height) == (32, 24)
    assert [shade(kept.read(kept.content(tick))) for tick in range(3)] == [0, 8, 16]
    assert hand.read(hand.content(0)).pose.translation_m == pytest.approx((0.5, 0, 0))
    refused(DatasetError, r"cam00.mp4: its lens is not known: give horizontal_fov_deg", found, **trajectory)
    refused(ScenarioError, r"trajectory.files.hand: missing", found, **fov)


def restamped(video: Path, runs: list[tuple[int, float]]) -> None:
    """Give an MP4 file other frame durations: runs of (frames, their durations in those of the file)."""
    data = bytearray(video.read_bytes().replace(b"edts", b"free"))  # an edit list would cut what gets longer
    at = data.index(b"stts") - 4
    size, *_, duration = struct.unpack(">IIIIII", data[at : at + 24])
    entries = b"".join(struct.pack(">II", count, round(factor * duration)) for count, factor in runs)
    box = struct.pack(">I4sII", 16 + len(entries), b"stts", 0, len(runs)) + entries
    video.write_bytes(with_box(data, at, size, box, (b"moov", b"trak", b"mdia", b"minf", b"stbl")))


def with_box(data: bytearray, at: int, size: int, box: bytes, parents: tuple[bytes, ...]) -> bytearray:
    """An MP4 file with ``box`` in place of the ``size`` bytes at ``at``."""
    data[at : at + size] = box
    for name in parents:
        head = data.rindex(name, 0, at) - 4
        grown = struct.unpack(">I", data[head : head + 4])[0] + len(box) - size
        data[head : head + 4] = struct.pack(">I", grown)
    return data


def test_frames_have_the_stamps_of_the_file_and_seeking_finds_them(tmp_path):
    file = write_rig(tmp_path)
    restamped(tmp_path / "videos/cam01.mp4", [(9, 1), (1, 40), (30, 1)])
    stamps_s = np.concatenate([np.arange(10), np.arange(49, 79)]) / 20
    records = load_dataset(file).of("cam01")
    assert [r.time_s for r in records] == pytest.approx(stamps_s)
    for k in (39, 20, 0, 12, 11, 35, 9, 10, 38):
        assert round((float(records[k].read().mean()) - 13) / 6) == k
    lines = [f"{k / 100} {k / 100} 0 0 0 0 0 1" for k in range(500)]
    (tmp_path / "cam01.txt").write_text("\n".join(lines))
    source = opened(video_scenario(file, trajectory={"files": {"cam01": "cam01.txt"}}), ["cam01"])["cam01"]
    assert [source.read(k).pose.translation_m[0] for k in range(FRAMES)] == pytest.approx(stamps_s)
    # The other camera ends after 1.95 s: until then this one shows what is nearest, and waits in its gap.
    assert [source.content(tick) for tick in range(40)] == [*range(10), *[9] * 20, *[10] * 10]


def test_a_dropped_frame_a_changed_rate_and_a_late_start_are_in_the_stamps(tmp_path):
    file = write_rig(tmp_path)
    cam00, cam01 = (tmp_path / f"videos/cam0{k}.mp4" for k in range(2))
    for video, by_ms in ((cam00, 100), (cam01, 350)):  # nothing is shown at first, by an empty edit
        data = bytearray(video.read_bytes())
        at, head = data.index(b"elst") - 4, data.index(b"mvhd") + 16
        size, _, _, _, duration, media_time, rate = struct.unpack(">IIIIIiI", data[at : at + 28])
        (scale,) = struct.unpack(">I", data[head : head + 4])
        edits = struct.pack(">IiIIiI", by_ms * scale // 1000, -1, rate, duration, media_time, rate)
        box = struct.pack(">I4sII", 16 + len(edits), b"elst", 0, 2) + edits
        video.write_bytes(with_box(data, at, size, box, (b"moov", b"trak", b"edts")))
    dataset = load_dataset(file)
    assert [dataset.of(c)[0].time_s for c in dataset.cameras] == pytest.approx([0.0, 0.25])
    sources = opened(video_scenario(file))
    assert [sources[c].content(0) for c in ("cam00", "cam01")] == [5, 0]
    restamped(cam01, [(20, 1), (1, 2), (19, 1)])
    assert Clip(cam01).times_s == pytest.approx([k / 20 for k in range(41) if k != 21])
    restamped(cam00, [(20, 1), (1, 40), (12, 1.25), (7, 1)])  # of 1/20 s; the last duration is no gap between two
    assert Clip(cam00).fps == pytest.approx(20 * 38 / (26 + 12 * 1.25), rel=1e-4), "their mean without gaps"


def test_frames_before_the_edit_list_of_a_cut_video_are_none(tmp_path):
    write_rig(tmp_path, cameras=1)
    video = tmp_path / "videos/cam00.mp4"
    data = bytearray(video.read_bytes())
    at, head = data.index(b"elst") + 16, data.index(b"mdhd") + 16
    (scale,), (media_time,) = (struct.unpack(">I", data[k : k + 4]) for k in (head, at))
    data[at : at + 4] = struct.pack(">I", media_time + 2 * scale // 20)  # as ffmpeg -ss -c copy writes it
    video.write_bytes(data)
    clip = Clip(video)
    assert clip.times_s == pytest.approx(np.arange(FRAMES - 2) / 20)
    assert [round((clip.frame(k, 64, 48).mean() - 13) / 6) for k in (9, 0, 7)] == [11, 2, 9]


def test_a_rotation_tag_is_followed_unless_the_calibration_is_of_the_stored_frames(tmp_path):
    file = write_rig(tmp_path)
    video = tmp_path / "videos/cam01.mp4"
    data = bytearray(video.read_bytes())
    at = data.index(b"tkhd") + 44
    data[at : at + 36] = struct.pack(">9i", 0, 65536, 0, -65536, 0, 0, 0, 0, 1 << 30)
    video.write_bytes(data)
    assert (Clip(video).width, Clip(video).height) == (48, 64)
    assert load_dataset(file).of("cam01")[3].read().shape == (48, 64, 3)
    rig = json.loads(file.read_text())
    rig["cam01"].update(width=48, height=64)
    file.write_text(json.dumps(rig))
    assert load_dataset(file).of("cam01")[3].read().shape == (64, 48, 3)


def test_a_key_of_a_rig_that_is_not_understood_is_refused_if_it_says_something(tmp_path):
    file = write_rig(tmp_path, 1)
    camera, expected = json.loads(file.read_text())["cam00"], load_calibration(file)
    for key, value in (("camera_model", "OPENCV_FISHEYE"), ("coeffs", [0, 0.1]), ("units", "mm"), ("image_width", 128)):
        for nothing in (None, 0, False, [0.0, 0], ""):
            file.write_text(json.dumps({"cam00": {**camera, key: nothing}}))
            assert load_calibration(file) == expected
        file.write_text(json.dumps({"cam00": {**camera, key: value}}))
        with pytest.raises(DatasetError, match=f"json: cam00: {key} is not understood and may change the camera: say"):
            load_calibration(file)
    harmless = {"error_px": 0.2, "std_fx_fy_cx_cy_k1_k2_p1_p2": [1] * 8, "name": "left", "date": "2026-11-27"}
    harmless |= {"units": "m", "image_size": [64, 48], "image_width": 64, "camera_model": "OPENCV"}
    file.write_text(json.dumps({"cam00": {**camera, **harmless}}))
    assert load_calibration(file) == expected
