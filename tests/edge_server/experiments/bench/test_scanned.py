"""``edge-server bench scanned``: from images of the bench to meshes of the tile."""

from __future__ import annotations

import json

import numpy as np
import pytest

from camera_node.config import source_config
from camera_node.synthetic.camera_rig import on_sphere
from camera_node.synthetic.scene import make_scene, pinhole
from edge_server.cli import main as edge_server
from edge_server.experiments.bench import scanned
from edge_server.experiments.scenes.tile_scan import Scan, exact_depth, surface_truth
from edge_server.fields import View
from edge_server.surface.depth import depth_map
from edge_server.surface.settings import MeshSettings
from freshfield.scenario import load


def test_a_mesh_of_whole_images_is_cut_to_a_box_that_ends_above_the_bench():
    """Depth maps that are exact: the box leaves the tile, and without it the bench is most of the mesh."""
    pytest.importorskip("skimage", reason="scikit-image is not installed (extra surface)")
    made = source_config(load("scan"))
    scene = make_scene(made.scene, {**made.scene_parameters(), "count": 1, "width": 48, "height": 48})
    lens = pinhole(scene.params)
    poses = [on_sphere(made.arm.path.target_m, made.arm.path.radius_m, a, 60.0) for a in (0.0, 120.0, 240.0)]
    views = tuple(View(f"v{k}", scene.view(lens, p).image(0.0), p, lens) for k, p in enumerate(poses))
    maps = [depth_map(exact_depth(scene, v).astype(np.float32), v.image, v.camera_to_world, lens) for v in views]
    truth = surface_truth(Scan(scene, views), scanned.SPACING_M)
    whole, cut = (
        scanned._compared(maps, MeshSettings(voxel_m=0.004, bounds=bounds), truth)
        for bounds in (None, scanned._box(scene))
    )
    assert cut["precise"] > 0.8 > 2 * whole["precise"] and cut["chamfer_mm"] < 0.5 * whole["chamfer_mm"]


@pytest.mark.slow
def test_masks_leave_the_tile_alone(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(scanned, "WAYS", ("detector", "true masks"))
    for module in ("skimage", "onnxruntime", "onnx"):
        pytest.importorskip(module, reason=f"{module} is not installed (extras surface, embed)")
    assert edge_server(["bench", "scanned", "--quick", "--out", str(tmp_path)]) == 0
    rows = json.loads((tmp_path / "scanned.json").read_text())["scanned"]["rows"]
    ours, true = rows["detector"], rows["true masks"]
    assert ours["iou"] > 0.85 and ours["whole"] == 0  # measured: .88
    assert ours["precise"] > 0.6  # measured: .75; of a mesh of whole images, most is bench and wall: .18
    assert ours["chamfer_mm"] < 1.5 * true["chamfer_mm"]
    assert "| true masks | 1.00 |" in capsys.readouterr().out
