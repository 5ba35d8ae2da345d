"""ZJU-MoCap: ``annots.npy`` and a folder of JPEG files a camera, as in Neural Body's version of the data.

    annots.npy  {"cams": {"K": [3 x 3, ...], "D": [5, ...], "R": [3 x 3, ...], "T": [3, ...]},
                 "ims": [{"ims": ["Camera_B1/000000.jpg", ...]}, ...]}

The lists of ``cams`` have one entry a camera, ``ims`` one an instant, with paths in the cameras' order. ``R``
and ``T`` take world points to OpenCV camera axes; ``T`` is in millimeters. In ``K`` pixel centers are whole
numbers, so 0.5 is added here; ``D`` is OpenCV's k1 k2 p1 p2 k3. Masks are PNG files named like the images, in
folders of their own (``mask``, ``mask_cihp``).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from camera_node.settings import ZJU_FPS
from camera_node.sources.datasets.image_reading import image_size
from camera_node.sources.datasets.lens import Lens
from camera_node.sources.datasets.npy import load_object
from camera_node.sources.datasets.photo import FULL_SIZE, ImageFiles, ImageOptions
from camera_node.sources.datasets.records import (
    Dataset,
    DatasetError,
    camera_to_world,
    errors_at,
    file_within,
    path_within,
)

ANNOTATIONS = "annots.npy"
FILES = (ANNOTATIONS,)
_MM = 1e-3


def load_dataset(
    path: Path, options: ImageOptions = FULL_SIZE, masks: str | None = None, recorded_fps: float = ZJU_FPS
) -> Dataset:
    """The images of all cameras, at instants 1 / ``recorded_fps`` apart; those without a file are counted as
    missing.

    path: the folder, or its ``annots.npy``.
    masks: name of a folder of masks, beside those of the cameras, that cut out the person; None: no masks.
    Raises DatasetError.
    """
    file = path if path.is_file() else path / ANNOTATIONS
    annotations = load_object(file)
    try:
        cams, instants = annotations["cams"], [list(instant["ims"]) for instant in annotations["ims"]]
        numbers = {key: [np.asarray(v, dtype=np.float64) for v in cams[key]] for key in "KDRT"}
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        raise DatasetError(f"{file}: expected 'cams' with K, D, R, T and 'ims': {error!r} is wrong") from None
    count = len(numbers["K"])
    counts = {key: len(values) for key, values in numbers.items()} | {
        f"ims[{k}]": len(names) for k, names in enumerate(instants) if len(names) != count
    }
    if count < 1 or not instants or set(counts.values()) != {count}:
        listed = ", ".join(f"{key} {n}" for key, n in list(counts.items())[:6])
        raise DatasetError(f"{file}: the numbers of cameras differ: {listed}")
    folder = file.parent
    if masks is not None and not (folder / masks).is_dir():
        raise DatasetError(f"{folder / masks}: no such folder of masks")
    found = ImageFiles(folder, options, str(file))
    for index in range(count):
        lens: Lens | None = None
        where = f"{file}: camera {index}"
        pose = _pose(numbers["R"][index], numbers["T"][index], where)
        names = [_path(instant[index], where) for instant in instants]
        camera = names[0].parent.name
        for k, name in enumerate(names):
            picture, mask = found.path(str(name), where), None
            if picture is None:
                continue
            if lens is None:  # the annotations do not have the images' size, so the first image tells it
                lens = _lens(numbers["K"][index], numbers["D"][index], *image_size(picture), where)
            if masks is not None:
                with errors_at(where):
                    mask = file_within(folder / masks, str(name.with_suffix(".png")))
                if mask is None:
                    raise DatasetError(f"{(folder / masks / name).with_suffix('.png')}: missing, the mask of {name}")
            time_s = k / recorded_fps
            found.add(f"{camera}/{k:06d}", picture, lens, pose, where, camera=camera, time_s=time_s, mask=mask)
    return found.dataset(recorded_fps)


def _path(name: Any, where: str) -> Path:
    with errors_at(where):
        path = path_within(str(name))
    if len(path.parts) < 2:
        raise DatasetError(f"{where}: {str(name)[:200]!r} is no path of an image in a camera's folder")
    return path


def _pose(rotation: np.ndarray, translation: np.ndarray, where: str) -> np.ndarray:
    if rotation.shape != (3, 3) or translation.size != 3:
        raise DatasetError(f"{where}: R and T are {rotation.shape} and {translation.shape}, expected 3 x 3 and 3")
    return camera_to_world(rotation, translation.ravel() * _MM)


def _lens(k: np.ndarray, distortion: np.ndarray, width: int, height: int, where: str) -> Lens:
    d = np.zeros(5)
    if k.shape != (3, 3) or distortion.size not in (0, 4, 5):
        raise DatasetError(f"{where}: K and D are {k.shape} and {distortion.shape}, expected 3 x 3 and 5")
    if abs(k[0, 1]) > 1e-6 * abs(k[0, 0]):
        raise DatasetError(f"{where}: K has skew, which no camera here has")
    d[: distortion.size] = distortion.ravel()
    with errors_at(where):
        return Lens(
            width,
            height,
            float(k[0, 0]),
            float(k[1, 1]),
            float(k[0, 2]) + 0.5,
            float(k[1, 2]) + 0.5,
            (float(d[0]), float(d[1]), float(d[4])),
            (float(d[2]), float(d[3])),
        )
