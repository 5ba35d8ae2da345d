"""Every data set's loader against a set in its exact format: conventions by reprojection; whatever is wrong with its
files is one line that names them; what is missing is counted."""

import json
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from camera_node.sources.datasets import dynerf, eyeful, zju
from camera_node.sources.datasets.formats import FORMATS, open_dataset, reader
from camera_node.sources.datasets.lens import Lens, exact, pinhole, undistort
from camera_node.sources.datasets.photo import FULL_SIZE
from camera_node.sources.datasets.records import DatasetError
from freshfield.geometry import Pinhole, se3_inverse
from freshfield.scenario import parse
from tests.camera_node.sources.datasets import sets
from tests.camera_node.sources.datasets.photos import fails, opened, write_photos
from tests.camera_node.sources.datasets.rgbd import test_rgbd_formats as rgbd
from tests.camera_node.sources.datasets.test_transforms import write_rig
from tests.support import refused

BENT = Pinhole(64, 48, 60.0, 61.0, 31.2, 24.9, (-0.08, 0.02, 0.002, -0.003))
NEAR_PX = 0.01


def seen(camera_to_world, lens, points=sets.POINTS):
    """Where a camera sees points."""
    inverse = se3_inverse(camera_to_world)
    return lens.project(points @ inverse[:3, :3].T + inverse[:3, 3])


def agree(records, cameras, instant=0):
    """Every record sees every point where OpenCV sees it, and shows what its camera showed then."""
    assert len(records) == len(cameras)
    for record, camera in zip(records, cameras):
        assert np.abs(seen(record.camera_to_world, record.intrinsics) - camera.pixels()).max() < NEAR_PX
        off = [np.abs(record.read().astype(float) - each.shows(instant)).mean() for each in cameras]
        # What is left is compression, of videos at a quarter of the colors.
        assert off[cameras.index(camera)] == min(off) < 15, off


@pytest.mark.parametrize("written_at", [1.0, 2.0], ids=["same size", "videos halved"])
def test_dynerf_sees_points_where_they_are(tmp_path, written_at):
    cameras = sets.rig(3)
    dataset = dynerf.load_dataset(sets.write_dynerf(tmp_path, cameras, 6, written_at))
    assert dataset.moving and dataset.fps == 10 and len(dataset) == 18
    agree([dataset.of(camera.name)[4] for camera in cameras], cameras, 4)


def test_zju_sees_points_where_they_are_and_counts_instants(tmp_path):
    cameras = sets.rig(3, BENT)
    folder = sets.write_zju(tmp_path, cameras)
    (folder / "Camera_B2/000001.jpg").unlink()
    (folder / "Camera_B1/extra.jpg").write_bytes(b"nobody lists it")
    dataset = zju.load_dataset(folder)
    assert dataset.moving and dataset.cameras == ("Camera_B1", "Camera_B2", "Camera_B3")
    assert dataset.missing == 1 and len(dataset) == 11
    last = [dataset.of(name)[-1] for name in dataset.cameras]
    agree(last, cameras, 3)
    assert last[0].intrinsics.distorted and last[0].path is not None
    assert [r.time_s for r in dataset.of("Camera_B2")] == [0.0, 2 / 50, 3 / 50]
    straightened = zju.load_dataset(sets.write_zju(tmp_path / "k3", cameras, k3=0.01))
    assert not any(r.intrinsics.distorted or r.path for r in straightened)


def test_zju_masks_cut_the_person_out(tmp_path):
    folder = sets.write_zju(tmp_path, sets.rig(2))
    image = zju.load_dataset(folder, masks="mask_cihp").of("Camera_B2")[0].read()
    inside = np.zeros((48, 64), bool)
    inside[8:40, 16:48] = True
    np.testing.assert_array_equal(image[..., 3], np.where(inside, 255, 0))
    (folder / "mask_cihp/Camera_B1/000002.png").unlink()
    fails(r"mask_cihp.Camera_B1.000002\.png: missing", zju.load_dataset, folder, FULL_SIZE, "mask_cihp")


