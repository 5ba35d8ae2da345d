"""TUM RGB-D, 7-Scenes, Record3D and Polycam as their tools write them, of a known world; depth files of each kind."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from camera_node.capture import build_cameras
from camera_node.settings import source_config
from camera_node.sources.datasets import transforms
from camera_node.sources.datasets.formats import open_dataset
from camera_node.sources.datasets.lens import Lens
from camera_node.sources.datasets.photo import ImageOptions, Photo
from camera_node.sources.datasets.rgbd.depth_file import DepthFile
from camera_node.synthetic import make_scene
from camera_node.synthetic.depth import DepthRenderer
from freshfield.geometry import Pinhole, look_at
from tests.camera_node.sources.datasets.photos import edited, fails, photo_scenario, write_photos
from tests.camera_node.sources.datasets.sets import write_image

os.environ["OPENCV_IO_ENABLE_OPENEXR"] = "1"
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


def quaternion(matrix: np.ndarray) -> list[float]:
    """x y z w."""
    return Rotation.from_matrix(matrix[:3, :3]).as_quat().tolist()


def write_tum(folder: Path) -> None:
    lens = Pinhole(64, 48, 52.5, 52.5, 32.0, 24.0)  # a tenth of ROS's defaults
    lists: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
    for n in range(COUNT):
        t_s = 1305031102.175304 + n / 30
        write_image(folder / f"rgb/{t_s:.6f}.png", image(n, lens))
        write_image(folder / f"depth/{t_s + 0.009:.6f}.png", np.rint(5000 * depth(n, lens)).astype(np.uint16))
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
        write_image(folder / f"frame-{n:06d}.color.png", image(n, lens))
        counts = np.rint(1000 * depth(n, sensor, of_depth)).astype(np.uint16)
        counts[:1] = 65535
        write_image(folder / f"frame-{n:06d}.depth.png", counts)
        rows = ["\t ".join(f"{v: .7e}" for v in row) + "\t " for row in of_depth]
        (folder / f"frame-{n:06d}.pose.txt").write_text("\n".join(rows) + "\n")


def write_record3d(folder: Path) -> None:
    lens, small = Pinhole(64, 48, 60.0, 60.0, 31.0, 25.0), Pinhole(32, 24, 30.0, 30.0, 15.5, 12.5)
    poses = []
    for n in range(COUNT):
        write_image(folder / f"rgb/{n}.png", image(n, lens))
        write_image(folder / f"depth/{n}.exr", depth(n, small))
        matrix = pose(n) @ FLIP
        poses.append([*quaternion(matrix), *matrix[:3, 3]])
    # K column by column: fx 0 0, 0 fy 0, cx cy 1.
    data = {"w": 64, "h": 48, "fps": 60, "K": [60.0, 0, 0, 0, 60.0, 0, 31.0, 25.0, 1], "poses": poses}
    (folder / "metadata.json").write_text(json.dumps(data))


def write_polycam(folder: Path) -> None:
    lens, small = Pinhole(64, 48, 60.0, 61.0, 31.0, 25.0), Pinhole(32, 24, 30.0, 30.5, 15.5, 12.5)
    for n in range(COUNT):
        name = f"{7_000_000 + 100_000 * n}"
        write_image(folder / f"keyframes/images/{name}.png", image(n, lens))
        write_image(folder / f"keyframes/depth/{name}.png", np.rint(1000 * depth(n, small)).astype(np.uint16))
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


def test_transforms_bring_depth_with_the_frames_that_have_it(tmp_path):
    """All but the second; that of the third is missing."""

    def add(data) -> None:
        for index, frame in enumerate(data["frames"]):
            if index != 1:
                frame["depth_file_path"] = f"depth/{index:03d}.png"
            if index != 2:
                written(tmp_path / f"depth/{index:03d}.png", np.where(MM > 0, MM + index, 0).astype(np.uint16))

    (tmp_path / "depth").mkdir()
    file = edited(write_photos(tmp_path, 16), add, depth_unit_scale_factor=0.0005)
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
