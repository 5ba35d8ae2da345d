"""``camera-node calibrate rig``: poses and lenses of cameras that stand still."""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path, PurePosixPath
from typing import Any

from camera_node.robot.calibration import CalibrationError, require_one_input

DESCRIPTION = """Estimates lenses and poses of cameras that stand still, from pictures of one target that somebody moves
about and holds still: ten to twenty times where at least two cameras see it, and, unless --lens gives the lenses, some
six times close before each camera, tilted, in the middle and all corners of its picture. The world's axes are the
target's at the first moment (--origin names another): lay it on the floor then.

input, one of:
  FOLDER             a folder of pictures a camera, cam00/0007.png: pictures of one moment have one name; or a video a
                     camera, cam00.mp4, all begun at the same instant
  --live SCENARIO    the scenario's cameras (kinds camera, oak, realsense), until --seconds or Ctrl-C
  --colmap MODEL     a COLMAP model that has images of the cameras, named like them (cam00.jpg or cam00/...), scaled by
                     --length: the distance between two of the cameras
"""

# Each input as its help names it, and option -> inputs that use it. With another input it is an error.
_INPUTS = {"folder": "FOLDER", "live": "--live SCENARIO", "colmap": "--colmap MODEL"}
_SEEN = ("folder", "live")
_GOES_WITH = {"board": _SEEN, "lens": _SEEN, "origin": _SEEN, "length": ("colmap",), "seconds": ("live",)}


def add_arguments(parser: argparse.ArgumentParser, board: str) -> None:
    """Fill in ``calibrate rig``. board: help of --board."""
    add = parser.add_argument
    add("folder", type=Path, nargs="?", metavar="FOLDER", help="pictures or videos by camera, see above")
    add("--live", metavar="SCENARIO", help="take the pictures with this scenario's cameras")
    add("--colmap", type=Path, metavar="MODEL", help="folder of a COLMAP model")
    add("--board", metavar="SPEC", help=board)
    add("--lens", type=Path, metavar="FILE", help="known intrinsics of all cameras, calibration JSON [estimated]")
    add("--origin", metavar="MOMENT", help="when the target lay at the world's origin: a picture's name [the first]")
    add("--length", nargs=3, metavar=("CAM", "CAM", "METERS"), help="with --colmap: distance of two cameras")
    add("--seconds", type=float, metavar="S", help="with --live: end after S seconds")
    add("--out", type=Path, metavar="FILE.json", help="file to write, for source.calibration of a scenario")
    add("--json", action="store_true", help="print the calibration as JSON, as --out writes it")


def run(args: argparse.Namespace) -> int:
    """Calibrate, print, write. Raises CalibrationError."""
    if require_one_input(args, _INPUTS, _GOES_WITH) == "colmap":
        if args.length is None:
            raise CalibrationError("--length CAM CAM METERS: a COLMAP model has no scale; measure between two lenses")
        show(args, *scaled_model(args.colmap, *args.length))
        return 0
    if args.seconds is not None and not args.seconds > 0:
        raise CalibrationError("--seconds: expected a positive number")
    if args.board is None:
        raise CalibrationError("--board SPEC: say what the target is")
    found = _from_target(args)
    show(args, found.show(), found.to_json())
    return 0


def scaled_model(folder: Path, first: str, second: str, meters: str) -> tuple[str, dict[str, Any]]:
    """Cameras of a COLMAP model in meters, in the model's axes: for people, and as a calibration file.

    first, second: cameras whose distance is ``meters``.
    An image belongs to the camera that its folder, else its file, is named after; the first one of a camera counts.
    Raises CalibrationError, and DatasetError where the model cannot be read.
    """
    from camera_node.sources.calibration_file import calibration_entry
    from camera_node.sources.datasets.colmap import load_dataset
    from camera_node.sources.datasets.records import PosedImage

    try:
        length = float(meters)
    except ValueError:
        length = math.nan
    if not 1e-3 <= length <= 1e4:
        raise CalibrationError(f"--length: expected meters, 0.001 to 10000, got {meters!r}")
    images: dict[str, PosedImage] = {}
    for image in load_dataset(folder):
        path = PurePosixPath(image.name)
        images.setdefault(path.parts[-2] if len(path.parts) > 1 else path.stem, image)
    for name in (first, second):
        if name not in images:
            raise CalibrationError(f"--length: the model has no camera {name}; it has {', '.join(list(images)[:8])}")
    if bent := [name for name, image in images.items() if image.path is None]:
        raise CalibrationError(
            f"{folder}: {bent[0]}: the model's pictures are straightened or turned when they are read, and a camera's "
            "are not: let COLMAP use the camera model OPENCV, with pictures as they are stored"
        )
    apart = math.dist(*(images[name].camera_to_world[:3, 3] for name in (first, second)))
    if not apart > 1e-9:
        raise CalibrationError(f"--length: {first} and {second} stand at one place in the model")
    poses = {name: image.camera_to_world.copy() for name, image in images.items()}
    for pose in poses.values():
        pose[:3, 3] *= length / apart
    lines = [f"{len(poses)} cameras; a unit of the model is {length / apart:.6g} m; world: the model's axes"]
    lines += ["{}: at {:.3f} {:.3f} {:.3f}".format(name, *pose[:3, 3]) for name, pose in poses.items()]
    return "\n".join(lines), {name: calibration_entry(images[name].intrinsics, poses[name]) for name in poses}


def show(args: argparse.Namespace, text: str, data: dict[str, Any]) -> None:
    """Print what was found as ``args`` say, and write ``data`` to --out. Raises CalibrationError."""
    # Print first: the result is not lost if the file cannot be written.
    print(json.dumps(data) if args.json else text, flush=True)
    if args.out is not None:
        from freshfield import files

        try:
            files.write_json(args.out, data, indent=1)
        except OSError as error:
            raise CalibrationError(f"--out: {args.out}: {error.strerror}") from None


def _from_target(args: argparse.Namespace) -> Any:
    from camera_node.robot.calibration.lens_calibration import calibrate_lens
    from camera_node.robot.calibration.rig import rig_inputs
    from camera_node.robot.calibration.rig.rig_calibration import calibrate_rig
    from camera_node.robot.calibration.targets import parse_target
    from camera_node.sources.calibration_file import load_calibration

    board = parse_target(args.board)
    if args.live is not None:
        cameras, close = rig_inputs.open_cameras(args.live)
        try:
            views = rig_inputs.watch(cameras, board, args.seconds, lambda line: print(line, file=sys.stderr))
        finally:
            close()
    else:
        views = rig_inputs.read_folder(args.folder, board)
    if args.lens is None:
        lenses = {}
        for camera, seen in views.corners.items():
            try:
                lenses[camera] = calibrate_lens(
                    seen, views.sizes.get(camera, (0, 0)), views.unused.get(camera, {})
                ).pinhole
            except CalibrationError as error:
                raise CalibrationError(f"{camera}: {error}; or give its intrinsics: --lens FILE") from None
    else:
        known = load_calibration(args.lens)
        if missing := [camera for camera in views.corners if camera not in known]:
            raise CalibrationError(f"--lens {args.lens}: has no {', '.join(missing)}")
        lenses = {camera: known[camera].intrinsics for camera in views.corners}
        for camera, lens in lenses.items():
            if (size := views.sizes.get(camera)) and size != (lens.width, lens.height):
                raise CalibrationError(
                    f"{camera}: pictures of {size[0]} x {size[1]}, but --lens is of {lens.width} x {lens.height}"
                )
    return calibrate_rig(views.corners, lenses, args.lens is None, args.origin)
