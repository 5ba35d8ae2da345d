"""Depth files of each kind become the same counts and meters; what cannot be depth is refused in one line."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from camera_node.capture import build_cameras
from camera_node.settings import source_config
from camera_node.sources.datasets import transforms
from camera_node.sources.datasets.lens import Lens
from camera_node.sources.datasets.photo import ImageOptions, Photo
from camera_node.sources.datasets.rgbd.depth_file import DepthFile
from tests.camera_node.sources.datasets.photos import edited, fails, photo_scenario, write_photos

os.environ["OPENCV_IO_ENABLE_OPENEXR"] = "1"
import cv2

MM = np.random.default_rng(0).integers(300, 6000, (24, 32)).astype(np.uint16)
MM[3:5, 7:9] = 0
LENS = Lens(32, 24, 40.0, 41.0, 16.0, 12.0)


def photo(lens: Lens = LENS, scale: float = 1.0) -> Photo:
    return Photo(Path("image.png"), lens, ImageOptions(scale))


def written(path: Path, values: np.ndarray) -> Path:
    if path.suffix == ".npy":
        np.save(path, values)
    else:
        assert cv2.imwrite(str(path), values)
    return path


@pytest.mark.parametrize("name", ["mm.png", "mm.tiff", "mm.npy", "m.npy", "m.exr"])
def test_every_kind_of_file_gives_the_same_millimeters(tmp_path, name):
    values = MM.copy() if name.startswith("mm") else (MM / 1000.0).astype(np.float32)
    found = DepthFile(written(tmp_path / name, values)).read(photo())
    assert np.array_equal(found.counts, MM) and found.meters_per_count == 0.001
    assert found.intrinsics is None and found.to_camera is None
    if name.startswith("mm"):  # the unit, and what stands for nothing, may be the format's
        values[0] = 65535
        found = DepthFile(written(tmp_path / name, values), 1 / 5000, 65535).read(photo())
        assert np.array_equal(found.counts[1:], MM[1:]) and not found.counts[0].any()
        assert found.meters()[10, 10] == pytest.approx(MM[10, 10] / 5000)


def test_depth_is_straightened_with_its_image_and_is_no_larger(tmp_path):
    file = DepthFile(written(tmp_path / "d.png", np.kron(MM, np.ones((2, 2), np.uint16))))
    assert file.read(photo(scale=1.0)).counts.shape == (24, 32)
    assert file.read(photo(scale=4.0)).counts.shape == (6, 8)
    assert set(file.read(photo(scale=4.0)).counts.ravel()) <= set(MM.ravel()), "no means across edges"
    fisheye = Lens(32, 24, 40.0, 41.0, 16.0, 12.0, (0.05, 0.0, 0.0, 0.0), fisheye=True)
    bent = file.read(photo(fisheye)).counts
    assert bent.shape == (24, 32) and set(bent.ravel()) <= set(MM.ravel()) and not np.array_equal(bent, MM)


BAD_FILES = {
    "missing": ("d.png", None, "missing, damaged"),
    "npy cut": ("d.npy", b"\x93NUMPY", "cannot be read as numbers"),
    "8 bits": ("d.png", (MM // 256).astype(np.uint8), "expected one number a pixel, of 16 bits"),
    "another shape": ("d.png", MM[:, :20], "depth is 20 x 24, its image 32 x 24"),
    "meters in a PNG": ("d.png", np.maximum(MM // 1000, 1), "the median of its depth is 0.00"),
    "millimeters as floats": ("d.npy", (MM / 10.0).astype(np.float32), "the median of its depth is 3.. m"),
    "signed": ("d.npy", MM.astype(np.int32), "expected one number a pixel"),
    "wide": ("d.npy", MM.astype(np.uint32) * 1000, "exceed 16 bits"),
}


@pytest.mark.stability
@pytest.mark.parametrize(("name", "content", "message"), BAD_FILES.values(), ids=BAD_FILES)
def test_what_cannot_be_depth_is_refused_by_name(tmp_path, name, content, message):
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        written(path, content)
    fails(f"{path}: .*{message}", DepthFile(path).read, photo())


@pytest.mark.stability
@pytest.mark.filterwarnings("error")
def test_what_is_no_number_or_too_far_is_not_measured(tmp_path):
    values = (MM / 1000.0).astype(np.float32)
    values[1, :6] = np.nan, np.inf, -np.inf, -1.0, 1e30, 65.6
    found = DepthFile(written(tmp_path / "d.npy", values)).read(photo())
    assert not found.counts[1, :6].any() and np.array_equal(found.counts[2:], MM[2:])
    for empty in (np.zeros((24, 32), np.float32), np.full((24, 32), np.nan, np.float32)):
        assert not DepthFile(written(tmp_path / "e.npy", empty)).read(photo()).counts.any()


def with_depth(folder: Path, **keys) -> Path:
    """Photos of which every frame but the second has depth; that of the third is missing."""

    def add(data) -> None:
        for index, frame in enumerate(data["frames"]):
            if index != 1:
                frame["depth_file_path"] = f"depth/{index:03d}.png"
            if index != 2:
                written(folder / f"depth/{index:03d}.png", np.where(MM > 0, MM + index, 0).astype(np.uint16))

    (folder / "depth").mkdir()
    return edited(write_photos(folder, 16), add, **keys)


def test_transforms_bring_depth_with_the_frames_that_have_it(tmp_path):
    file = with_depth(tmp_path, depth_unit_scale_factor=0.0005)
    found = transforms.load_dataset(file)
    assert [image.depth is not None for image in found][:4] == [True, False, False, True]
    assert "1 of its depth files are missing, first" in found.notes[-1]
    measured = found[3].depth()
    assert measured.meters_per_count == 0.0005 and measured.counts[10, 10] == MM[10, 10] + 3
    scenario = photo_scenario(file, cameras=2)
    (camera,) = build_cameras(scenario, source_config(scenario), ["cam01"])
    source = camera.source
    shown = [source.depth(content, source.read(content)) for content in range(source.contents)]
    assert [depth is not None for depth in shown][:3] == [False, False, True], "images 1, 2, 3"
    assert np.array_equal(shown[2].counts, measured.counts)
    for unit in (-1, "mm", 1e9, True):
        fails("depth_unit_scale_factor", transforms.load_dataset, edited(file, depth_unit_scale_factor=unit))
