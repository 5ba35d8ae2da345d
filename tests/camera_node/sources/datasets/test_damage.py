"""Of every format: whatever is wrong with its files is one line that names them; what is missing is counted."""

import json
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from camera_node.sources.datasets.formats import reader
from camera_node.sources.datasets.records import DatasetError
from tests.camera_node.sources.datasets import sets
from tests.camera_node.sources.datasets.photos import fails, write_photos
from tests.camera_node.sources.datasets.rgbd import test_rgbd_formats as rgbd
from tests.camera_node.sources.datasets.test_video import write_rig
from tests.support import refused

Change = Callable[[Path], Any]
POSES, ANNOTS = "poses_bounds.npy", "annots.npy"
# Format -> writer, and the file that describes the set.
SETS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "transforms": (lambda folder: write_photos(folder, 2), "transforms.json"),
    "video": (write_rig, "calibration_opencv.json"),
    "dynerf": (lambda folder: sets.write_dynerf(folder, sets.rig(3)), POSES),
    "zju": (lambda folder: sets.write_zju(folder, sets.rig(3)), ANNOTS),
    "eyeful": (lambda folder: sets.write_eyeful(folder, sets.rig(2)), "cameras.json"),
    "colmap text": (lambda folder: sets.write_colmap(folder, sets.rig(3), "PINHOLE", False), "sparse/0/images.txt"),
    "colmap": (lambda folder: sets.write_colmap(folder, sets.rig(3), "PINHOLE", True), "sparse/0/images.bin"),
    "tum": (rgbd.write_tum, "groundtruth.txt"),
    "sevenscenes": (rgbd.write_sevenscenes, "frame-000000.pose.txt"),
    "record3d": (rgbd.write_record3d, "metadata.json"),
    "polycam": (rgbd.write_polycam, "keyframes/cameras/7000000.json"),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Callable[[str], Path]:
    """The folder of a set without damage, by its writer's name."""

    @cache
    def made(name: str) -> Path:
        folder = tmp_path_factory.mktemp("whole") / name
        folder.mkdir()
        SETS[name][0](folder)
        return folder

    return made


def load(name: str, folder: Path):
    return reader(name.split()[0]).load_dataset(folder)


def changed(file: str, change: Callable[[bytes], bytes]) -> Change:
    return lambda folder: (folder / file).write_bytes(change((folder / file).read_bytes()))


def replaced(file: str, old: bytes, new: bytes) -> Change:
    return changed(file, lambda data: data.replace(old, new))


def written(file: str, text: str) -> Change:
    return changed(file, lambda _: text.encode())


def in_json(file: str, change: Callable[[Any], Any]) -> Change:
    def apply(folder: Path) -> None:
        data = json.loads((folder / file).read_text())
        change(data)
        (folder / file).write_text(json.dumps(data))

    return apply


def in_top(change: Callable[[Any], Any]) -> Change:
    return in_json("transforms.json", change)


def in_frame(change: Callable[[Any], Any]) -> Change:
    return in_top(lambda data: change(data["frames"][0]))


def in_rig(**keys: Any) -> Change:
    return in_json("calibration_opencv.json", lambda data: data["cam01"].update(keys))


def in_krt(change: Callable[[Any], Any]) -> Change:
    return in_json("cameras.json", lambda data: change(data["KRT"][1]))


def in_numpy(file: str, change: Callable[[Any], Any]) -> Change:
    """change: returns what is saved instead of the array, or of the object in it."""

    def apply(folder: Path) -> None:
        found = np.load(folder / file, allow_pickle=True)
        np.save(folder / file, change(found if found.shape else found.item()), allow_pickle=True)

    return apply


def leads_out(file: str) -> Change:
    """A symbolic link to where the file lies now, beside the folder."""

    def apply(folder: Path) -> None:
        (folder / file).rename(folder.parent / "private")
        (folder / file).symlink_to(folder.parent / "private")

    return apply


