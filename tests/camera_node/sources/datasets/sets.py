"""Tiny data sets in the exact format of each kind, of a world of ours, so that the truth is known.

The writers share nothing with the loaders: conventions are spelt out here a second time.
"""

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from camera_node.synthetic import make_scene
from freshfield.geometry import Pinhole, matrix_to_quaternion

WIDTH, HEIGHT = 64, 48
# Points about the middle of the room, in the world's meters.
POINTS = np.random.default_rng(3).uniform([-0.6, -0.6, 0.3], [0.6, 0.6, 1.2], (200, 3))


@dataclass(frozen=True)
class Taken:
    """One camera of the truth: where it stands and what it shows at instant k (a tenth of a second each)."""

    name: str
    lens: Pinhole
    camera_to_world: np.ndarray
    shows: Callable[[int], np.ndarray]

    @property
    def world_to_camera(self) -> np.ndarray:
        return np.linalg.inv(self.camera_to_world)

    @property
    def k(self) -> np.ndarray:
        """OpenCV's: pixel centers are whole numbers."""
        lens = self.lens
        return np.array([[lens.fx, 0, lens.cx - 0.5], [0, lens.fy, lens.cy - 0.5], [0, 0, 1]])

    def pixels(self) -> np.ndarray:
        """Where OpenCV sees POINTS, corner origin."""
        m, bend = self.world_to_camera, np.array(self.lens.distortion)
        found, _ = cv2.projectPoints(POINTS, cv2.Rodrigues(m[:3, :3])[0], m[:3, 3], self.k, bend)
        return found[:, 0] + 0.5


def rig(count: int = 3, lens: Pinhole | None = None) -> list[Taken]:
    """Cameras of the room, each with ``lens`` if one is given."""
    scene = make_scene("room", {"count": count, "width": WIDTH, "height": HEIGHT})
    if lens is not None:
        scene = replace(scene, cameras={name: (lens, pose) for name, (_, pose) in scene.cameras.items()})
    return [
        Taken(name, used, pose, lambda k, name=name: scene.render(name, k / 10))
        for name, (used, pose) in scene.cameras.items()
    ]


def write_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image, [cv2.IMWRITE_JPEG_QUALITY, 98])


