"""What the edge exports, the node's own readers read back: every pixel, every point where it was."""

from __future__ import annotations

import numpy as np
import pytest

from camera_node.sources.datasets.formats import open_dataset
from edge_server.export import PosedImage
from edge_server.export.colmap import Cloud, write_model
from edge_server.export.images import write_images
from edge_server.export.transforms import write_transforms
from freshfield.geometry import Pinhole, se3_inverse
from tests.camera_node.sources.datasets import sets

BENT = Pinhole(64, 48, 60.0, 61.0, 31.2, 24.9, (-0.08, 0.02, 0.002, -0.003))
NEAR_PX = 0.01


def shots() -> list[PosedImage]:
    """One picture a camera, half of the lenses bent."""
    straight, bent = sets.rig(3), sets.rig(3, BENT)
    cameras = [straight[0], bent[1], straight[2], bent[0]]
    return [PosedImage(f"view{k}.png", c.shows(0), c.camera_to_world, c.lens) for k, c in enumerate(cameras)]


def pixels(camera_to_world: np.ndarray, lens: Pinhole, points: np.ndarray = sets.POINTS) -> np.ndarray:
    inverse = se3_inverse(camera_to_world)
    return lens.project(points @ inverse[:3, :3].T + inverse[:3, 3])


@pytest.mark.parametrize("form", ["colmap", "transforms"])
def test_exports_read_back_to_the_pixel(tmp_path, form):
    of = shots()
    write_images(tmp_path / "images", of)
    if form == "transforms":
        write_transforms(tmp_path, of)
    else:
        cloud = Cloud(sets.POINTS, np.zeros((200, 3), np.uint8), np.ones((200, len(of)), np.bool_))
        write_model(tmp_path / "sparse/0", of, cloud)
    _, dataset = open_dataset(tmp_path)
    assert len(dataset) == len(of)
    for shot, record in zip(of, dataset):
        assert record.intrinsics == shot.intrinsics
        there, back = (pixels(shot.camera_to_world, shot.intrinsics), pixels(record.camera_to_world, record.intrinsics))
        assert np.abs(there - back).max() < NEAR_PX
        np.testing.assert_array_equal(record.read(), shot.image)
