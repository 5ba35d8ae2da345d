"""transforms.json data sets: written ones for every corner, real ones for conventions."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from camera_node.sources.datasets.lens import Lens
from camera_node.sources.datasets.photo import ImageOptions, Photo
from camera_node.sources.datasets.transforms import load_dataset
from freshfield.geometry import Pinhole
from tests.camera_node.sources.datasets.photos import BOMB, edited, fails, opencv_pose, picture, write_photos


def test_poses_become_opencv_and_images_rgb_at_the_scale_asked_for(tmp_path):
    dataset = load_dataset(write_photos(tmp_path, 3))
    assert len(dataset) == 3 and dataset.cameras == ("",) and not dataset.moving
    for index, record in enumerate(dataset):
        np.testing.assert_allclose(record.camera_to_world, opencv_pose(index), atol=1e-12)
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


def test_intrinsics_of_a_frame_stand_above_those_of_the_file(tmp_path):
    file = edited(write_photos(tmp_path, 2), lambda d: d["frames"][1].update(fl_x=50.0, k1=0.1, p2=-0.01))
    first, second = load_dataset(file)
    assert first.intrinsics.fx == 40.0 and not first.intrinsics.distorted
    assert second.intrinsics.fx == 50.0 and second.intrinsics.distortion == (0.1, 0.0, 0.0, -0.01)


def test_time_and_camera_make_a_recording_and_null_is_as_good_as_absent(tmp_path):
    file = write_photos(tmp_path, 4, cameras=3)
    expected = load_dataset(file)
    assert expected.moving and expected.cameras == ("cam00", "cam01", "cam02")
    assert [r.time_s for r in expected.of("cam01")] == [0.0, 0.1, 0.2, 0.3]
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


def test_an_image_of_another_size_or_damaged_is_refused_when_read(tmp_path):
    dataset = load_dataset(write_photos(tmp_path, 2))
    bomb = Photo(tmp_path / "bomb.png", Lens(60000, 60000, 1.0, 1.0, 1.0, 1.0), ImageOptions())
    bomb.path.write_bytes(BOMB)
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
