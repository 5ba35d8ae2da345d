"""transforms.json data sets: every corner of the format, and files as other tools and people leave them; videos with a
calibration: exact frames, poses and pixel centers."""

import json
import re
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera_node.doctor.depth_check import first_views
from camera_node.settings import source_config
from camera_node.sources.calibration_file import load_calibration
from camera_node.sources.datasets.lens import Lens, pinhole
from camera_node.sources.datasets.photo import ImageOptions, Photo
from camera_node.sources.datasets.records import DatasetError
from camera_node.sources.datasets.transforms import load_dataset
from camera_node.sources.datasets.transforms_keys import REFUSED
from camera_node.sources.datasets.video import Clip
from camera_node.sources.datasets.video import load_dataset as load_videos
from freshfield.geometry import Pinhole, look_at, se3_inverse
from freshfield.scenario import ScenarioError, parse
from tests.camera_node.sources.datasets import photos
from tests.camera_node.sources.datasets.photos import edited, fails, opened, photo_scenario, picture, write_photos
from tests.support import refused, turned_jpeg


def test_poses_become_opencv_and_images_rgb_at_the_scale_asked_for(tmp_path):
    dataset = load_dataset(write_photos(tmp_path, 3))
    assert len(dataset) == 3 and dataset.cameras == ("",) and not dataset.moving
    for index, record in enumerate(dataset):
        np.testing.assert_allclose(record.camera_to_world, photos.pose_of(index), atol=1e-12)
        np.testing.assert_array_equal(record.read(), picture(index)[..., ::-1])
        assert record.intrinsics == Pinhole(32, 24, 40.0, 41.0, 16.0, 12.0)
    record = load_dataset(tmp_path, ImageOptions(2))[0]
    assert record.intrinsics == Pinhole(16, 12, 20.0, 20.5, 8.0, 6.0)
    means = picture(0)[..., ::-1].reshape(12, 2, 16, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(record.read(), means, atol=0.51)
    fails("scale", load_dataset, tmp_path, ImageOptions(0.5))


def test_extensions_and_sizes_may_be_left_out(tmp_path):
    def without_extensions(data):
        for frame in data["frames"]:
            frame["file_path"] = "./" + frame["file_path"].removesuffix(".png")

    nothing = dict.fromkeys(("fl_x", "fl_y", "cx", "cy", "w", "h"))
    dataset = load_dataset(edited(write_photos(tmp_path, 2), without_extensions, **nothing, camera_angle_x=0.8))
    f = 16 / np.tan(0.4)
    assert dataset[1].intrinsics == Pinhole(32, 24, pytest.approx(f), pytest.approx(f), 16.0, 12.0)
    assert dataset[1].read().shape == (24, 32, 3)


def _camera_by_folder(data):
    for frame in data["frames"]:
        frame["file_path"] = f"{frame.pop('camera')}/{frame['file_path']}"


def test_time_and_camera_make_a_recording_and_null_is_as_good_as_absent(tmp_path):
    file = write_photos(tmp_path, 4, cameras=3)
    expected = load_dataset(file)
    assert expected.moving and expected.cameras == ("cam00", "cam01", "cam02")
    assert [r.time_s for r in expected.of("cam01")] == [0.0, 0.1, 0.2, 0.3]
    for name in expected.cameras:
        (tmp_path / name).mkdir()
        (tmp_path / name / "images").symlink_to("../images")
    of_folders = load_dataset(edited(file, _camera_by_folder))
    assert [r.camera for r in of_folders] == [r.camera for r in expected], "cam00/images is of cam00"
    file = write_photos(tmp_path, 4, cameras=3)
    nulls = dict.fromkeys(("k1", "is_fisheye", "camera_label", "camera_angle_x", "mask_path"))
    edited(file, lambda d: [d.update(nulls), *(f.update(nulls, fl_x=None, timestep=3) for f in d["frames"])])
    found = load_dataset(file)
    assert [(r.name, r.camera, r.time_s) for r in found] == [(r.name, r.camera, r.time_s) for r in expected]
    assert found[0].intrinsics == expected[0].intrinsics and found.notes == expected.notes
    still = load_dataset(edited(file, lambda d: [f.update(time=None, camera=None, timestep=None) for f in d["frames"]]))
    assert not still.moving and still.cameras == ("",)


def test_alpha_is_kept_laid_on_a_color_and_weighted_when_shrinking(tmp_path):
    file = write_photos(tmp_path, 1)
    rgba = np.zeros((24, 32, 4), np.uint8)
    rgba[:, :, :3] = (0, 255, 0)  # green, as BGR and as RGB, hidden where alpha is 0
    rgba[:, 1::2] = (200, 100, 50, 255)  # every second column is seen
    cv2.imwrite(str(tmp_path / "images/000.png"), rgba)
    kept = load_dataset(file, ImageOptions(2))[0].read()
    assert kept.shape == (12, 16, 4)
    assert np.unique(kept.reshape(-1, 4), axis=0).tolist() == [[50, 100, 200, 128]]  # no green
    white = load_dataset(file, ImageOptions(2, "white"))[0].read()
    np.testing.assert_allclose(white[0, 0], (np.array([50, 100, 200]) + 255) / 2, atol=0.51)
    black = load_dataset(file, ImageOptions(background="black"))[0].read()
    assert black[0, 0].tolist() == [0, 0, 0] and black[0, 1].tolist() == [50, 100, 200]
    cv2.imwrite(str(tmp_path / "images/000.png"), rgba[:, 1::2].repeat(2, axis=1))
    assert load_dataset(file)[0].read().shape == (24, 32, 3), "nothing shows through: it is a scene, not an object"


def test_an_image_of_another_size_or_damaged_is_refused_when_read(tmp_path):
    dataset = load_dataset(write_photos(tmp_path, 2))
    bomb = Photo(tmp_path / "bomb.png", Lens(60000, 60000, 1.0, 1.0, 1.0, 1.0), ImageOptions())
    bomb.path.write_bytes(photos.BOMB)
    fails(r"bomb\.png: .* larger than its limit", bomb.read)
    cv2.imwrite(str(tmp_path / "images/000.png"), np.zeros((24, 30, 3), np.uint8))
    fails("30 x 24", dataset[0].read)


@pytest.mark.parametrize("leads", ["../outside", "{outside}", "images/../../outside", "/etc/hostname", "", "a/" * 5000])
def test_images_outside_the_data_set_are_not_read(tmp_path, leads):
    outside = tmp_path / "outside.png"
    cv2.imwrite(str(outside), picture(0))
    path = leads.format(outside=outside.with_suffix(""))
    file = edited(write_photos(tmp_path / "set", 2), lambda d: d["frames"][0].update(file_path=path))
    fails(r"frames\[0\].*(does not lie within|is missing|is not the name)", load_dataset, file)


def load_edited(file, change=None, **top):
    """The data set of a transforms JSON after a change, see ``edited``."""
    return load_dataset(edited(file, change, **top))


BENDS = {"k1": 0.05, "k2": -0.01, "k3": 0.002, "k4": 0.0001}


def test_a_lens_has_pixels_and_a_focal_length(tmp_path):
    file = write_photos(tmp_path, 2)
    for width, height, fx, fy in ((0, 24, 40, 41), (32, 0, 40, 41), (32, 24, 0, 41), (32, 24, 40, -41)):
        fails("are impossible", load_edited, file, w=width, h=height, fl_x=fx, fl_y=fy)
        fails("no pixels|focal lengths are", Lens, width, height, fx, fy, 16.0, 12.0)
    assert load_edited(file, w=32, h=24, fl_x=40, fl_y=41)[0].intrinsics.fy == 41 and Lens(1, 1, 1.0, 1.0, 0.5, 0.5)


def lens_of(fx=40.0, fy=41.0, radial=(), tangential=(0.0, 0.0), fisheye=False):
    return Lens(32, 24, fx, fy, 16.0, 12.0, radial, tangential, fisheye)


def test_keys_of_the_camera_are_honored(tmp_path):
    for keys, lens in (
        ({"is_fisheye": True, "k1": 0.03, "k2": -0.005}, lens_of(radial=(0.03, -0.005), fisheye=True)),
        ({"camera_model": "OPENCV_FISHEYE", **BENDS}, lens_of(radial=tuple(BENDS.values()), fisheye=True)),
        ({"k3": 0.59, "p1": 0.01}, lens_of(radial=(0.0, 0.0, 0.59), tangential=(0.01, 0.0))),
        ({"distortion_params": [0.1, 0.2, 0, 0, 0.01, 0.02]}, lens_of(radial=(0.1, 0.2), tangential=(0.01, 0.02))),
        ({"fl_y": None, "camera_angle_y": 2 * np.arctan(12 / 44)}, lens_of(fy=44)),
        ({"fl_x": None, "x_fov": np.degrees(2 * np.arctan(16 / 30))}, lens_of(fx=30)),
        ({"fl_x": None, "fl_y": None, "camera_angle_y": 2 * np.arctan(12 / 30)}, lens_of(30, 30)),
        # What the tools write beside, and what is zero, changes nothing.
        ({"k5": 0, "rolling_shutter": [0, 0, 0, 0], "is_fisheye": False, "aabb_scale": 4}, lens_of()),
        # Numbers that belong to a larger original.
        ({"w": 64, "h": 48, "fl_x": 80, "fl_y": 82, "cx": 32, "cy": 24}, lens_of()),
    ):
        found, expected = load_edited(write_photos(tmp_path, 2), **keys)[0].intrinsics, pinhole(lens)
        assert (found.width, found.height) == (expected.width, expected.height)
        numbers = [(c.fx, c.fy, c.cx, c.cy, *c.distortion) for c in (found, expected)]
        assert numbers[0] == pytest.approx(numbers[1])
    first, second = load_edited(write_photos(tmp_path, 2), lambda d: d["frames"][1].update(fl_x=50.0, p2=-0.01))
    assert first.intrinsics.fx == 40.0 and not first.intrinsics.distorted, "a frame's own stand above the file's"
    assert second.intrinsics.fx == 50.0 and second.intrinsics.distortion == (0.0, 0.0, 0.0, -0.01)


def test_keys_that_change_the_meaning_are_refused_by_name(tmp_path):
    for keys, message in (
        *(({key: [0.1]}, rf"json: {key}: .*(undistort|convert|give|cut|correct|store)") for key in sorted(REFUSED)),
        ({"lens_shift_x": 0.1}, "lens_shift_x is not understood and may change the camera"),
        ({"is_fisheye": "false"}, "is_fisheye is 'false', expected true or false"),
        ({"camera_model": "OPENCV", "is_fisheye": True}, "is_fisheye and camera_model OPENCV contradict"),
        ({"is_fisheye": True, "p1": 0.1}, "p1 and p2 belong to no fisheye lens"),
        ({"train_filenames": ["images/009.png"]}, r"train_filenames: images/009\.png is no file_path"),
        ({"mask_path": "masks/none.png"}, r"mask_path: 'masks/none\.png' is missing"),
    ):
        fails(message, load_dataset, edited(write_photos(tmp_path, 2), **keys))


@pytest.mark.parametrize(
    ("times", "message"),
    [
        (np.arange(6) / 5, "6 different times and no camera, so that there is one view of each instant"),
        ([0.0, 3.0, 5.0], "3 different times and no camera, so that it is not known which"),
        ([float(k) for k in range(6)], ""),  # seconds of a walk through a room, not D-NeRF's 0 to 1
    ],
)
def test_times_without_cameras_are_refused_unless_they_tell_of_one_walk(tmp_path, times, message):
    file = write_photos(tmp_path, 6)
    edited(file, lambda d: [f.update(time=float(times[k % len(times)])) for k, f in enumerate(d["frames"])])
    if message:
        fails(message, load_dataset, file)
    else:
        still = load_dataset(file)
        assert not still.moving and "taken for a scene that stands still" in still.notes[0]
        fails("1 of 6 frames have no time", load_edited, file, lambda d: d["frames"][3].pop("time"))


def test_a_split_of_the_datas_own(tmp_path):
    names = [f"images/{k:03d}.png" for k in range(5)]
    split = {"train_filenames": ["./images/000.png", names[1]], "val_filenames": [names[2]]}
    found = load_edited(write_photos(tmp_path / "a", 5), **split, test_filenames=[names[3]])
    assert [r.name for r in found] == [names[0], names[1], names[3]] and found.held_out == {names[3]}
    assert load_edited(write_photos(tmp_path / "b", 5), val_filenames=[names[2]]).held_out == {names[2]}
    file = write_photos(tmp_path / "c", 5)
    data = json.loads(file.read_text())
    for part, frames in (("train", data["frames"][:3]), ("test", data["frames"][3:])):
        (file.parent / f"transforms_{part}.json").write_text(json.dumps({**data, "frames": frames}))
    file.unlink()
    found = load_dataset(file.parent)
    assert len(found) == 5 and found.held_out == set(names[3:])
    kept = opened(photo_scenario(file.parent))["cam00"]
    truth = {kept.read(k).image.tobytes() for k in range(kept.contents)}
    assert truth == {r.read().tobytes() for r in found if r.name in found.held_out}
    file = edited(write_photos(tmp_path / "d", 5, cameras=2), test_filenames=[names[3]])
    seen = opened(photo_scenario(file, 2, assignment={"cam00": "cam01", "cam01": "cam00"}))["cam01"]
    assert [(seen.read(k).image == picture(n)[..., ::-1]).all() for k, n in enumerate((0, 1, 2, 4))] == [True] * 4


def test_orientation_and_size_are_what_the_camera_says(tmp_path):
    file = write_photos(tmp_path, 2, suffix=".jpg")
    image = tmp_path / "images/000.jpg"
    as_stored = load_dataset(file)[0].read()
    data = image.read_bytes()
    for orientation in (3, 6, 8):
        image.write_bytes(turned_jpeg(data, orientation))
        np.testing.assert_array_equal(load_dataset(file)[0].read(), as_stored)  # its size is the camera's
    turned = load_edited(file, lambda d: d["frames"].pop(), w=24, h=32, cx=12, cy=16)
    np.testing.assert_array_equal(turned[0].read(), np.rot90(as_stored))
    assert turned[0].path is None, "the stored file is not what the camera saw"
    image.write_bytes(data)
    fails("24 x 32 pixels, 000.jpg 32 x 24: another shape", load_dataset, file)
    file = write_photos(tmp_path, 2, suffix=".jpg", w=None, h=None)
    cv2.imwrite(str(tmp_path / "images/001.jpg"), np.zeros((40, 32, 3), np.uint8))
    fails("image of 32 x 40, others have 32 x 24: give w and h", load_dataset, file)


def test_masks_are_weights_and_cannot_be_streamed(tmp_path):
    mask = np.repeat(np.uint8([255, 0]), (16, 8))[:, None].repeat(32, axis=1)
    file = write_photos(tmp_path, 2)
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    found = load_edited(file, lambda d: d["frames"][0].update(mask_path="mask.png"))
    np.testing.assert_array_equal(found[0].weight(), mask / np.float32(255))
    assert found[1].weight is None and found[0].read().shape == (24, 32, 3)
    fails("masks .* a stream cannot carry", opened, photo_scenario(tmp_path))
    write_photos(tmp_path / "ngp", 1)
    cv2.imwrite(str(tmp_path / "ngp/images/dynamic_mask_000.png"), mask)
    np.testing.assert_array_equal(load_dataset(tmp_path / "ngp")[0].weight(), 1 - mask / np.float32(255))


@pytest.mark.stability
@pytest.mark.parametrize(
    ("suffix", "damage"),
    [*((s, "cut") for s in (".jpg", ".png", ".webp", ".bmp", ".tiff", ".ppm")), (".png", "empty"), (".jpg", "text")],
)
def test_a_damaged_picture_is_refused_by_name(tmp_path, suffix, damage):
    file = write_photos(tmp_path, 2, suffix=suffix)
    image = tmp_path / f"images/001{suffix}"
    whole = image.read_bytes()
    image.write_bytes({"cut": whole[: len(whole) * 2 // 3], "empty": b"", "text": b"version https://git-lfs"}[damage])
    fails(rf"001{re.escape(suffix)}: .*damaged or cut short", lambda: [r.read() for r in load_dataset(file)])


def test_backslashes_are_slashes_and_links_within_the_folder_are_files(tmp_path):
    file = write_photos(tmp_path, 2)
    (tmp_path / "images/001.png").unlink()
    (tmp_path / "images/001.png").symlink_to("000.png")
    found = load_edited(file, lambda d: d["frames"][1].update(file_path="images\\001.png"))
    assert [r.name for r in found] == ["images/000.png", "images/001.png"]
    for name in ("..\\x.png", "C:\\x.png", "C:/x.png"):
        fails("does not lie within the folder", load_edited, file, lambda d, n=name: d["frames"][1].update(file_path=n))


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
    clip = Clip(tmp_path / "videos/cam01.mp4")
    for index, decoded in ((20, [20]), (19, [*range(8, 20)]), (9, [*range(8, 20)]), (7, [*range(8)]), (30, [30])):
        clip.frame(index, 32, 24)
        assert [*clip._block] == decoded, "backwards, twelve at once"


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
    (tmp_path / "none-carried.yaml").write_text(json.dumps({"setup": "eye-to-hand", **mount}))
    for wrong, key in (
        ({"hand_eye": "none.yaml"}, "hand_eye"),
        ({"hand_eye": "none-carried.yaml"}, "hand_eye: .* its camera stands still,"),
        ({"files": {"cam01": "none.txt"}}, "files.cam01"),
    ):
        with pytest.raises(ScenarioError, match=rf"trajectory.{key}.*no(ne|thing)"):
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
    (tmp_path / "videos" / "late.txt").write_text("1 0 0 0 0 0 0 1\n1.5 1 0 0 0 0 0 1")
    late = {"kind": "video", **source, **fov, "trajectory": {"files": {"hand": "late.txt"}}}
    begins_late = parse({"cameras": {"ids": ["hand"]}, "source": late}, Path("v.yaml"))
    assert first_views(begins_late, source_config(begins_late), None) == [], "it has no depth, and nothing is wrong"
    utc = {"files": {"hand": "late.txt"}, "start_s": -1.7e9}
    refused(ScenarioError, "files.hand: no frame is within max_gap_ms of a pose: give", found, **fov, trajectory=utc)


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
    records = load_videos(file).of("cam01")
    assert [r.time_s for r in records] == pytest.approx(stamps_s)
    for k in (39, 20, 0, 12, 11, 35, 9, 10, 38):
        assert round((float(records[k].read().mean()) - 13) / 6) == k
    (tmp_path / "cam01.txt").write_text("\n".join(f"{k / 100} {k / 100} 0 0 0 0 0 1" for k in range(500)))
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
    dataset = load_videos(file)
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


def test_a_container_that_does_not_stamp_each_frame_loses_none(tmp_path):
    video = cv2.VideoWriter(str(tmp_path / "a.mpg"), cv2.VideoWriter.fourcc(*"MPG1"), 25.0, (64, 48))
    for k in range(120):
        video.write(np.full((48, 64, 3), 16 + 6 * (k % FRAMES), np.uint8))
    video.release()
    clip = Clip(tmp_path / "a.mpg")
    assert clip.count == 120
    assert [round((clip.frame(k, 64, 48).mean() - 13) / 6) % FRAMES for k in (119, 0, 99, 57)] == [39, 0, 19, 17]


def test_a_rotation_tag_is_followed_unless_the_calibration_is_of_the_stored_frames(tmp_path):
    file = write_rig(tmp_path)
    video = tmp_path / "videos/cam01.mp4"
    data = bytearray(video.read_bytes())
    at = data.index(b"tkhd") + 44
    data[at : at + 36] = struct.pack(">9i", 0, 65536, 0, -65536, 0, 0, 0, 0, 1 << 30)
    video.write_bytes(data)
    assert (Clip(video).width, Clip(video).height) == (48, 64)
    assert load_videos(file).of("cam01")[3].read().shape == (48, 64, 3)
    rig = json.loads(file.read_text())
    rig["cam01"].update(width=48, height=64)
    file.write_text(json.dumps(rig))
    assert load_videos(file).of("cam01")[3].read().shape == (64, 48, 3)


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