class _Built:
    """Pickled as a call, with a state to set."""

    def __init__(self, call, arguments, state=None):
        self.reduced = (call, arguments, state)

    def __reduce__(self):
        return self.reduced


_OBJECTS = np.dtype("O")
_POINTERS = b"\x41" * 64
_HIDDEN = _Built(np.dtype, ("V8", False, True), (3, "|", None, ("a",), {"a": (_OBJECTS, 0)}, 8, 1, 0))


def _array_of(shape, dtype, raw):
    return _Built(np._core.multiarray._reconstruct, (np.ndarray, (0,), b"b"), (1, shape, dtype, False, raw))


CRAFTED = {
    "ndarray called": _Built(np.ndarray, ((), _OBJECTS, _POINTERS)),
    "objects from bytes": _array_of((8,), _OBJECTS, _POINTERS),
    "objects in a structure": _array_of((8,), _HIDDEN, _POINTERS),
    "scalar of objects": _Built(np._core.multiarray.scalar, (_HIDDEN, _POINTERS[:8])),
    "too few bytes": _array_of((2**40,), np.dtype("f8"), b""),
    "a state of another kind": _Built(np.dtype, ("f8",), {"type": 3}),
}


def write_object(file, value):
    np.save(file, np.array(None), allow_pickle=True)
    head = file.read_bytes()
    file.write_bytes(head[: head.index(b"\n") + 1] + pickle.dumps(value))


def test_a_crafted_pickle_is_refused(tmp_path):
    """In a process of its own: numpy's own functions crash."""
    for name, crafted in CRAFTED.items():
        (tmp_path / name).mkdir()
        write_object(tmp_path / name / "annots.npy", crafted)
    code = """
import sys
from pathlib import Path
from camera_node.sources.datasets import zju
from camera_node.sources.datasets.records import DatasetError
for folder in sorted(Path(sys.argv[1]).iterdir()):
    try:
        zju.load_dataset(folder)
    except DatasetError as error:
        print("cannot be read" in str(error), flush=True)
"""
    found = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True)
    assert found.returncode == 0 and found.stdout == "True\n" * len(CRAFTED), sorted(CRAFTED)


def test_a_pickle_runs_nothing_and_one_that_refers_to_itself_is_no_bomb(tmp_path):
    write_object(tmp_path / "annots.npy", {"cams": _Built(exec, (f"open({str(tmp_path / 'sprung')!r}, 'w')",))})
    fails("asks for builtins.exec", zju.load_dataset, tmp_path)
    assert not (tmp_path / "sprung").exists()
    value = ["x"]
    for _ in range(60):
        value = [value, value]
    write_object(tmp_path / "annots.npy", {"cams": {key: value for key in "KDRT"}, "ims": [{"ims": value}]})
    fails("references expand to more", zju.load_dataset, tmp_path)


def test_eyeful_sees_points_where_they_are_and_straightens_lenses_that_are_none_of_ours(tmp_path):
    cameras = sets.rig(3, BENT)
    dataset = eyeful.load_dataset(sets.write_eyeful(tmp_path, cameras))
    assert dataset.cameras == ("10", "11", "12") and not dataset.moving
    agree([dataset.of(name)[0] for name in dataset.cameras], cameras)
    assert dataset.held_out == {"10/10_DSC0000", "10/10_DSC0001"}
    bent = [0.1, 0.2, 3e-3, 4e-3, 0.5], {"radial": (0.1, 0.2, 0.5), "tangential": (3e-3, 4e-3)}
    round_ = [-0.02, 4e-3, 0, 0, 0, 0, 0, 0], {"radial": (-0.02, 4e-3, 0.0), "fisheye": True}
    for model, (distortion, bends) in (("RadialAndTangential", bent), ("Fisheye", round_)):
        record = eyeful.load_dataset(sets.write_eyeful(tmp_path / model, cameras, 1, model, distortion))[1]
        assert record.intrinsics == pinhole(Lens(64, 48, 60.0, 61.0, 31.2, 24.9, **bends)) and record.path is None


