"""Read calibration input: ViSP's folders, pose pairs as JSON, time-stamped poses as CSV."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from camera_node.pose.pairing import PairingCounts, sort_samples
from camera_node.pose.providers import TrajectoryError, read_samples
from camera_node.robot.arm.hand_eye_mount import rigid_transform
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.hand_eye.samples import Array, Samples
from camera_node.robot.calibration.targets import Target, TargetPose, estimate_pose, to_gray
from camera_node.sources.datasets.records import DatasetError
from camera_node.sources.rig_calibration import load_calibration
from freshfield.geometry import Pinhole, so3_exp

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
# Lower bound in pixels, so that perfect (rendered) images do not make a corner exact.
_MIN_PIXEL_NOISE = 0.02


@dataclass(frozen=True)
class Track:
    """A stream of poses. times_ns: (N,) increasing. poses: (N, 4, 4). counts: stamps sorted or dropped."""

    times_ns: NDArray[np.int64]
    poses: Array
    counts: PairingCounts


def read_pairs(file: Path, setup: str) -> Samples:
    """A JSON list of [end-effector in base, target in camera], each 4 x 4. Raises CalibrationError."""
    try:
        data = json.loads(file.read_text())
    except OSError as error:
        raise CalibrationError(f"{file}: cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise CalibrationError(f"{file}: cannot be read as JSON: {error}") from None
    if not isinstance(data, list):
        raise CalibrationError(f"{file}: expected a list of pairs of 4 x 4 matrices")
    hands, targets = [], []
    for k, pair in enumerate(data):
        try:
            hand, target = pair
            hands.append(rigid_transform(hand))
            targets.append(rigid_transform(target))
        except (ValueError, TypeError) as error:
            raise CalibrationError(
                f"{file}: pair {k + 1}: expected [hand in base, target in camera]: {error}"
            ) from None
    return Samples(_stacked(hands), _stacked(targets), setup)


def pairs_json(samples: Samples) -> list[list[list[list[float]]]]:
    """The JSON that ``read_pairs`` reads."""
    return [[h.tolist(), t.tolist()] for h, t in zip(samples.hand, samples.target)]


def read_track(file: Path) -> Track:
    """Poses ``t,x,y,z,qx,qy,qz,qw`` (seconds, metres), header optional, sorted by stamp where
    needed. Raises CalibrationError."""
    try:
        times, poses = read_samples(file)
    except TrajectoryError as error:
        raise CalibrationError(str(error)) from None
    times, poses, counts = sort_samples(times, poses)
    if len(times) < 2:
        raise CalibrationError(f"{file}: {len(times)} poses; a moving hand needs many")
    return Track(np.array(times, dtype=np.int64), np.array([p.matrix() for p in poses]), counts)


def read_visp_pose(file: Path) -> Array:
    """(4, 4) of ViSP's YAML: rows 6, cols 1, data [tx ty tz, theta u] in metres and radians."""
    try:
        data = yaml.safe_load(file.read_text())
        values = np.array(data["data"], dtype=np.float64).ravel()
        if values.shape != (6,) or not np.isfinite(values).all():
            raise ValueError(f"{values.size} numbers")
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        why = " ".join(str(error).split())
        raise CalibrationError(
            f"{file}: expected ViSP's YAML of a pose, data: tx ty tz and theta u: {why}"
        ) from None
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = so3_exp(values[3:]), values[:3]
    return out


def read_lens(file: Path) -> Pinhole:
    """A lens from a calibration JSON of one camera (``camera-node calibrate intrinsics``) or ViSP's camera
    XML. Raises CalibrationError."""
    if file.suffix.lower() != ".xml":
        try:
            cameras = load_calibration(file)
        except DatasetError as error:
            raise CalibrationError(str(error)) from None
        if len(cameras) != 1:
            raise CalibrationError(f"{file}: has {len(cameras)} cameras, expected one")
        return next(iter(cameras.values())).intrinsics
    try:
        camera = ElementTree.parse(file).getroot().find(".//camera")
        if camera is None:
            raise ValueError("no camera")
        models = {(m.findtext("type") or "").strip(): m for m in camera.iter("model")}
        name = next(n for n in ("perspectiveProjWithDistortion", "perspectiveProjWithoutDistortion")
                    if n in models)  # fmt: skip

        def number(key: str, default: str | None = None) -> float:
            return float(models[name].findtext(key) or default or "missing")

        return Pinhole(
            int(camera.findtext("image_width") or 0), int(camera.findtext("image_height") or 0),
            number("px"), number("py"), number("u0") + 0.5, number("v0") + 0.5,
            (number("kud", "0"), 0.0, 0.0, 0.0),
        )  # fmt: skip
    except (OSError, ElementTree.ParseError, StopIteration, ValueError) as error:
        raise CalibrationError(
            f"{file}: expected ViSP's camera XML with px, py, u0, v0: {error or 'no model known'}"
        ) from None


