"""Input of a calibration: images with a target, ViSP's folders, lenses."""

from __future__ import annotations

import re
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.calibration_constants import EXPLAINED
from camera_node.robot.calibration.hand_eye.samples import Array, Samples
from camera_node.robot.calibration.targets import WHICH_PRINT, Corners, Target, estimate_pose
from camera_node.sources.calibration_file import load_calibration
from camera_node.sources.datasets.image_reading import decode_file
from freshfield.geometry import Pinhole, se3, so3_exp
from freshfield.untrusted import read_text, read_yaml

IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")


def read_visp_pose(file: Path) -> Array:
    """Pose (4, 4) from ViSP's YAML: rows 6, cols 1, data [tx ty tz, theta u] in meters and radians. Raises
    CalibrationError."""
    try:
        values = np.array(read_yaml(read_text(file))["data"], dtype=np.float64).ravel()
        if values.shape != (6,) or not np.isfinite(values).all():
            raise ValueError(f"{values.size} numbers")
    except (OSError, KeyError, TypeError, ValueError, OverflowError) as error:
        why = " ".join(str(error).split())
        raise CalibrationError(f"{file}: expected ViSP's YAML of a pose, data: tx ty tz and theta u: {why}") from None
    return se3(so3_exp(values[3:]), values[:3])


def read_lens(file: Path) -> Pinhole:
    """Read a lens from a calibration JSON of one camera (``camera-node calibrate intrinsics``) or from ViSP's
    camera XML. Raises DatasetError and CalibrationError."""
    if file.suffix.lower() != ".xml":
        cameras = load_calibration(file)
        if len(cameras) != 1:
            raise CalibrationError(f"{file}: has {len(cameras)} cameras, expected one")
        return next(iter(cameras.values())).intrinsics
    try:
        camera = ElementTree.parse(file).find(".//camera")
        if camera is None:
            raise ValueError("no camera")
        kinds = ("perspectiveProjWithDistortion", "perspectiveProjWithoutDistortion")
        model = next(each for kind in kinds for each in camera.iterfind(f"model[type='{kind}']"))
        numbers = {key: float(model.findtext(key, "missing")) for key in ("px", "py", "u0", "v0")}
        width, height = (int(camera.findtext(key, "0")) for key in ("image_width", "image_height"))
        center = numbers["u0"] + 0.5, numbers["v0"] + 0.5
        distortion = float(model.findtext("kud", "0")), 0.0, 0.0, 0.0
        return Pinhole(width, height, numbers["px"], numbers["py"], *center, distortion)
    except (OSError, ElementTree.ParseError, StopIteration, ValueError) as error:
        raise CalibrationError(
            f"{file}: expected ViSP's camera XML with px, py, u0, v0: {error or 'no model known'}"
        ) from None


def list_images(folder: Path) -> list[Path]:
    """Image files in the order of the numbers in their names. Raises CalibrationError if there are none."""
    if not folder.is_dir():
        raise CalibrationError(f"{folder}: no such folder")
    found = [f for f in folder.iterdir() if f.suffix.lower() in IMAGES]
    if not found:
        raise CalibrationError(f"{folder}: has no pictures ({', '.join(IMAGES)})")
    return sorted(found, key=lambda f: (_number(f) is None, _number(f) or 0, f.name))


def find_corners(
    files: Sequence[Path], target: Target, size: tuple[int, int] | None = None
) -> tuple[dict[str, Corners], dict[str, str], tuple[int, int]]:
    """Find the target in images.

    size: width and height of every image in pixels; None: those of the first one.
    Returns the corners by image name, the reason for every image without them, and the size. Raises
    CalibrationError.
    """
    found: dict[str, Corners] = {}
    unused: dict[str, str] = {}
    grays: dict[str, NDArray[np.uint8]] = {}
    for k, file in enumerate(files):
        # As stored, whatever EXIF says of its orientation: what streams pictures ignores it, too.
        image = decode_file(file, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        if image is None:
            raise CalibrationError(f"{file}: cannot be read as a picture, or is larger than OpenCV's limit")
        height, width = image.shape
        size = size or (width, height)
        if (width, height) != size:
            raise CalibrationError(f"{file}: is {width} x {height}, expected {size[0]} x {size[1]}")
        grays[file.name] = np.asarray(image, dtype=np.uint8)
        target.find(grays[file.name])  # which of two prints it is, all pictures together tell
        show_progress(f"{k + 1} pictures")
    for name, gray in grays.items():
        corners = target.find(gray)
        if corners is None:
            why = target.explain(gray) if len(unused) < EXPLAINED else ""
            unused[name] = f"{target.name} not found{why and f': {why}'}"
        elif not target.decided():
            unused[name] = WHICH_PRINT
        else:
            found[name] = corners
    return found, unused, size or (0, 0)


def show_progress(done: str) -> None:
    """Say on a terminal how far it is."""
    if sys.stderr.isatty():
        print(f"\r{done} ", end="", file=sys.stderr, flush=True)


def read_visp_folder(folder: Path, target: Target, lens: Pinhole | None, setup: str) -> tuple[Samples, dict[str, str]]:
    """Samples from images ``*-N.png`` with poses ``*_N.yaml`` of the flange, matched by number.

    lens: None reads the folder's XML file.
    Returns the reason for every unused image too, by name. Raises CalibrationError.
    """
    if lens is None:
        lenses = sorted(folder.glob("*.xml"))
        if len(lenses) != 1:
            raise CalibrationError(f"{folder}: has {len(lenses)} camera XML files; name the lens: --lens FILE")
        lens = read_lens(lenses[0])
    files = list_images(folder)
    poses = {_number(f): f for f in folder.glob("*.yaml") if _number(f) is not None}
    paired = [f for f in files if _number(f) in poses]
    if not paired:
        raise CalibrationError(f"{folder}: no picture has a pose file of its number (NAME_3.yaml, NAME-3.png)")
    found, unused, _ = find_corners(paired, target, (lens.width, lens.height))
    unused |= {f.name: "no pose file of its number" for f in files if _number(f) not in poses}
    seen: dict[str, Array] = {}
    for name, corners in found.items():
        try:
            seen[name] = estimate_pose(corners, lens)
        except CalibrationError as error:
            unused[name] = str(error)
    flanges = [read_visp_pose(poses[_number(f)]) for f in paired if f.name in seen]
    targets = list(seen.values())
    return Samples(np.reshape(flanges, (-1, 4, 4)), np.reshape(targets, (-1, 4, 4)), setup, tuple(seen)), unused


def _number(file: Path) -> int | None:
    match = re.search(r"(\d+)$", file.stem)
    return int(match.group(1)) if match else None