@pytest.mark.parametrize(
    ("model", "binary"), [*((m, True) for m in sets.COLMAP_MODELS), ("OPENCV", False), ("RADIAL_FISHEYE", False)]
)
def test_colmap_sees_points_where_they_are(tmp_path, model, binary):
    bends = {"SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4}.get(model, 0)
    fy = BENT.fy if model in ("PINHOLE", "OPENCV", "OPENCV_FISHEYE") else BENT.fx
    bend = (*BENT.distortion[:bends], 0.0, 0.0, 0.0, 0.0)[:4]
    cameras = sets.rig(3, Pinhole(64, 48, BENT.fx, fy, BENT.cx, BENT.cy, bend))
    file, dataset = open_dataset(sets.write_colmap(tmp_path, cameras, model, binary))
    assert file == tmp_path / f"sparse/0/cameras.{'bin' if binary else 'txt'}"
    assert [r.name for r in dataset] == [f"{camera.name} x.jpg" for camera in cameras]
    if model.endswith("FISHEYE"):
        radial = (-0.02,) if model.startswith("SIMPLE") else (-0.02, 0.004)
        lens = Lens(64, 48, BENT.fx, fy, BENT.cx, BENT.cy, radial, fisheye=True)
        assert dataset[0].intrinsics == pinhole(lens) and not dataset[0].intrinsics.distorted
    else:
        agree(list(dataset), cameras)
        np.testing.assert_allclose(dataset[1].camera_to_world, cameras[1].camera_to_world, atol=1e-9)


@pytest.mark.parametrize("name", ["dynerf", "zju", "eyeful", "colmap"])
def test_formats_are_recognized_and_streamed_at_their_pace(tmp_path, name):
    folder = SETS[name][0](tmp_path / "set")
    _, dataset = open_dataset(folder)
    for other in set(FORMATS) - {name}:
        fails("holds no data set of the format", open_dataset, folder, 1.0, other)
    ids = list(dataset.cameras) if name != "colmap" else ["a", "b", "c"]
    scenario = parse({"cameras": {"ids": ids}, "source": {"kind": name, "data": "set"}}, tmp_path / "s.yaml")
    sources = opened(scenario, data=tmp_path)
    assert {float(sources[c].fps) for c in ids} == {50.0 if name == "zju" else 10.0}
    for camera, truth in zip(ids, sets.rig(3)):
        shot = sources[camera].read(sources[camera].content(0))
        np.testing.assert_allclose(shot.pose.matrix(), truth.camera_to_world, atol=1e-9)
        assert isinstance(shot.image, bytes) == (name != "dynerf"), "what is a JPEG already is sent as it is"


def test_each_photo_of_a_tower_is_shown_at_any_rate(tmp_path):
    SETS["eyeful"][0](tmp_path / "set")
    source = {"kind": "eyeful", "data": "set", "fps": 5}
    scenario = parse({"cameras": {"ids": ["10", "11"]}, "source": source}, tmp_path / "s.yaml")
    shown = opened(scenario)["10"]
    assert [shown.content(tick) for tick in range(shown.contents)] == [*range(shown.contents)]


@pytest.mark.parametrize(
    "lens",
    [
        Lens(96, 64, 70.0, 72.0, 47.0, 33.0, (-0.2, 0.05, 0.01), (0.002, -0.003)),
        Lens(96, 64, 70.0, 72.0, 47.0, 33.0, (0.15, 0.02, 0.01), (0.0, 0.001)),
        Lens(96, 64, 40.0, 40.0, 48.0, 32.0, (-0.02, 0.004), fisheye=True),
    ],
    ids=["barrel", "pincushion", "fisheye"],
)
def test_straightened_pictures_show_each_ray_where_it_belongs(lens):
    assert not exact(lens)
    straight = pinhole(lens)
    u, v = np.meshgrid(np.arange(96) + 0.5, np.arange(64) + 0.5)
    found = undistort(lens, np.dstack([u, v]).astype(np.float32))  # a picture of where its pixels are
    k = np.array([[lens.fx, 0, lens.cx - 0.5], [0, lens.fy, lens.cy - 0.5], [0, 0, 1]])
    rays = straight.rays().reshape(-1, 1, 3)
    if lens.fisheye:
        truth, _ = cv2.fisheye.projectPoints(rays, np.zeros(3), np.zeros(3), k, np.array([*lens.radial, 0.0, 0.0]))
    else:
        bend = np.array([*lens.radial[:2], *lens.tangential, lens.radial[2]])
        truth, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), k, bend)
    assert np.abs(lens.project(rays) - truth - 0.5).max() < NEAR_PX
    truth = truth.reshape(64, 96, 2) + 0.5
    inner = (truth > 0.5).all(axis=-1) & (truth < (95.5, 63.5)).all(axis=-1)
    assert inner.mean() > 0.9
    # OpenCV interpolates on a grid of 1/32 pixel.
    assert np.abs(found - truth)[inner].max() < 1 / 32
    # Nothing comes from beyond the picture, and it is as wide as that allows: some border touches the edge.
    assert (truth >= -1e-9).all() and (truth <= (96, 64)).all()


