"""What is written reads back: by libraries that are not ours where there are any, to the bit where not."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge_server.cli import main as edge_server
from edge_server.experiments.scenes.recorded import load_recorded
from edge_server.export import ExportError, file_names, ply
from edge_server.export.colmap import Cloud, write_model
from edge_server.export.exporter import write_mesh
from edge_server.export.images_and_video import write_images, write_video
from edge_server.export.point_cloud import sparse_points
from edge_server.export.splats import Y0, splat_table, write_splats
from edge_server.export.transforms import write_transforms
from edge_server.fields import View
from edge_server.fields.common.kernels.volume_rendering import harmonic
from edge_server.fields.common.scene_box import SceneBox
from edge_server.page.splats.messages import HEAD, SAVED, StaticBlock, write_message
from edge_server.page.splats.published import Publisher
from freshfield.geometry import se3_inverse
from tests.edge_server.page.splats.gaussians import BOX, NEWEST_S, ORIGIN_NS, snapshot
from tests.edge_server.surface.ball import DISTORTED_LENS, LENS, ball_maps
from tests.freshfield.test_ledger import no_file_longer_than
from tests.support import refusal, refused

RNG = np.random.default_rng(5)


def shots(count: int = 4) -> list[View]:
    maps = ball_maps(count)
    lenses = [LENS, DISTORTED_LENS]
    pictures = RNG.integers(0, 255, (count, 64, 64, 3), dtype=np.uint8)
    return [View(f"view{k}.png", pictures[k], m.camera_to_world, lenses[k % 2]) for k, m in enumerate(maps)]


def numbered(name: str, count: int) -> list[str]:
    return [f"{name}_{k}" for k in range(count)]


def columns(data, names) -> np.ndarray:
    return np.stack([data[name] for name in names], axis=-1)


def pixels(shot: View, points: np.ndarray) -> np.ndarray:
    inverse = se3_inverse(shot.camera_to_world)
    return shot.intrinsics.project(points @ inverse[:3, :3].T + inverse[:3, 3])


def test_colmap_opens_in_colmap(tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed (extra colmap)")
    of, places = shots(), RNG.uniform(-0.08, 0.08, (50, 3))  # in front of all cameras
    at = np.stack([pixels(shot, places) for shot in of], axis=1)
    points = Cloud(places, RNG.integers(0, 255, (50, 3), dtype=np.uint8), ((at > 0) & (at < 64)).all(axis=-1))
    write_model(tmp_path, of, points)
    model = pycolmap.Reconstruction(str(tmp_path))
    assert model.num_images() == 4 and model.num_points3D() == 50 and model.num_cameras() == 2
    images = {image.name: image for image in model.images.values()}
    for k, shot in enumerate(of):
        image = images[shot.camera]
        matrix = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        np.testing.assert_allclose(matrix, se3_inverse(shot.camera_to_world), atol=1e-12)
        which = np.flatnonzero(points.seen[:, k])
        found = np.array([image.project_point(p) for p in points.points[which]])
        assert np.abs(found - pixels(shot, points.points[which])).max() < 0.01
        assert sorted(p.point3D_id for p in image.points2D) == sorted(which + 1)
    for k, point in model.points3D.items():
        np.testing.assert_array_equal(point.xyz, points.points[k - 1])
        assert tuple(point.color) == tuple(points.color[k - 1])
        assert point.track.length() == points.seen[k - 1].sum()
    assert model.compute_mean_reprojection_error() < 0.01


def test_transforms_read_back_as_they_were(tmp_path):
    of = shots()
    clear = View("clear.png", RNG.integers(0, 255, (64, 64, 4), dtype=np.uint8), np.eye(4), LENS)
    write_images(tmp_path / "images", [*of, clear])
    back = cv2.imread(str(tmp_path / "images" / "clear.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(cv2.cvtColor(back, cv2.COLOR_BGRA2RGBA), clear.image)
    write_transforms(tmp_path, of)
    views = load_recorded(tmp_path, holdout="0").training
    assert len(views) == 4
    for shot, view in zip(of, views):
        np.testing.assert_array_equal(view.image, shot.image)
        assert view.intrinsics == shot.intrinsics
        point = RNG.uniform(-0.05, 0.05, (20, 3))
        assert np.abs(pixels(view, point) - pixels(shot, point)).max() < 0.01
    assert "ply_file_path" not in json.loads((tmp_path / "transforms.json").read_text())


@pytest.mark.parametrize("sh_degree", [0, 1])
def test_splats_stand_as_viewers_expect_them(tmp_path, sh_degree):
    params = RNG.normal(size=(30, 14 + 9 * sh_degree)).astype(np.float32)
    box = SceneBox((1.0, -2.0, 0.5), 2.5, 0.1, False, 3.0, 0.01)
    extra = 3 * sh_degree
    assert write_splats(tmp_path / "s.ply", params, box) == 30
    data = read_floats(tmp_path / "s.ply")
    names = [*"xyz", "nx", "ny", "nz", *numbered("f_dc", 3), *numbered("f_rest", 3 * extra), "opacity"]
    assert list(data) == [*names, *numbered("scale", 3), *numbered("rot", 4)]
    position = (params[:, :3] * np.float64(2.5) + (1.0, -2.0, 0.5)).astype(np.float32)
    np.testing.assert_array_equal(columns(data, "xyz"), position)
    np.testing.assert_array_equal(data["opacity"], params[:, 10])
    np.testing.assert_allclose(np.exp(columns(data, numbered("scale", 3))), 2.5 * np.exp(params[:, 3:6]), rtol=1e-5)
    # The color a viewer works out is ours, from any side: its basis has the other sign for odd orders.
    way = RNG.normal(size=3)
    x, y, z = (way / np.linalg.norm(way)).astype(np.float32)
    theirs = 0.4886025119029199 * np.array([-y, z, -x])  # degree 1 of the implementation of Kerbl et al.
    for c in range(3):
        ours = params[:, 11 + c] + sum(harmonic(k + 1, x, y, z) * params[:, 14 + 3 * k + c] for k in range(extra))
        shown = 0.5 + Y0 * data[f"f_dc_{c}"]
        shown = shown + sum(theirs[k] * data[f"f_rest_{c * extra + k}"] for k in range(extra))
        np.testing.assert_allclose(shown, ours, atol=1e-5)


@pytest.mark.parametrize(
    ("sh_degree", "radius_m", "off_m"), [(1, 2.5, 2**-13), (0, 4e6, 4e6 * 2**-20), (0, 0.01, 2**-19)]
)
def test_splats_come_back_from_spz(tmp_path, sh_degree, radius_m, off_m):
    gsply = pytest.importorskip("gsply", reason="gsply is not installed (extra spz)")
    params = RNG.uniform(-1.0, 1.0, (30, 14 + 9 * sh_degree)).astype(np.float32)
    box = SceneBox((1.0, -2.0, 0.5), radius_m, 0.1, False, 3.0, 0.01)
    assert write_splats(tmp_path / "s.SPZ", params, box) == 30
    found, data = gsply.read_spz(tmp_path / "s.SPZ"), splat_table(params, box)
    assert np.abs(found.means - columns(data, "xyz")).max() <= off_m
    scales = np.clip(columns(data, numbered("scale", 3)), -10, 255 / 16 - 10)
    assert np.abs(found.scales - scales).max() <= 1 / 32 + 1e-6
    assert np.abs((found.quats * columns(data, numbered("rot", 4))).sum(axis=1)).min() > 1 - 1e-5
    assert np.abs(1 / (1 + np.exp(-found.opacities)) - 1 / (1 + np.exp(-data["opacity"]))).max() <= 0.51 / 255
    shown = np.clip(columns(data, numbered("f_dc", 3)), -0.5 / 0.15, 0.5 / 0.15)
    assert np.abs(found.sh0 - shown).max() <= 0.51 / (0.15 * 255)
    if sh_degree:
        rest = np.clip(columns(data, numbered("f_rest", 9)).reshape(-1, 3, 3), -1, 127 / 128)
        assert np.abs(found.shN - rest.transpose(0, 2, 1)).max() <= 0.51 / 128


def test_a_saved_stream_becomes_a_sequence_of_what_a_visitor_saw(tmp_path, capsys):
    shown, messages = snapshot(), []
    published = Publisher(ORIGIN_NS).take(shown, 0.0)
    whole = StaticBlock(1, 700, 0, published.static.scales, published.static.records)
    for number, ahead_s in enumerate((-0.2, 0.0, 0.11, 1e9)):  # a pause at the end
        blocks = [published.scene, *([whole, published.moving, published.knots] if number else [])]
        message = write_message(number, NEWEST_S + ahead_s, blocks)
        messages.append(SAVED.pack(len(message), 0.1 * number) + message)
    stream, out = tmp_path / "room.ffsplats", tmp_path / "new" / "room.ply"
    stream.write_bytes(b"".join(messages))
    assert edge_server(["export", str(stream), "--splats", str(out)]) == 0
    assert "5 frames" in capsys.readouterr().out
    assert sorted(path.name for path in out.parent.iterdir()) == [f"room-{k:04d}.ply" for k in range(5)]
    for k in (0, 3):
        got = read_floats(out.with_stem(f"room-{k:04d}"))
        moved = shown.moving.params_at(k / 30)[:, :3] * BOX.radius_m + np.array(BOX.center_m)
        got_places = columns(got, "xyz")[700:]
        assert np.linalg.norm(got_places[:, None] - moved, axis=-1).min(axis=0).max() < 2e-3  # meters; order is another


@pytest.mark.stability
def test_a_stream_that_cannot_be_read_is_said(tmp_path, capsys):
    stream = tmp_path / "a.ffsplats"
    lies = SAVED.pack(12, 0.0) + HEAD.pack(0, np.nan)
    for content, words in ((b"", "holds no Gaussians"), (lies, "message 0: the instant")):
        stream.write_bytes(content)
        assert words in refusal(capsys, edge_server, "export", stream, "--splats", tmp_path / "a.ply")
    assert "Gaussians alone" in refusal(capsys, edge_server, "export", stream, "--mesh", tmp_path / "a.ply")


def read_floats(path: Path) -> dict[str, np.ndarray]:
    """The properties of a PLY of nothing but floats."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    table = np.frombuffer(body, np.dtype([(n, "<f4") for n in names]))
    assert f"element vertex {len(table)}" in lines
    return {n: table[n] for n in names}


