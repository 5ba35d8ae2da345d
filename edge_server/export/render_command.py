"""``edge-server render``: images and videos of a run's field from any viewpoint."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from edge_server.command import command_parser, exit_status
from edge_server.export import ExportError
from edge_server.export import export_constants as tuned
from edge_server.export.camera_paths import Step, lens, looking, orbit, read_nerfstudio, vertical_fov_deg
from edge_server.export.images_and_video import IMAGE_ENDINGS, Image, checked_file, write_video
from edge_server.export.run_source import Source, open_source
from edge_server.export.viewed_field import checked_size
from edge_server.fidelity.images import to_bytes
from edge_server.fields import Rendering
from edge_server.progress import ProgressLine
from freshfield.files import out_file

DESCRIPTION = """\
Renders the field of a run or fit from new viewpoints. RUN is its folder, or a checkpoint in it.

  edge-server render runs/demo --orbit orbit.mp4                     round what the cameras look at
  edge-server render runs/demo --camera cam03 cam03.png              as one of its cameras sees it
  edge-server render runs/demo --pose 2 -1 1.5 0 0 1 view.png        from (2, -1, 1.5), looking at (0, 0, 1), meters
  edge-server render runs/fit --path camera_path.json flight.mp4     a path saved by nerfstudio's viewer
  edge-server render runs/demo --orbit depth.mp4 --depth
  edge-server render runs/a --beside runs/b --orbit both.mp4         the same path through both

Files end in .png or .jpg (the first image of a path), or in .mp4.
"""


def main(argv: Sequence[str] | None = None, prog: str = "edge-server render") -> int:
    """Run the command; returns its exit status. prog: its name in usage and errors."""
    args = _parser(prog).parse_args(argv)
    return exit_status(prog, lambda: _render(args), ExportError)


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = command_parser(prog, DESCRIPTION.replace("edge-server render", prog))
    add = parser.add_argument
    add("run", type=Path, metavar="RUN", help="folder of a run or fit (its --out), or a checkpoint")
    which = parser.add_mutually_exclusive_group(required=True).add_argument
    which("--orbit", action="store_true", help="round what the cameras look at, where they stand")
    which("--pose", type=float, nargs=6, metavar=("X", "Y", "Z", "AT_X", "AT_Y", "AT_Z"), help="one viewpoint, z up")
    which("--camera", metavar="ID", help="the viewpoint and lens of one of the run's cameras")
    which("--path", type=Path, metavar="FILE", help="nerfstudio's camera_path.json, in the run's world")
    add("file", type=out_file, metavar="FILE", help="image or video to write")
    add("--beside", type=Path, metavar="RUN", help="another run, rendered to the right")
    add(
        "--allow-plugins", action="store_true", help="run code from outside that the run's field names, if you trust it"
    )
    add("--depth", action="store_true", help="depth instead of color: near red, far blue, one scale for the whole path")
    add("--size", metavar="WxH", help="pixels [the cameras' shape, 480 high; a path's own]")
    add("--fov", type=float, metavar="DEG", help="vertical field of view [the cameras'; a path's own]")
    add("--seconds", type=float, default=8.0, metavar="S", help="length of an orbit [%(default)g]")
    add("--fps", type=float, metavar="N", help=f"images a second [{tuned.RENDERED_FPS:g}; a path's own]")
    return parser


def _render(args: argparse.Namespace) -> None:
    checked_file(args.file)
    for option, value, lowest, highest in (
        ("seconds", args.seconds, 0.1, 600.0),
        ("fps", args.fps, 0.1, 240.0),
        ("fov", args.fov, 1.0, 170.0),
    ):
        if value is not None and not lowest <= value <= highest:
            raise ExportError(f"--{option} {value:g}: expected {lowest:g} to {highest:g}")
    sources = [open_source(run, args.allow_plugins) for run in (args.run, args.beside) if run is not None]
    steps, fps, (width, height) = _path(args, sources[0])
    if args.file.suffix.lower() in IMAGE_ENDINGS:
        steps = steps[:1]
    cameras = [step.lens or lens(width, height, args.fov or step.fov_deg) for step in steps]
    snapshots = [source.field.snapshot() for source in sources]

    def render(index: int) -> list[Rendering]:
        return [s.render(steps[index].camera_to_world, cameras[index]) for s in snapshots]

    shown = _depth_colors(render, len(steps)) if args.depth else lambda rendering: to_bytes(rendering.color)
    progress = ProgressLine(sys.stderr)

    def images() -> Iterator[Image]:
        for index in range(len(steps)):
            progress("images", index / len(steps))
            yield np.concatenate([shown(each) for each in render(index)], axis=1)

    with progress.running("images"):
        count, width, height = write_video(args.file, images(), fps)
    print(f"{args.file}: {count} image{'s' * (count > 1)} of {width} x {height}")


def _path(args: argparse.Namespace, source: Source) -> tuple[list[Step], float, tuple[int, int]]:
    """Steps, images a second, and an image's width and height."""
    asked = _size(args.size)
    if args.path is not None:
        steps, fps, size = read_nerfstudio(args.path)
        return steps, args.fps or fps, asked or size
    fps, fov = args.fps or tuned.RENDERED_FPS, vertical_fov_deg(source.views[0].intrinsics)
    if args.camera is not None:
        step, size = source.camera_step(args.camera, asked, args.fov)
        return [step], fps, size
    size = asked or source.usual_size()
    if args.pose is not None:
        return looking(args.pose[:3], args.pose[3:], fov), fps, size
    return orbit(source.views, max(1, round(args.seconds * fps)), fov), fps, size


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    found = re.fullmatch(r"(\d{1,6})x(\d{1,6})", text)
    if found is None:
        raise ExportError(f"--size {text}: expected pixels such as 1280x720")
    return checked_size((int(found[1]), int(found[2])))


def _depth_colors(render: Callable[[int], list[Rendering]], count: int) -> Callable[[Rendering], Image]:
    """Colors of depth by nearness (1 / depth), on the scale of DEPTH_SCALE_OF images of the path."""
    samples = [
        r.depth[r.depth > 0]
        for k in np.unique(np.linspace(0, count - 1, tuned.DEPTH_SCALE_OF).astype(int))
        for r in render(int(k))
    ]
    near = 1.0 / np.concatenate(samples) if any(len(s) for s in samples) else np.ones(1)
    low, high = np.percentile(near, tuned.DEPTH_PERCENTILES)

    def colors(rendering: Rendering) -> Image:
        there = rendering.depth > 0
        share = (1.0 / np.where(there, rendering.depth, 1.0) - low) / max(high - low, 1e-9)
        map_bgr = cv2.applyColorMap(np.asarray(np.clip(share, 0, 1) * 255, np.uint8), cv2.COLORMAP_TURBO)
        return np.asarray(np.where(there[..., None], map_bgr[..., ::-1], 0), np.uint8)

    return colors