def write_dynerf(folder: Path, cameras: list[Taken], frames: int = 6, written_at: float = 1.0) -> Path:
    """written_at: the file's sizes and focal lengths are of images so many times larger than the videos."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for camera in cameras:
        file = str(folder / f"{camera.name}.mp4")
        video = cv2.VideoWriter(file, cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (WIDTH, HEIGHT))
        for k in range(frames):
            video.write(camera.shows(k)[..., ::-1])
        video.release()
        right, down, forward, position = camera.camera_to_world[:3].T
        hwf = written_at * np.array([HEIGHT, WIDTH, camera.lens.fx])
        matrix = np.stack([down, right, -forward, position, hwf], axis=1)
        rows.append([*matrix.ravel(), 0.5, 9.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def write_zju(folder: Path, cameras: list[Taken], frames: int = 4, k3: float = 0.0) -> Path:
    cams: dict[str, list] = {key: [] for key in "KDRT"}
    for number, camera in enumerate(cameras):
        for k in range(frames):
            write_image(folder / f"Camera_B{number + 1}/{k:06d}.jpg", camera.shows(k))
            mask = np.zeros((HEIGHT, WIDTH), np.uint8)
            mask[8:40, 16:48] = 1 + number  # labels, as a parser of people writes them
            write_image(folder / f"mask_cihp/Camera_B{number + 1}/{k:06d}.png", mask)
        m = camera.world_to_camera
        cams["K"].append(camera.k)
        cams["D"].append(np.array([*camera.lens.distortion, k3])[:, None])
        cams["R"].append(m[:3, :3])
        cams["T"].append(1000.0 * m[:3, 3:])
    names = [f"Camera_B{number + 1}" for number in range(len(cameras))]
    ims = [{"ims": [f"{name}/{k:06d}.jpg" for name in names], "kpts2d": np.zeros((2, 3))} for k in range(frames)]
    np.save(folder / "annots.npy", {"cams": cams, "ims": ims}, allow_pickle=True)  # type: ignore[arg-type]
    return folder


def write_eyeful(
    folder: Path, cameras: list[Taken], positions: int = 2, model: str = "RadialAndTangential", distortion: Any = None
) -> Path:
    """The JSON describes images four times larger than those in images-jpeg-2k, of a world whose y points up: its x is
    our y, its y our z, its z our x."""
    turn, full = np.array([[0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]]), 4
    bend = distortion or [*cameras[0].lens.distortion, 0.0]
    krt, splits = [], {"train": [], "test": []}  # type: ignore[var-annotated]
    for number, camera in enumerate(cameras):
        for k in range(positions):
            name = f"{10 + number}/{10 + number}_DSC{k:04d}"
            write_image(folder / f"images-jpeg-2k/{name}.jpg", camera.shows(k))
            splits["test" if number == 0 else "train"].append(name)
            lens = camera.lens
            K = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1 / full]]) * full
            entry = {"width": WIDTH * full, "height": HEIGHT * full, "cameraId": name, "frameId": k, "sensorId": number}
            entry |= {"K": K.T.tolist(), "T": np.linalg.inv(turn @ camera.camera_to_world).T.tolist()}
            krt.append(entry | {"distortionModel": model, "distortion": bend})
    (folder / "cameras.json").write_text(json.dumps({"KRT": krt}))
    (folder / "splits.json").write_text(json.dumps(splits))
    return folder


# COLMAP's number of a model and its parameters of a camera; each bends as much as the model can.
COLMAP_MODELS = {
    "SIMPLE_PINHOLE": (0, lambda l: [l.fx, l.cx, l.cy]),
    "PINHOLE": (1, lambda l: [l.fx, l.fy, l.cx, l.cy]),
    "SIMPLE_RADIAL": (2, lambda l: [l.fx, l.cx, l.cy, l.distortion[0]]),
    "RADIAL": (3, lambda l: [l.fx, l.cx, l.cy, *l.distortion[:2]]),
    "OPENCV": (4, lambda l: [l.fx, l.fy, l.cx, l.cy, *l.distortion]),
    "OPENCV_FISHEYE": (5, lambda l: [l.fx, l.fy, l.cx, l.cy, -0.02, 0.004, 0.0, 0.0]),
    "SIMPLE_RADIAL_FISHEYE": (8, lambda l: [l.fx, l.cx, l.cy, -0.02]),
    "RADIAL_FISHEYE": (9, lambda l: [l.fx, l.cx, l.cy, -0.02, 0.004]),
}


def write_colmap(folder: Path, cameras: list[Taken], model: str, binary: bool, place: str = "sparse/0") -> Path:
    """One image a camera, its name with a blank as COLMAP allows; points only where the images see them."""
    where = folder / place
    where.mkdir(parents=True, exist_ok=True)
    number, params = COLMAP_MODELS[model]
    rows = []
    for k, camera in enumerate(cameras):
        name = f"{camera.name} x.jpg"
        write_image(folder / "images" / name, camera.shows(0))
        m = camera.world_to_camera
        rows.append((k + 1, [*matrix_to_quaternion(m[:3, :3]), *m[:3, 3]], name, camera))
    if binary:
        out = struct.pack("<Q", len(rows))
        for k, _, _, camera in rows:
            p = params(camera.lens)
            out += struct.pack("<iiQQ", k, number, WIDTH, HEIGHT) + struct.pack(f"<{len(p)}d", *p)
        (where / "cameras.bin").write_bytes(out)
        out = struct.pack("<Q", len(rows))
        for k, pose, name, _ in rows:
            out += struct.pack("<I7dI", k, *pose, k) + name.encode() + b"\0"
            out += struct.pack("<Q", 2) + struct.pack("<ddqddq", 1.0, 2.0, 7, 3.0, 4.0, -1)
        (where / "images.bin").write_bytes(out)
        (where / "points3D.bin").write_bytes(struct.pack("<Q", 0))
    else:
        text = "# Camera list with one line of data per camera:\n"
        for k, _, _, camera in rows:
            text += f"{k} {model} {WIDTH} {HEIGHT} {' '.join(map(repr, map(float, params(camera.lens))))}\n"
        (where / "cameras.txt").write_text(text)
        text = "# Image list with two lines of data per image:\n"
        for k, pose, name, _ in rows:
            seen = "1.0 2.0 7 3.0 4.0 -1" if k % 2 else ""  # an image may see no point
            text += f"{k} {' '.join(map(repr, map(float, pose)))} {k} {name}\n{seen}\n"
        (where / "images.txt").write_text(text)
        (where / "points3D.txt").write_text("# 3D point list\n")
    return folder
