"""``edge-server fit``: fits a field to a recorded data set without a network, and measures fidelity over
time."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from camera_node.sources.datasets.formats import FORMATS
from camera_node.sources.datasets.records import DatasetError
from edge_server.command import command_parser, exit_status
from edge_server.experiments.common.arguments import OptionError, add_lpips, at_least, check_seconds, parse_options
from edge_server.experiments.fitting import ctrl_c
from edge_server.experiments.fitting.fit import Fit
from edge_server.experiments.scenes.multiview_still import data_name, open_still
from edge_server.experiments.scenes.recorded import MultiviewStill
from edge_server.fields.registry import FIELD, field_names
from edge_server.run_records import UpdateRow
from freshfield.files import out_folder
from freshfield.scenario import NOTHING_HELD_OUT

DESCRIPTION = """\
Fit a recorded data set as fast as this machine can, and measure fidelity on views it never saw.

  edge-server fit ~/data/lego --seconds 60 --holdout 8 --scale 2 --out runs/lego
  edge-server fit ~/data/kitchen --field splat --holdout cam00 --frame 12
  edge-server fit tower --field splat --seconds 10
  edge-server fit ~/data/people/calibration.json --holdout cam01 --scale 4 --field ngp --option samples=256
  edge-server fit ~/data/apartment --format eyeful --holdout split
  edge-server fit mine.yaml --seconds 30

DATA is the folder of a data set, a synthetic scene (room, tile, tower), or the file of a scenario with one carried
camera of recorded data, such as a video with its trajectory. The format is found from the files:
transforms JSON (nerfstudio, instant-ngp, NeRF-synthetic), videos with a calibration JSON, DyNeRF (videos
with poses_bounds.npy), ZJU-MoCap (annots.npy), Eyeful Tower (cameras.json or .xml), a COLMAP model (text or
binary). If the folder holds several, name the describing file or give --format. A moving scene is fitted at
one instant (--frame; synthetic scenes have 15 frames a second). Time spent on evaluation is not counted as
fitting. Ctrl-C ends the fit early; report, pictures and checkpoint are still written, and --resume continues.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    parser = command_parser("edge-server fit", DESCRIPTION)
    add = parser.add_argument
    add(
        "data",
        type=Path,
        nargs="?",
        metavar="DATA",
        help="data set (folder or file), scenario (file, or the name of a shipped one), or synthetic scene",
    )
    add("--format", choices=list(FORMATS), help="format of the data set [found from its files]")
    add("--field", metavar="NAME", help=f"representation: {', '.join(field_names())} [{FIELD}]")
    add("--seconds", type=float, default=60.0, metavar="S", help="seconds of fitting [%(default)g]")
    add(
        "--holdout",
        metavar="K|NAME,...",
        help="views of a data set to test on: every K-th, or these images or cameras; split: the data set's "
        "test set; 0: none [8]",
    )
    add("--scale", type=float, default=1.0, metavar="K", help="divide image sizes by K [%(default)g]")
    add(
        "--frame", type=at_least(0), default=0, metavar="N", help="frame of a moving scene to fit, from 0 [%(default)s]"
    )
    add("--seed", type=int, default=0, metavar="N", help="random seed [%(default)s]")
    add(
        "--option",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="option of the field, e.g. levels=12 (freshfield scenario keys edge NAME); may be repeated",
    )
    add_lpips(parser)
    add("--out", type=out_folder, metavar="DIR", help="folder to write [runs/fit-DATA]")
    add("--resume", action="store_true", help="continue the fit in OUT, up to --seconds in total")
    args = parser.parse_args(argv)
    args.notes = [f"{FIELD} without layers: all views are of one instant"] if args.field is None else []
    args.field = args.field or FIELD
    if args.data is None:
        parser.error("name a data set: a folder, or the file that describes it")
    args.out = args.out or Path("runs") / f"fit-{data_name(args.data)}"
    return exit_status("edge-server fit", lambda: run(args), (DatasetError, OptionError), "nothing was written")


def run(request: argparse.Namespace) -> dict[str, Any]:
    """Fit, measure and write everything to ``request.out``; returns the contents of report.json.

    request: the parsed command line.
    Raises DatasetError or OptionError for invalid input.
    """
    check_seconds(request.seconds)
    if not 0.0 < request.scale <= 1e3:  # data sets take 1 or more
        raise OptionError(f"--scale {request.scale:g}: expected more than 0 (2 halves the images)")
    options = parse_options(request.option)
    data = open_still(request.data, request.holdout, request.scale, request.frame, request.format)
    fit = Fit(data, request.field, options, seed=request.seed, lpips=request.lpips)
    fit.notes[:0] = request.notes
    request.out.mkdir(parents=True, exist_ok=True)
    if request.resume:
        fit.resume(request.out, request.seconds)
    _say(_headline(data))
    if fit.notes:
        _say("; ".join(fit.notes))
    _say(f"kernels ready after {fit.field.warm_up():.1f} s")
    held_out = bool(data.held_out)
    finished = fit.run(request.seconds, lambda at: _say(progress_line(at, fit.outside, held_out)))
    with ctrl_c.postponed(f"writing {request.out}; Ctrl-C again stops that"):
        if not finished:
            _say("stopped early")
        elif not fit.rows or fit.rows[-1].steps == 0:
            _say(
                f"no step of training within {request.seconds:g} s: taking in the views took all of them. Give it more "
                f"(--resume with larger --seconds), or --scale {2 * request.scale:g}"
            )
        for line in fit.findings():
            _say(line)
        try:
            report = fit.save(request.out)
        except KeyboardInterrupt:
            partly = f"{request.out} is written in part; edge-server report {request.out} writes a report of it"
            raise KeyboardInterrupt(partly) from None
        _say(str(request.out / "report.html"))
    return report


def _say(line: str) -> None:
    print(line, flush=True)


def _headline(data: MultiviewStill) -> str:
    image = data.training[0].image
    held_out = f"{len(data.held_out)} held out" if data.held_out else "none held out: scored on training views"
    instant = f", {data.instant}" if data.instant else ""
    sizes = f"{image.shape[1]} x {image.shape[0]}"
    notes = "".join(f"note: {note}\n" for note in data.notes)
    return f"{notes}{data.file}: {len(data.training)} views of {sizes}{instant}, {held_out}"


def progress_line(at: UpdateRow, outside: float | None, held_out: bool = True) -> str:
    """A line of text: time, steps, scores and how many cores other processes used."""
    words = [f"{at.t_s:7.1f} s {'-' if at.steps is None else at.steps:>7} steps"]
    words.append(f"PSNR {at.psnr_db:5.2f} dB" + (f" on {NOTHING_HELD_OUT}" if not held_out else ""))
    words += [f"SSIM {at.ssim:.3f}"] if at.ssim is not None else []
    if at.psnr_refined_db is not None:
        words.append(f"at refined poses {at.psnr_refined_db:5.2f} dB")
        words += [f"SSIM {at.ssim_refined:.3f}"] if at.ssim_refined is not None else []
    words += [f"LPIPS {at.lpips:.3f}"] if at.lpips is not None else []
    words += [f"(others used {outside:.1f} cores)"] if outside is not None else []
    return "  ".join(words)