Change = Callable[[Path], Any]
POSES, ANNOTS = "poses_bounds.npy", "annots.npy"
# Format -> writer, and the file that describes the set.
SETS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "transforms": (lambda folder: write_photos(folder, 2), "transforms.json"),
    "video": (write_rig, "calibration_opencv.json"),
    "dynerf": (lambda folder: sets.write_dynerf(folder, sets.rig(3)), POSES),
    "zju": (lambda folder: sets.write_zju(folder, sets.rig(3)), ANNOTS),
    "eyeful": (lambda folder: sets.write_eyeful(folder, sets.rig(3)), "cameras.json"),
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
        (in_frame(lambda f: f["transform_matrix"][0].__setitem__(3, np.inf)), "its numbers are not finite"),
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
        (lambda folder: (folder / "images-jpeg-2k").rename(folder / "images"), "has no folder images-jpeg-1k or"),
    ],
    "colmap text": [
        (replaced("sparse/0/cameras.txt", b"PINHOLE", b"OPENCV"), "OPENCV has 8 parameters, not 4"),
        (changed("sparse/0/images.txt", lambda d: d[:-1].rpartition(b"\n")[0]), "points is missing: cut"),
        (changed("sparse/0/images.txt", lambda d: d.replace(b"\n\n", b"\n")), "points is missing: cut"),
    ],
    "colmap": [
        (changed("sparse/0/images.bin", lambda d: d + b"more"), "4 bytes follow its last"),
        (changed("sparse/0/cameras.bin", lambda d: d[:12] + b"\x0a\0\0\0" + d[16:]), "model 10: expected one of"),
    ],
    "tum": [
        (written("rgb.txt", "nan rgb/1.png\n"), "rgb.txt: the time nan cannot be in seconds"),
        (written("depth.txt", "1305031102175304000 depth/1.png\n"), "depth.txt: the time 1.3.* cannot be in seconds"),
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
    assert (found.missing, whole_set.missing) == (1, 0) and len(found) == len(images) - 1 == len(whole_set) - 1
    assert f"1 of {len(images)} images are missing" in found.notes[0]
    assert not depths or [record.depth is None for record in found] == [True, False]
    for file in images[1:]:
        file.unlink()
    refused(DatasetError, f"{len(images)} of {len(images)} images are missing", load, name, folder)
