"""``edge-server export`` and ``render`` on what real fields leave behind, and what they say where they cannot."""

import json
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from edge_server.cli import main as edge_server
from edge_server.experiments.scenes.multiview_still import synthetic_still
from edge_server.export import ExportError
from edge_server.export.camera_paths import lens, orbit, read_nerfstudio, vertical_fov_deg
from edge_server.export.colmap import Cloud
from edge_server.export.run_source import open_source
from edge_server.export.viewed_field import ViewedField
from edge_server.fields import Budget, Field, View, checkpoint
from edge_server.fields.registry import make_field
from freshfield.geometry import Pinhole, look_at
from freshfield_up.cli import main as freshfield
from tests.support import refusal, refused

SMALL = {"gaussians": 512, "start": 256, "seed_cells": 16}


def tile() -> list[View]:
    """What it learned from."""
    return synthetic_still("tile", cameras=9, size=32).training


def saved(
    folder: Path, name: str = "splat", options: dict[str, Any] = SMALL, steps: int = 60, views: list[View] | None = None
) -> Field:
    """Write the checkpoint into ``folder``; returns the field."""
    field = make_field(name, options, seed=3)
    field.fit(views or tile(), Budget(steps=steps))
    checkpoint.save(folder / "field.npz", field.state(), {"field": name, "options": {}, "seed": 3})
    return field


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    saved(folder)
    return folder


def test_everything_at_once(run, tmp_path, capsys):
    pytest.importorskip("skimage", reason="scikit-image is not installed (extra surface)")
    written = {"mesh": "m.ply", "splats": "s.ply", "points": "p.ply", "colmap": "colmap", "transforms": "nerf"}
    words = [word for option, name in written.items() for word in (f"--{option}", tmp_path / name)]
    status = edge_server(list(map(str, ["export", run, *words, "--voxel", 10, "--count", 500])))
    said = capsys.readouterr().out
    assert status == 0, said
    for name in ("m.ply", "s.ply", "p.ply", "colmap/sparse/0/images.txt", "nerf/transforms.json"):
        assert (tmp_path / name).stat().st_size > 100, name
    assert len(list((tmp_path / "colmap" / "images").glob("*.png"))) == 8
    assert "8 cameras" in said and "triangles" in said


def test_coordinates_too_large_for_the_positions_of_a_file_are_said(tmp_path, capsys):
    for place_m in (0.0, 5_000_000.0):
        at = np.array([0.0, place_m, 0.0])
        moved = [replace(view, camera_to_world=look_at(view.camera_to_world[:3, 3] + at, at)) for view in tile()]
        saved(tmp_path, steps=1, views=moved)
        assert edge_server(["export", str(tmp_path), "--splats", str(tmp_path / "s.ply")]) == 0
        assert ("are 0.5 m apart" in capsys.readouterr().out) == (place_m > 0)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("export --mesh m.obj", "--mesh m.obj: expected a file that ends in .ply or .glb"),
        ("export --mesh m.ply --voxel 0", "--voxel 0: expected more than 0 mm"),
        ("export --points p.ply --count 0", "--count 0"),
        ("export --mesh m.ply --voxel 10 --bounds 1 1 1 0 0 0", "lower corner"),
        ("render --orbit view.mp4 --size 33x20", "videos need even sizes, not 33 x 20"),
        ("render --orbit view.mp4 --fov nan", "--fov nan"),
        ("render --camera cam99 view.png", "--camera cam99: the run has cam01"),
        ("render --pose 0 0 1 0 0 1 view.png", "--pose: "),
    ],
)
def test_what_cannot_be_is_said_in_a_line(run, tmp_path, capsys, monkeypatch, words, said):
    monkeypatch.chdir(tmp_path)
    command, *others = words.split()
    assert said in refusal(capsys, edge_server, command, run, *others)
    assert not list(tmp_path.iterdir())


def test_what_is_missing_is_said(tmp_path, capsys, monkeypatch):
    def why(folder: str, option: str, file: str) -> str:
        return refusal(capsys, edge_server, "export", tmp_path / folder, option, tmp_path / file)

    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "skimage.measure", None)  # as where it is not installed
        assert "pip install 'freshfield[surface]'" in why("nowhere", "--mesh", "m.ply")
    assert "no such file or folder" in why("nowhere", "--points", "p.ply")
    assert refusal(capsys, freshfield, "render", "none", "--orbit", "v.mp4").startswith("freshfield render: none")
    assert "holds no checkpoint" in why("", "--points", "p.ply")
    (tmp_path / "field.npz").write_bytes(b"half of it")
    assert "damaged or not a checkpoint" in why("", "--points", "p.ply")
    saved(tmp_path, "ngp", {"rays": 512, "batch_samples": 4096, "samples": 48}, steps=2)
    assert "ngp has no Gaussians" in why("", "--splats", "s.ply")


