"""The shipped segmentation model of the tile, on views it was not trained on: near, far away, and none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from camera_node.synthetic.scene import make_scene
from camera_node.synthetic.scenes.tile import object_parts
from edge_server.foreground import ForegroundConfig
from edge_server.foreground.foreground import Foreground, make_foreground
from edge_server.settings import read_config
from freshfield.geometry import Pinhole, on_sphere
from freshfield.scenario import load
from tests.edge_server.foreground.pictures import iou

for module in ("onnx", "onnxruntime"):
    pytest.importorskip(module, reason="needs ONNX Runtime: pip install -e '.[embed]'")

WIDE = 75.0


@pytest.fixture(scope="module")
def tile() -> Foreground:
    return make_foreground(ForegroundConfig("tile"))


def seen(distance_m: float, azimuth: float, elevation: float, fov_deg: float, bench: bool = True):
    """(image, true mask) of the tile from somewhere."""
    scene = make_scene("tile", {"count": 1, "bench": bench})
    lens, pose = Pinhole.from_fov(128, 128, fov_deg), on_sphere((0.0, 0.0, 0.03), distance_m, azimuth, elevation)
    plain = {"count": 1, "supersample": 1}
    alone, near = (make_scene("tile", {**plain, "bench": b}).view(lens, pose).distance() for b in (False, bench))
    return scene.view(lens, pose).image(0.0), np.isfinite(alone) & (alone <= near + 1e-9)


def mask_of(foreground: Foreground, image) -> np.ndarray:
    rgba = foreground.apply("hand", image)
    assert rgba.shape[2] == 4, foreground.counts
    return rgba[..., 3] == 255


@pytest.mark.parametrize("bench", [False, True], ids=["cell", "scan"])
def test_the_tile_is_cut_out_as_a_hand_sees_it(tile, bench):
    found = []
    for elevation in (30, 52, 75):
        for azimuth in (-165, -45, 75):
            image, truth = seen(0.34, azimuth, elevation, WIDE, bench)
            found.append(iou(mask_of(tile, image), truth))
    assert np.mean(found) > (0.85 if bench else 0.94) and min(found) > (0.75 if bench else 0.9), found


def test_a_picture_without_the_tile_is_used_whole():
    scene = make_scene("tile", {"count": 1, "bench": True})
    parts = scene.world.static_parts[len(object_parts()) :]
    empty = replace(scene, world=type(scene.world)(parts, (), scene.world.light, scene.world.background))
    foreground = make_foreground(read_config(load("scan")).foreground)
    for azimuth in (-30, 60, 150):
        image = empty.view(Pinhole.from_fov(128, 128, WIDE), on_sphere((0, 0, 0.03), 0.5, azimuth, 40)).image(0)
        assert foreground.apply("hand", image) is image, "nothing is lost"
    assert +foreground.counts == {"not_detected": 3}