def test_meshes_and_points_open_in_trimesh(tmp_path):
    trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed (extra surface)")
    vertices = RNG.normal(size=(20, 3)).astype(np.float32)
    faces = RNG.permutation(20)[:18].reshape(6, 3).astype(np.int32)
    color = RNG.integers(0, 255, (20, 3), dtype=np.uint8)
    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=color, process=False)
    write_mesh(tmp_path / "m.ply", mesh)
    read = trimesh.load(tmp_path / "m.ply", process=False)
    np.testing.assert_array_equal(read.vertices, vertices)
    np.testing.assert_array_equal(read.faces, faces)
    np.testing.assert_array_equal(read.visual.vertex_colors[:, :3], color)
    ply.write_points(tmp_path / "p.ply", vertices, color)
    points = trimesh.load(tmp_path / "p.ply")
    np.testing.assert_array_equal(points.vertices, vertices)
    np.testing.assert_array_equal(points.colors[:, :3], color)
    write_mesh(tmp_path / "m.glb", mesh)
    read = trimesh.load(tmp_path / "m.glb", process=False).to_geometry()  # y up
    np.testing.assert_allclose(read.vertices, vertices[:, [0, 2, 1]] * (1, 1, -1), atol=1e-6)
    np.testing.assert_array_equal(read.visual.vertex_colors[:, :3], color)