def test_a_checkpoint_that_would_unpack_to_gigabytes_is_not_unpacked(tmp_path):
    """Ours are written without compression: none is larger than its file."""
    file = tmp_path / "field.npz"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", bytes(2**24))
    refused(ExportError, r"field\.npz: unpacked it has 16777216 bytes, which no field's", open_source, file)


def views(azimuths_deg: list[float], outward: bool = False) -> list[View]:
    """Cameras on a circle of 2 m about (1, 2, .5), 1 m above it, that look at it or away from it."""
    found = []
    for number, azimuth in enumerate(np.radians(azimuths_deg)):
        arm = np.array([2 * np.cos(azimuth), 2 * np.sin(azimuth), 1.0])
        target = np.array([1.0, 2.0, 0.5])
        pose = look_at(target + 0.1 * arm, target + arm) if outward else look_at(target + arm, target)
        found.append(View(f"cam{number}", np.zeros((48, 64, 3), np.uint8), pose, Pinhole.from_fov(64, 48, 60.0)))
    return found


def azimuths(steps) -> np.ndarray:
    arms = np.array([step.camera_to_world[:2, 3] - [1.0, 2.0] for step in steps])
    return np.degrees(np.arctan2(arms[:, 1], arms[:, 0]))


def test_an_orbit_goes_round_or_stays_within_an_arc_as_cameras_stand_and_looks_at_what_they_do():
    steps = orbit(views([0, 60, 120, 180, 240, 300]), 36, 50.0)
    turned = np.unwrap(np.radians(azimuths(steps)))
    assert np.allclose(np.diff(turned), 2 * np.pi / 36)
    for step in steps:
        eye, ahead = step.camera_to_world[:3, 3], step.camera_to_world[:3, 2]
        arm = np.array([1.0, 2.0, 0.5]) - eye
        np.testing.assert_allclose(ahead, arm / np.linalg.norm(arm), atol=1e-6)
        assert eye[2] == pytest.approx(1.5) and np.hypot(*arm[:2]) == pytest.approx(2.0)
    steps = orbit(views([-40, 0, 35]), 48, 50.0)
    assert azimuths(steps).min() >= -40 - 1e-6 and azimuths(steps).max() <= 35 + 1e-6
    assert np.ptp(azimuths(steps)) == pytest.approx(75.0)
    np.testing.assert_allclose(steps[1].camera_to_world, steps[-1].camera_to_world)  # to and fro: it closes


@pytest.mark.stability
@pytest.mark.parametrize("which", ["outward", "one", "parallel", "turning"])
def test_cameras_that_have_nothing_in_common_still_give_a_path(which):
    chosen = views([0.0, 90.0, 180.0, 270.0], outward=True) if which == "outward" else views([20.0])
    if which == "parallel":
        poses = [chosen[0].camera_to_world + np.eye(4, k=3) * k for k in range(3)]
        chosen = [replace(chosen[0], camera_to_world=pose) for pose in poses]
    if which == "turning":  # on the spot
        eye, ways = np.array([1.0, 2.0, 1.5]), np.radians([0.0, 30.0, 60.0])
        poses = [look_at(eye, np.add(eye, (np.sin(way), -np.cos(way), 0.1))) for way in ways]
        chosen = [replace(chosen[0], camera_to_world=pose) for pose in poses]
    for step in orbit(chosen, 8, 50.0):
        assert np.isfinite(step.camera_to_world).all()
        np.testing.assert_allclose(step.camera_to_world[:3, :3] @ step.camera_to_world[:3, :3].T, np.eye(3), atol=1e-9)


def render(*words) -> int:
    return edge_server(["render", *map(str, words)])


def test_an_orbit_is_a_video_and_two_runs_stand_side_by_side(run, tmp_path, capsys):
    file = tmp_path / "orbit.mp4"
    assert render(run, "--beside", run, "--orbit", file, "--seconds", 0.4, "--fps", 10, "--size", "64x48") == 0
    assert "4 images of 128 x 48" in capsys.readouterr().out
    video, frames = cv2.VideoCapture(str(file)), []
    while (taken := video.read())[0]:
        frames.append(taken[1])
    both = np.array(frames, int)
    assert both.shape == (4, 48, 128, 3) and np.abs(both[0] - both[2]).mean() > 1
    assert np.abs(both[:, :, :64] - both[:, :, 64:]).mean() < 4  # it is compressed