@dataclass(frozen=True)
class Detections:
    """seen: target poses by image name. unused: the reason, by name, for every other image."""

    seen: dict[str, TargetPose]
    unused: dict[str, str]


def read_gray_image(file: Path) -> np.ndarray:
    """Gray (H, W). Raises CalibrationError."""
    picture = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise CalibrationError(f"{file}: cannot be read as a picture")
    return np.asarray(picture, dtype=np.uint8)


def list_images(folder: Path) -> list[Path]:
    """Image files in the order of the numbers in their names. Raises CalibrationError if there are none."""
    if not folder.is_dir():
        raise CalibrationError(f"{folder}: no such folder")
    found = [f for f in folder.iterdir() if f.suffix.lower() in PICTURES]
    if not found:
        raise CalibrationError(f"{folder}: has no pictures ({', '.join(PICTURES)})")
    return sorted(found, key=lambda f: (_number(f) is None, _number(f) or 0, f.name))


def detect_target(
    files: Sequence[Path], target: Target, lens: Pinhole, progress: Callable[[int], None] = lambda done: None
) -> Detections:
    """Find the target in images taken through ``lens``. Raises CalibrationError if a size differs from it."""
    seen: dict[str, TargetPose] = {}
    unused: dict[str, str] = {}
    for k, file in enumerate(files):
        picture = to_gray(read_gray_image(file))
        if picture.shape != (lens.height, lens.width):
            raise CalibrationError(
                f"{file}: is {picture.shape[1]} x {picture.shape[0]}, the lens was calibrated at "
                f"{lens.width} x {lens.height}"
            )
        corners = target.find(picture)
        if corners is None:
            unused[file.name] = f"{target.name} not found"
        else:
            try:
                seen[file.name] = estimate_pose(corners, lens)
            except CalibrationError as error:
                unused[file.name] = str(error)
        progress(k + 1)
    return Detections(seen, unused)


def pixel_noise(seen: Sequence[TargetPose]) -> float:
    """Standard deviation (pixels) of a corner coordinate from all reprojections, less six degrees of freedom
    an image."""
    squares = sum(s.error_px**2 * len(s.corners.points) for s in seen)
    freedom = sum(2 * len(s.corners.points) - 6 for s in seen)
    return max(float(np.sqrt(squares / max(freedom, 1))), _MIN_PIXEL_NOISE)


def to_samples(
    seen: Sequence[TargetPose], hands: Sequence[Array], names: Sequence[str], setup: str
) -> Samples:
    """Samples with the target's covariance from its corners' noise."""
    noise = pixel_noise(seen)
    return Samples(
        _stacked(list(hands)), _stacked([s.pose for s in seen]), setup,
        np.array([s.unit_covariance * noise**2 for s in seen]).reshape(-1, 6, 6), tuple(names),
    )  # fmt: skip


def read_visp_folder(
    folder: Path,
    target: Target,
    lens: Pinhole | None,
    setup: str,
    progress: Callable[[int], None] = lambda done: None,
) -> tuple[Samples, Detections]:
    """Pictures ``*-N.png`` with poses ``*_N.yaml`` of the hand, matched by number; without ``lens``,
    the folder's XML is read. Raises CalibrationError."""
    if lens is None:
        lenses = sorted(folder.glob("*.xml"))
        if len(lenses) != 1:
            raise CalibrationError(
                f"{folder}: has {len(lenses)} camera XML files; name the lens: --lens FILE"
            )
        lens = read_lens(lenses[0])
    files = list_images(folder)
    poses = {_number(f): f for f in folder.glob("*.yaml") if _number(f) is not None}
    paired = [f for f in files if _number(f) in poses]
    if not paired:
        raise CalibrationError(
            f"{folder}: no picture has a pose file of its number (NAME_3.yaml, NAME-3.png)"
        )
    found = detect_target(paired, target, lens, progress)
    unused = {f.name: "no pose file of its number" for f in files if _number(f) not in poses}
    found = Detections(found.seen, {**found.unused, **unused})
    used = [f for f in paired if f.name in found.seen]
    hands = [read_visp_pose(poses[_number(f)]) for f in used]
    names = [f.name for f in used]
    return to_samples([found.seen[n] for n in names], hands, names, setup), found


def _number(file: Path) -> int | None:
    match = re.search(r"(\d+)$", file.stem)
    return int(match.group(1)) if match else None


def _stacked(matrices: list[Array]) -> Array:
    return np.array(matrices, dtype=np.float64).reshape(-1, 4, 4)