def test_points_know_who_sees_them():
    maps = ball_maps(12)
    found = sparse_points(maps, 1200)
    assert 1000 < len(found.points) <= 1200
    assert len(sparse_points(maps, 7).points) == 7  # less than one of each map
    assert np.abs(np.linalg.norm(found.points, axis=1) - 0.1).max() < 1e-3
    top, bottom = found.points[:, 2] > 0.01, found.points[:, 2] < -0.01
    assert (found.color[top] == (200, 20, 20)).all() and (found.color[bottom] == 90).all()
    # Who sees a point of a ball stands on its side; nobody sees it through the ball.
    for k, m in enumerate(maps):
        front = found.points @ m.camera_to_world[:3, 3] > 0
        assert front[found.seen[:, k]].all()
    assert (found.seen.sum(axis=1) >= 2).mean() > 0.8


def test_a_video_that_a_full_disk_cuts_is_refused_and_the_old_one_stays(tmp_path):
    file, pictures = tmp_path / "a.mp4", RNG.integers(0, 255, (30, 64, 96, 3), dtype=np.uint8)
    assert write_video(file, pictures[:3]) == (3, 96, 64)
    before = file.read_bytes()
    with no_file_longer_than(20_000):
        refused(ExportError, "a.mp4: cannot be written whole", write_video, file, pictures)
    assert file.read_bytes() == before and list(tmp_path.iterdir()) == [file]


def test_pictures_keep_their_own_names_and_these_are_safe_and_different():
    def names(*cameras: str, channels: int = 3) -> list[str]:
        return file_names([View(c, np.zeros((2, 2, channels), np.uint8), np.eye(4), LENS) for c in cameras])

    assert names("images/1.png", "b/IMG 2.JPG", "cam.left") == ["1.png", "IMG_2.JPG", "cam.left.png"]
    assert names("a.jpg", "b.png", channels=4) == ["a.png", "b.png"], "JPEG has no transparency"
    assert names("x/1.png", "y/1.png") == ["00000_1.png", "00001_1.png"]
    assert [names(strange) for strange in ("../../etc", ".png", "x/")] == [["etc.png"], ["camera.png"], ["camera.png"]]