DAMAGE: dict[str, list[tuple[Change, str]]] = {
    "transforms": [
        (in_frame(lambda f: f.update(transform_matrix=[[1, 2], [3, 4]])), r"frames\[0\].*transform_matrix"),
        (in_frame(lambda f: f["transform_matrix"][0].__setitem__(0, 7.0)), "orthonormal"),
        (in_frame(lambda f: f["transform_matrix"][0].__setitem__(3, 10**400)), "transform_matrix"),
        (in_frame(lambda f: f.update(transform_matrix=[*zip(*f["transform_matrix"])])), "is it transposed"),
        (in_top(lambda d: d["frames"].append(d["frames"][1])), "2 of its .* the image images/001.png"),
        (in_top(lambda d: d.update(fl_x=10**400)), "fl_x is 10{59}, expected"),
        (in_top(lambda d: d.update(h=1e300)), "too many"),
        (in_top(lambda d: [f.update(is_bad=True) for f in d["frames"]]), "marked is_bad, and none"),
        (written("transforms.json", "[" * 10**5), "cannot be read as JSON"),
        (written("transforms.json", '{"w": 64, "frames": [], "w": 32}'), "cannot be read as JSON"),
        (leads_out("images/001.png"), "001.png' is a symbolic link that leads out of the data set"),
    ],
    "video": [
        (in_rig(width=65), "64 x 48, calibrated for 65 x 48"),
        (in_rig(R_world_to_cam=np.diag([1.0, 1, -1]).tolist()), r"cam01\.R_world_to_cam"),
        (leads_out("videos/cam00.mp4"), r"'videos/cam00\.mp4' is a symbolic link that leads out of the data set"),
        (written("videos/cam00.mp4", "no video at all"), r"cam00\.mp4: OpenCV cannot open"),
        (lambda f: (f / "calibration_opencv.json").unlink(), r"expected one calib\*.json or rig\*.json, found none"),
    ],
    "dynerf": [
        (replaced(POSES, b"'shape': (3", b"'shape': (9" + b"9" * 10), r"poses_bounds\.npy: cannot be read"),
        (in_numpy(POSES, lambda rows: np.where(np.arange(3)[:, None] == 1, np.nan, rows)), "row 1 is not finite"),
        (in_numpy(POSES, lambda r: r * np.where(np.arange(17) == 9, 1.5, 1)), r"96 x 48, cam00\.mp4 has 64 x 48"),
    ],
    "zju": [
        (in_numpy(ANNOTS, lambda a: a["ims"][1]["ims"].pop() and a), r"numbers of cameras differ: K 3, .*ims\[1\] 2"),
        (in_numpy(ANNOTS, lambda a: a["cams"].update(K=[[[10**400] * 3] * 3] * 3) or a), "'cams' with K, .* too large"),
    ],
    "eyeful": [
        (in_krt(lambda e: e.update(distortion=[10**400] * 5)), "width, height or distortion is wrong"),
        (in_krt(lambda e: e.update(cameraId="10/10_DSC0000")), "json: 2 of its entries are of the image 10/10"),
        (in_krt(lambda e: e.update(distortion=[0.1])), "RadialAndTangential' with 1 coefficients"),
        (in_krt(lambda e: e.update(cameraId="../../x")), "does not lie within the folder"),
        (in_json("cameras.json", lambda data: [entry.update(width=100) for entry in data["KRT"]]), "another shape"),
        (
            lambda folder: (folder / "images-jpeg-2k").rename(folder / "images"),
            "has no folder images-jpeg-1k or images-",
        ),
    ],
    "colmap text": [
        (replaced("sparse/0/cameras.txt", b"PINHOLE", b"OPENCV"), "OPENCV has 8 parameters, not 4"),
        (changed("sparse/0/images.txt", lambda d: d[:-1].rpartition(b"\n")[0]), "points is missing: cut"),
    ],
    "colmap": [
        (changed("sparse/0/images.bin", lambda d: d + b"more"), "4 bytes follow its last"),
        (changed("sparse/0/cameras.bin", lambda d: d[:12] + b"\x0a\0\0\0" + d[16:]), "model 10: expected one of"),
    ],
    "tum": [
        (written("rgb.txt", "nan rgb/1.png\n"), "rgb.txt: expected lines of seconds and file"),
        (written("groundtruth.txt", "5 0 0 0 0 0 0 1\n"), "3 of 3 images have no pose within 20 ms"),
        (written("rgb.txt", "1305031102.175304 ../x.png\n"), "does not lie within the folder"),
    ],
    "sevenscenes": [(written("frame-000000.pose.txt", "nan " * 16), "pose must be a finite")],
    "record3d": [(written("metadata.json", '{"poses": [[1]]}'), "poses: expected finite numbers of shape")],
    "polycam": [(written("keyframes/cameras/7000000.json", '{"width": 64}'), "height is missing")],
}


@pytest.mark.stability
@pytest.mark.parametrize(("name", "change", "message"), [(name, *row) for name, rows in DAMAGE.items() for row in rows])
def test_damage_is_one_line_that_names_it(tmp_path, whole, name, change, message):
    folder = Path(shutil.copytree(whole(name), tmp_path / "set", symlinks=True))
    change(folder)
    assert str(folder) in str(fails(message, load, name, folder))


@pytest.mark.stability
@pytest.mark.parametrize("name", SETS)
def test_a_file_that_is_cut_or_overwritten_anywhere_is_read_or_named(tmp_path, whole, name):
    folder = Path(shutil.copytree(whole(name), tmp_path / "set"))
    file, rng, refused = folder / SETS[name][1], np.random.default_rng(3), 0
    data = file.read_bytes()
    for kind in range(30):
        at, width = int(rng.integers(len(data))), int(rng.integers(1, 9))
        file.write_bytes(data[:at] + (rng.bytes(width) + data[at + width :] if kind % 2 else b""))
        try:
            assert all(np.isfinite(record.camera_to_world).all() for record in load(name, folder))
        except DatasetError as error:
            assert "\n" not in str(error) and str(folder) in str(error)
            refused += 1
    assert refused > 8


@pytest.mark.stability
@pytest.mark.parametrize("name", sorted(SETS.keys() - {"video", "dynerf"}))
def test_missing_images_are_counted_and_missing_depth_costs_only_depth(tmp_path, whole, name):
    folder = Path(shutil.copytree(whole(name), tmp_path / "set"))
    pictures = sorted(file for file in folder.rglob("*") if file.suffix in (".png", ".jpg", ".exr"))
    depths = [file for file in pictures if "depth" in str(file.relative_to(folder))]
    images = [file for file in pictures if file not in depths and "mask" not in str(file)]
    whole_set = load(name, folder)
    images[0].unlink()
    for file in depths[1:2]:
        file.unlink()
    found = load(name, folder)
    assert found.missing == 1 and len(found) == len(images) - 1 == len(whole_set) - 1
    assert f"1 of {len(images)} images are missing" in found.notes[0]
    assert not depths or [record.depth is None for record in found] == [True, False]
    for file in images[1:]:
        file.unlink()
    refused(DatasetError, f"{len(images)} of {len(images)} images are missing", load, name, folder)