def nerfstudio(**other) -> dict:
    """A path of two poses that look along -z and y, as nerfstudio writes it: OpenGL axes, row by row."""
    along_y = [1.0, 0, 0, 0, 0, 0, -1, -0.5, 0, 1, 0, 0, 0, 0, 0, 1]
    step = {"camera_to_world": along_y, "fov": 40.0, "aspect": 1.0}
    size = {"camera_type": "perspective", "render_height": 48, "render_width": 64}
    return {**size, "fps": 12, "seconds": 1.0, "camera_path": [step, step], **other}


def test_a_path_of_nerfstudio_keeps_its_size_and_poses(run, tmp_path, capsys):
    (path := tmp_path / "camera_path.json").write_text(json.dumps(nerfstudio()))
    assert render(run, "--path", path, tmp_path / "flight.mp4") == 0
    assert "2 images of 64 x 48" in capsys.readouterr().out
    timeless = {key: value for key, value in nerfstudio().items() if key not in ("fps", "seconds")}
    for known, fps in ((nerfstudio(seconds=0), 12), (timeless, 2.0)):  # two poses take a second
        path.write_text(json.dumps(known))
        assert read_nerfstudio(path)[1] == fps
    assert vertical_fov_deg(lens(64, 48, 40.0)) == pytest.approx(40.0)
    # The same viewpoint, said by eye and target.
    assert render(run, "--path", path, tmp_path / "a.png") == 0
    assert render(run, "--pose", 0, -0.5, 0, 0, 0, 0, tmp_path / "b.png", "--fov", 40, "--size", "64x48") == 0
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "a.png")), cv2.imread(str(tmp_path / "b.png")))
    assert render(run, "--path", path, tmp_path / "depth.png", "--depth") == 0
    depth = cv2.imread(str(tmp_path / "depth.png"))
    assert depth.shape == (48, 64, 3) and np.ptp(depth.reshape(-1, 3), axis=0).max() > 100


def test_a_path_that_cannot_be_flown_is_refused_by_key(tmp_path):
    path, step = tmp_path / "camera_path.json", nerfstudio()["camera_path"][0]
    steps = [{"camera_path": [{**step, **bad}]} for bad in ({"fov": 200}, {"camera_to_world": [float("nan")] * 16})]
    for change in ({"camera_type": "fisheye"}, {"fps": 0}, *steps):
        path.write_text(json.dumps(nerfstudio(**change)))
        refused(ExportError, next(iter(change)), read_nerfstudio, path)


def test_depth_is_seen_from_where_the_field_has_found_its_cameras(tmp_path, monkeypatch):
    """Only there do photographs fit to it, and to each other."""
    found, given = look_at((1.0, 2.0, 3.0), (0.0, 0.0, 0.0)), []
    monkeypatch.setattr(ViewedField, "pose", lambda *_: found)
    monkeypatch.setattr("edge_server.surface.reconstruct.make_depth_maps", lambda _, views, *rest: given.extend(views))
    monkeypatch.setattr("edge_server.export.point_cloud.sparse_points", lambda *_: Cloud(*np.zeros((3, 1, 3))))
    ViewedField("splat", make_field("splat", SMALL), tuple(tile())).export(tmp_path / "points.ply", "points")
    assert len(given) == 8 and all(np.array_equal(view.camera_to_world, found) for view in given)


def test_a_camera_is_rendered_with_its_own_lens(tmp_path):
    """Its focal lengths differ, and its axis is off the middle: the picture fits the photograph."""
    lens = Pinhole(32, 32, 40.0, 30.0, 12.0, 18.0)
    views = [View(f"hand#{k}", v.image, v.camera_to_world, lens) for k, v in enumerate(tile())]
    field = saved(tmp_path, views=views)
    last = field.views[-1]
    expected = np.clip(field.render(last.camera_to_world, lens).color * 255 + 0.5, 0, 255).astype(np.uint8)
    for camera in (last.camera, "hand"):  # a carried camera is its newest view
        assert render(tmp_path, "--camera", camera, tmp_path / "own.png") == 0
        np.testing.assert_array_equal(cv2.imread(str(tmp_path / "own.png"))[..., ::-1], expected)
