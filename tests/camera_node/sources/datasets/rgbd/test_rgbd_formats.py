"""TUM RGB-D, 7-Scenes, Record3D and Polycam: sets as their tools write them, of a world that is known.

The writers share nothing with the readers: conventions are spelt out here a second time.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from camera_node.sources.datasets.formats import open_dataset
from camera_node.synthetic import make_scene
from camera_node.synthetic.depth import DepthRenderer
from freshfield.geometry import Pinhole, look_at

os.environ["OPENCV_IO_ENABLE_OPENEXR"] = "1"
import cv2

SCENE = make_scene("room", {"width": 64, "height": 48, "supersample": 1})
COUNT = 3
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenCV's axes to OpenGL's
# World as ARKit has it: y up. Its x is our y, its y our z.
TO_ARKIT = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def pose(n: int) -> np.ndarray:
    return look_at([1.2 - 0.3 * n, -1.5, 1.4 + 0.1 * n], [0.1, 0.3, 0.8])


def image(n: int, lens: Pinhole) -> np.ndarray:
    return SCENE.view(lens, pose(n)).image(0.0)


def depth(n: int, lens: Pinhole, matrix: np.ndarray | None = None) -> np.ndarray:
    return DepthRenderer(SCENE.world, lens, pose(n) if matrix is None else matrix).depth(0.0)


def save(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), values[..., ::-1] if values.ndim == 3 else values)


def quaternion(matrix: np.ndarray) -> list[float]:
    """x y z w."""
    return Rotation.from_matrix(matrix[:3, :3]).as_quat().tolist()


def write_tum(folder: Path) -> None:
    lens = Pinhole(64, 48, 52.5, 52.5, 32.0, 24.0)  # a tenth of ROS's defaults
    lists: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
    for n in range(COUNT):
        t_s = 1305031102.175304 + n / 30
        save(folder / f"rgb/{t_s:.6f}.png", image(n, lens))
        save(folder / f"depth/{t_s + 0.009:.6f}.png", np.rint(5000 * depth(n, lens)).astype(np.uint16))
        lists["rgb"].append(f"{t_s:.6f} rgb/{t_s:.6f}.png")
        lists["depth"].append(f"{t_s + 0.009:.6f} depth/{t_s + 0.009:.6f}.png")
        numbers = [*pose(n)[:3, 3], *quaternion(pose(n))]
        lists["groundtruth"].append(f"{t_s - 0.004:.4f} " + " ".join(f"{v:.7f}" for v in numbers))
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("# a comment\n" + "\n".join(lines) + "\n")


def write_sevenscenes(folder: Path) -> None:
    lens, sensor = (Pinhole(64, 48, f, f, 32.0, 24.0) for f in (52.5, 58.5))  # a tenth of the data set's size
    apart = np.eye(4)
    apart[0, 3] = -0.0256  # the nominal place of a Kinect's depth sensor to its camera
    for n in range(COUNT):
        of_depth = pose(n) @ apart
        save(folder / f"frame-{n:06d}.color.png", image(n, lens))
        counts = np.rint(1000 * depth(n, sensor, of_depth)).astype(np.uint16)
        counts[:1] = 65535
        save(folder / f"frame-{n:06d}.depth.png", counts)
        rows = ["\t ".join(f"{v: .7e}" for v in row) + "\t " for row in of_depth]
        (folder / f"frame-{n:06d}.pose.txt").write_text("\n".join(rows) + "\n")


def write_record3d(folder: Path) -> None:
    lens, small = Pinhole(64, 48, 60.0, 60.0, 31.0, 25.0), Pinhole(32, 24, 30.0, 30.0, 15.5, 12.5)
    poses = []
    for n in range(COUNT):
        save(folder / f"rgb/{n}.png", image(n, lens))
        save(folder / f"depth/{n}.exr", depth(n, small))
        matrix = pose(n) @ FLIP
        poses.append([*quaternion(matrix), *matrix[:3, 3]])
    # K column by column: fx 0 0, 0 fy 0, cx cy 1.
    data = {"w": 64, "h": 48, "fps": 60, "K": [60.0, 0, 0, 0, 60.0, 0, 31.0, 25.0, 1], "poses": poses}
    (folder / "metadata.json").write_text(json.dumps(data))


def write_polycam(folder: Path, from_us: int = 7_000_000) -> None:
    lens, small = Pinhole(64, 48, 60.0, 61.0, 31.0, 25.0), Pinhole(32, 24, 30.0, 30.5, 15.5, 12.5)
    for n in range(COUNT):
        name = f"{from_us + 100_000 * n}"
        save(folder / f"keyframes/images/{name}.png", image(n, lens))
        save(folder / f"keyframes/depth/{name}.png", np.rint(1000 * depth(n, small)).astype(np.uint16))
        matrix = TO_ARKIT @ pose(n) @ FLIP
        entry = {f"t_{r}{c}": matrix[r, c] for r in range(3) for c in range(4)}
        entry |= {"fx": 60.0, "fy": 61.0, "cx": 31.0, "cy": 25.0, "width": 64, "height": 48, "blur_score": 120.5}
        (folder / "keyframes/cameras").mkdir(exist_ok=True)
        (folder / f"keyframes/cameras/{name}.json").write_text(json.dumps(entry))


WRITERS: dict[str, Callable[[Path], None]] = {
    "tum": write_tum,
    "sevenscenes": write_sevenscenes,
    "record3d": write_record3d,
    "polycam": write_polycam,
}


@pytest.mark.parametrize("name", WRITERS)
def test_image_pose_and_depth_are_of_one_world(tmp_path, name):
    """The world, seen from where the record says, looks as its image and is as deep as its depth."""
    WRITERS[name](tmp_path)
    file, found = open_dataset(tmp_path)
    assert len(found) == COUNT and not found.moving and not found.notes
    again = open_dataset(file if file.is_file() else tmp_path, name=name)[1]
    assert [r.name for r in again] == [r.name for r in found]
    for n, record in enumerate(found):
        assert np.allclose(record.camera_to_world, pose(n), atol=2e-4)
        seen_again = SCENE.view(record.intrinsics, record.camera_to_world).image(0.0)
        assert np.abs(record.read().astype(float) - seen_again).mean() < 2.0
        measured = record.depth()
        lens = measured.intrinsics or record.intrinsics.scaled(measured.counts.shape[1] / record.intrinsics.width)
        at = record.camera_to_world @ (np.eye(4) if measured.to_camera is None else measured.to_camera.matrix())
        exact = DepthRenderer(SCENE.world, lens, at).depth(0.0)
        seen = measured.counts > 0
        assert seen.mean() > 0.97 and seen[:1].any() != (name == "sevenscenes")
        assert np.median(np.abs(measured.meters()[seen] - exact[seen])) < 0.001
        assert (np.abs(measured.meters()[seen] - exact[seen]) < 0.02).mean() > 0.98


def test_corrected_poses_of_polycam_are_preferred(tmp_path):
    """They were computed from the photos, the others are a tracker's, at the times that files are named by."""
    write_polycam(tmp_path, 950_000)  # names that are sorted by time are not as texts
    assert [image.time_s for image in open_dataset(tmp_path)[1]] == pytest.approx(0.1 * np.arange(COUNT))
    frames = tmp_path / "keyframes"
    shutil.copytree(frames / "images", frames / "corrected_images")
    (frames / "corrected_cameras").mkdir()
    entry = json.loads((frames / "cameras/1050000.json").read_text())
    (frames / "corrected_cameras/1050000.json").write_text(json.dumps(entry | {"t_03": entry["t_03"] + 0.5}))
    (found,) = open_dataset(tmp_path)[1]
    assert found.name == "1050000" and found.depth is not None and found.time_s is None
    assert np.abs(found.camera_to_world[:3, 3] - pose(1)[:3, 3]).max() == pytest.approx(0.5)
