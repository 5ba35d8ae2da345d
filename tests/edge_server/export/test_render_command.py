"""``edge-server render``: paths about what cameras saw, and the files that it writes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge_server.cli import main as edge_server
from edge_server.export.camera_paths import lens, orbit, read_nerfstudio, vertical_fov_deg
from edge_server.fields import View
from freshfield.geometry import Pinhole, look_at
from freshfield_up.cli import main as freshfield
from tests.edge_server.export.learned import saved, tile

LENS = Pinhole.from_fov(64, 48, 60.0)


def views(azimuths_deg: list[float], outward: bool = False) -> list[View]:
    """Cameras on a circle of 2 m about (1, 2, .5), 1 m above it, that look at it or away from it."""
    found = []
    for number, azimuth in enumerate(np.radians(azimuths_deg)):
        arm = np.array([2 * np.cos(azimuth), 2 * np.sin(azimuth), 1.0])
        target = np.array([1.0, 2.0, 0.5])
        pose = look_at(target + 0.1 * arm, target + arm) if outward else look_at(target + arm, target)
        found.append(View(f"cam{number}", np.zeros((48, 64, 3), np.uint8), pose, LENS))
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
@pytest.mark.parametrize("which", ["outward", "one", "parallel"])
def test_cameras_that_have_nothing_in_common_still_give_a_path(which):
    chosen = views([0.0, 90.0, 180.0, 270.0], outward=True) if which == "outward" else views([20.0])
    if which == "parallel":
        poses = [chosen[0].camera_to_world + np.eye(4, k=3) * k for k in range(3)]
        chosen = [replace(chosen[0], camera_to_world=pose) for pose in poses]
    for step in orbit(chosen, 8, 50.0):
        assert np.isfinite(step.camera_to_world).all()
        np.testing.assert_allclose(step.camera_to_world[:3, :3] @ step.camera_to_world[:3, :3].T, np.eye(3), atol=1e-9)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    saved(folder)
    return folder


def render(*words) -> int:
    return edge_server(["render", *map(str, words)])


def frames(file: Path) -> list[np.ndarray]:
    video, found = cv2.VideoCapture(str(file)), []
    while (taken := video.read())[0]:
        found.append(taken[1])
    return found


def test_an_orbit_is_a_video_and_two_runs_stand_side_by_side(run, tmp_path, capsys):
    file = tmp_path / "orbit.mp4"
    assert render(run, "--orbit", file, "--seconds", 0.4, "--fps", 10, "--size", "64x48") == 0
    assert "4 images of 64 x 48" in capsys.readouterr().out
    alone = frames(file)
    assert len(alone) == 4 and alone[0].shape == (48, 64, 3) and np.abs(alone[0].astype(int) - alone[2]).mean() > 1
    assert render(run, "--beside", run, "--orbit", file, "--seconds", 0.4, "--fps", 10, "--size", "64x48") == 0
    both = frames(file)[0]
    assert both.shape == (48, 128, 3) and np.abs(both[:, :64].astype(int) - both[:, 64:]).mean() < 4  # it is compressed


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
    (path).write_text(json.dumps(nerfstudio(seconds=0)))  # the rate is given: its seconds do not count
    assert render(run, "--path", path, tmp_path / "flight.mp4") == 0
    timeless = {key: value for key, value in nerfstudio().items() if key not in ("fps", "seconds")}
    (tmp_path / "timeless.json").write_text(json.dumps(timeless))
    assert read_nerfstudio(tmp_path / "timeless.json")[1] == 2.0  # two poses take a second
    assert vertical_fov_deg(lens(64, 48, 40.0)) == pytest.approx(40.0)
    # The same viewpoint, said by eye and target.
    assert render(run, "--path", path, tmp_path / "a.png") == 0
    assert render(run, "--pose", 0, -0.5, 0, 0, 0, 0, tmp_path / "b.png", "--fov", 40, "--size", "64x48") == 0
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "a.png")), cv2.imread(str(tmp_path / "b.png")))
    assert render(run, "--path", path, tmp_path / "depth.png", "--depth") == 0
    depth = cv2.imread(str(tmp_path / "depth.png"))
    assert depth.shape == (48, 64, 3) and np.ptp(depth.reshape(-1, 3), axis=0).max() > 100


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"camera_type": "fisheye"}, "camera_type"),
        ({"render_width": "wide"}, "render_width"),
        ({"camera_path": [{"camera_to_world": [float("nan")] * 16}]}, "camera_path"),
        ({"camera_path": [{**nerfstudio()["camera_path"][0], "fov": 200}]}, "camera_path[0].fov"),
        ({"fps": 0}, "fps"),
    ],
)
def test_a_path_that_cannot_be_flown_is_refused_by_key(change, says, run, tmp_path, capsys):
    (path := tmp_path / "camera_path.json").write_text(json.dumps(nerfstudio(**change)))
    assert render(run, "--path", path, tmp_path / "flight.mp4") == 2
    error = capsys.readouterr().err
    assert error.startswith("edge-server render: ") and says in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--orbit", "view.gif"], "ends in .png"),
        (["--orbit", "view.mp4", "--size", "33x20"], "videos need even sizes, not 33 x 20"),
        (["--orbit", "view.mp4", "--fov", "nan"], "--fov nan"),
        (["--camera", "cam99", "view.png"], "--camera cam99: the run has cam01"),
        (["--pose", "0", "0", "1", "0", "0", "1", "view.png"], "--pose: "),
    ],
)
def test_what_cannot_be_rendered_is_refused_in_one_line(words, says, run, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert render(run, *words) == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1
    assert freshfield(["render", "none", "--orbit", "view.mp4"]) == 2
    assert capsys.readouterr().err.startswith("freshfield render: none")
    assert not list(tmp_path.iterdir())


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
