"""Every data set's loader against a set in its exact format, and those that the edge exports: conventions by
reprojection, damage by name."""

import pickle
import subprocess
import sys

import cv2
import numpy as np
import pytest

from camera_node.settings import source_config
from camera_node.sources.datasets import dynerf, eyeful, zju
from camera_node.sources.datasets.formats import FORMATS, open_dataset
from camera_node.sources.datasets.lens import Lens, exact, pinhole, undistort
from camera_node.sources.datasets.photo import FULL_SIZE
from camera_node.sources.registry import open_sources
from edge_server.export import PosedImage
from edge_server.export.colmap import Cloud, write_model
from edge_server.export.images import write_images
from edge_server.export.transforms import write_transforms
from freshfield.geometry import Pinhole, se3_inverse
from freshfield.scenario import parse
from tests.camera_node.sources.datasets import sets
from tests.camera_node.sources.datasets.photos import fails

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
    fails("references stand for more", zju.load_dataset, tmp_path)


def test_eyeful_sees_points_where_they_are_and_straightens_lenses_that_are_none_of_ours(tmp_path):
    cameras = sets.rig(3, BENT)
    dataset = eyeful.load_dataset(sets.write_eyeful(tmp_path, cameras))
    assert dataset.cameras == ("10", "11", "12") and not dataset.moving
    agree([dataset.of(name)[0] for name in dataset.cameras], cameras)
    assert dataset.held_out == {"10/10_DSC0000", "10/10_DSC0001"}
    for number, (model, distortion, bends) in enumerate(
        (
            (
                "RadialAndTangential",
                [0.1, 0.2, 3e-3, 4e-3, 0.5],
                {"radial": (0.1, 0.2, 0.5), "tangential": (3e-3, 4e-3)},
            ),
            ("Fisheye", [-0.02, 4e-3, 0, 0, 0, 0, 0, 0], {"radial": (-0.02, 4e-3, 0.0), "fisheye": True}),
        )
    ):
        record = eyeful.load_dataset(sets.write_eyeful(tmp_path / str(number), cameras, 1, model, distortion))[1]
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


@pytest.mark.parametrize("form", ["colmap", "transforms"])
def test_what_the_edge_exports_reads_back_to_the_pixel(tmp_path, form):
    """One picture a camera, half of the lenses bent."""
    straight, bent = sets.rig(3), sets.rig(3, BENT)
    cameras = [straight[0], bent[1], straight[2], bent[0]]
    shots = [PosedImage(f"view{k}.png", c.shows(0), c.camera_to_world, c.lens) for k, c in enumerate(cameras)]
    write_images(tmp_path / "images", shots)
    if form == "transforms":
        write_transforms(tmp_path, shots)
    else:
        cloud = Cloud(sets.POINTS, np.zeros((200, 3), np.uint8), np.ones((200, len(shots)), np.bool_))
        write_model(tmp_path / "sparse/0", shots, cloud)
    _, dataset = open_dataset(tmp_path)
    for shot, record in zip(shots, dataset, strict=True):
        assert record.intrinsics == shot.intrinsics
        there, back = (seen(each.camera_to_world, each.intrinsics) for each in (shot, record))
        assert np.abs(there - back).max() < NEAR_PX
        np.testing.assert_array_equal(record.read(), shot.image)


WRITERS = {
    "dynerf": sets.write_dynerf,
    "zju": sets.write_zju,
    "eyeful": sets.write_eyeful,
    "colmap": lambda folder, cameras: sets.write_colmap(folder, cameras, "PINHOLE", True),
}


@pytest.mark.parametrize("name", list(WRITERS))
def test_formats_are_recognized_and_streamed_at_their_pace(tmp_path, name):
    cameras = sets.rig(3)
    folder = WRITERS[name](tmp_path / "set", cameras)
    _, dataset = open_dataset(folder)
    for other in set(FORMATS) - {name}:
        fails("holds no data set of the format", open_dataset, folder, 1.0, other)
    ids = list(dataset.cameras) if name != "colmap" else ["a", "b", "c"]
    scenario = parse({"cameras": {"ids": ids}, "source": {"kind": name, "data": "set"}}, tmp_path / "s.yaml")
    sources = open_sources(scenario, source_config(scenario), ids, tmp_path)
    assert {float(sources[c].fps) for c in ids} == {50.0 if name == "zju" else 10.0}
    for camera, truth in zip(ids, cameras):
        shot = sources[camera].read(sources[camera].content(0))
        np.testing.assert_allclose(shot.pose.matrix(), truth.camera_to_world, atol=1e-9)
        assert isinstance(shot.image, bytes) == (name != "dynerf"), "what is a JPEG already is sent as it is"


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
