"""``edge-server fit``: fits a field to a recorded data set without a network, and measures fidelity over
time."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from msgspec.structs import asdict
from numpy.typing import NDArray

from camera_node.sources.datasets.formats import FORMATS
from camera_node.sources.datasets.records import DatasetError
from camera_node.synthetic import SCENES
from camera_node.synthetic.scene import HELD_OUT
from camera_node.synthetic.source import WORLD_FPS
from edge_server.experiments.common.arguments import (
    OptionError,
    add_lpips,
    at_least,
    command_parser,
    parse_options,
    run_command,
)
from edge_server.experiments.fitting.evaluate import Scored, fit_in_slices, marks_s
from edge_server.experiments.fitting.misfits import misfits
from edge_server.experiments.scenes.multiview_still import mean_baselines, score_views, synthetic_still
from edge_server.experiments.scenes.recorded import MultiviewStill, load_recorded
from edge_server.fidelity.images import Color, to_unit
from edge_server.fidelity.lpips_weights import open_lpips
from edge_server.fidelity.scorer import SELECTED, Score, Scorer
from edge_server.fields import Field, RefinesCameras, checkpoint
from edge_server.fields.registry import FIELD, efforts_of, field_names, option_help, settings_of
from edge_server.fields.splat.scan.settings import scan_options
from edge_server.live.scoring_thread import to_bytes
from edge_server.machine import run_facts
from edge_server.run_records import UpdateRow
from freshfield.files import out_folder, write_json
from freshfield.machine_load import LoadMeter, outside_cores
from freshfield.scenario import NOTHING_HELD_OUT

DESCRIPTION = """\
Fit a recorded data set as fast as this machine can, and measure fidelity on views it never saw.

  edge-server fit ~/data/lego --seconds 60 --holdout 8 --scale 2 --out runs/lego
  edge-server fit ~/data/kitchen --field splat --holdout cam00 --frame 12
  edge-server fit tower --field splat --seconds 10
  edge-server fit --field splat --list-options
  edge-server fit ~/data/people/calibration.json --holdout cam01 --scale 4 --field ngp --option samples=256
  edge-server fit ~/data/apartment --format eyeful --holdout split

DATA is the folder of a data set, or a synthetic scene: room, tile, tower. The format is found from the files:
transforms JSON (nerfstudio, instant-ngp, NeRF-synthetic), videos with a calibration JSON, DyNeRF (videos
with poses_bounds.npy), ZJU-MoCap (annots.npy), Eyeful Tower (cameras.json or .xml), a COLMAP model (text or
binary). If the folder holds several, name the describing file or give --format. A moving scene is fitted at
one instant (--frame; synthetic scenes have 15 frames a second). Time spent on evaluation is not counted as
fitting. Ctrl-C ends the fit early; report, pictures and checkpoint are still written, and --resume continues.
"""

BACKGROUNDS: dict[str, Color] = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
_SCENE_SIZE = 128  # image width and height of a synthetic scene, before --scale
# Number of training views that are scored if no view is held out.
_SCORED_OF_TRAINING = 8


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    parser = command_parser("fit", DESCRIPTION)
    add = parser.add_argument
    add("data", type=Path, nargs="?", metavar="DATA", help="data set (folder or file), or a synthetic scene")
    add("--format", choices=list(FORMATS), help="format of the data set [found from its files]")
    add("--field", metavar="NAME", help=f"representation: {', '.join(field_names())} [{FIELD}]")
    add("--list-options", action="store_true", help="list the options of --field, with defaults, and exit")
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
    add(
        "--background",
        choices=sorted(BACKGROUNDS),
        default="white",
        help="background of transparent images [%(default)s]",
    )
    add("--seed", type=int, default=0, metavar="N", help="random seed [%(default)s]")
    add(
        "--option",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="option of the field, e.g. levels=12 (--list-options); may be repeated",
    )
    add_lpips(parser)
    add("--out", type=out_folder, metavar="DIR", help="folder to write [runs/fit-DATA]")
    add("--resume", action="store_true", help="continue the fit in OUT, up to --seconds in total")
    args = parser.parse_args(argv)
    args.chosen = f"{FIELD} without layers: all views are of one instant" if args.field is None else ""
    args.field = args.field or FIELD
    if args.list_options:
        try:
            known, defaults = option_help(args.field), settings_of(args.field)
        except ValueError as error:
            parser.error(str(error))
        print(f"{'effort':18} preset of the options below: {', '.join(efforts_of(args.field))} [medium]")
        print("\n".join(f"{name:18} {text} [{getattr(defaults, name)}]" for name, text in known.items()))
        return 0
    if args.data is None:
        parser.error("name a data set: a folder, or the file that describes it")
    args.out = args.out or Path("runs") / f"fit-{_data_name(args.data)}"
    return run_command("fit", lambda: run(args), (DatasetError, OptionError), "nothing was written")


def run(request: argparse.Namespace) -> dict[str, Any]:
    """Fit, measure and write everything to ``request.out``; returns the contents of report.json.

    request: the parsed command line.
    Raises DatasetError or OptionError for invalid input.
    """
    from edge_server.fields.registry import make_field  # numba loads only once the options are read

    if not 0.0 < request.seconds <= 1e6:
        raise OptionError(f"--seconds {request.seconds:g}: expected more than 0")
    if not 0.0 < request.scale <= 1e3:  # data sets take 1 or more
        raise OptionError(f"--scale {request.scale:g}: expected more than 0 (2 halves the images)")
    options = parse_options(request.option)
    data = _open(request)
    if any(v.image.shape[2] == 4 for v in data.training):
        options = {"background": request.background, **options}
    try:
        options = {**_scan_options(request, data, options), **options}
        model = make_field(request.field, options, seed=request.seed)
    except (ValueError, TypeError) as error:
        raise OptionError(f"--field {request.field}: {error}") from None
    from edge_server.fields.common.supervision import check_view  # as above

    try:
        for view in (*data.training, *data.held_out):
            check_view(view)
    except ValueError as error:
        raise DatasetError(f"{data.file}: {error}") from None
    request.out.mkdir(parents=True, exist_ok=True)
    run_ = _Run(request, options, data, model)
    if request.resume:
        run_.load()
    print(run_.headline(), flush=True)
    if request.chosen:
        print(request.chosen, flush=True)
    print(f"kernels ready after {model.warm_up():.1f} s", flush=True)
    return run_.go()


def _scan_options(request: argparse.Namespace, data: MultiviewStill, options: Mapping[str, Any]) -> dict[str, Any]:
    """What the data set says of how to learn it: see ``MultiviewStill.carried`` and ``timed``."""
    if not data.carried or "scan" not in option_help(request.field):
        return {}
    note = "a scan: one camera, carried about a scene that stands still"
    if data.timed:
        note += "; its frames have times, so a tracker gave their poses: poses and exposures are refined"
    request.chosen = "; ".join(filter(None, (request.chosen, note)))
    found = scan_options(data.training[0].image[..., 0].size, data.timed)
    if "effort" in options:  # says how many Gaussians
        del found["gaussians"]
    return found


def _is_scene(data: Path) -> bool:
    return str(data) in SCENES and not data.exists()


def _data_name(data: Path) -> str:
    """The name of a scene or data set in folders and reports."""
    return str(data) if _is_scene(data) else (data if data.is_dir() else data.parent).resolve().name


def _open(request: argparse.Namespace) -> MultiviewStill:
    if not _is_scene(request.data):
        return load_recorded(request.data, request.holdout, request.scale, request.frame, request.format)
    for name in ("format", "holdout"):
        if getattr(request, name) is not None:
            raise OptionError(f"--{name} is for data sets; the scene {request.data} holds out {HELD_OUT}")
    t_s = request.frame / WORLD_FPS
    still = synthetic_still(str(request.data), size=max(8, round(_SCENE_SIZE / request.scale)), t_s=t_s)
    return replace(still, instant=f"at {t_s:g} s")


class _Run:
    """A fit in progress: its files in ``request.out`` and its lines on the terminal."""

    def __init__(
        self, request: argparse.Namespace, options: dict[str, Any], data: MultiviewStill, model: Field
    ) -> None:
        self.request, self.options, self.data, self.model = request, options, data, model
        self.out = request.out
        metric, self.lpips_missing = open_lpips(request.lpips)
        self.background = BACKGROUNDS[request.background]
        self.scorer = Scorer(metric, background=self.background)
        self.views = data.held_out or data.training[:_SCORED_OF_TRAINING]
        self.rendered: NDArray[np.float32] | None = None
        self.rows: list[UpdateRow] = []
        self.processes: list[dict[str, Any]] = []
        self.spent_s, self.spent_steps = 0.0, 0
        self.load_meter = LoadMeter("fit")

    def headline(self) -> str:
        d, image = self.data, self.data.training[0].image
        held_out = f"{len(d.held_out)} held out" if d.held_out else "none held out: scored on training views"
        instant = f", {d.instant}" if d.instant else ""
        sizes = f"{image.shape[1]} x {image.shape[0]}"
        notes = "".join(f"note: {note}\n" for note in d.notes)
        return f"{notes}{d.file}: {len(d.training)} views of {sizes}{instant}, {held_out}"

    def load(self) -> None:
        """Load the files that ``finish`` wrote. Raises OptionError if there are none."""
        try:
            state, about = checkpoint.load(self.out / "field")
            self.model.load_state(state)
            self.spent_s, self.spent_steps = float(about["seconds"]), int(about["steps"])
            self.rows = msgspec.convert(_read_lines(self.out / "series.jsonl"), list[UpdateRow])
            self.processes = _read_lines(self.out / "processes.jsonl")
        except (OSError, ValueError, KeyError) as error:
            raise OptionError(f"--resume: {self.out} holds no fit to go on from: {error}") from None
        if self.spent_s >= self.request.seconds - 0.05:
            raise OptionError(
                f"--resume: {self.out} has been fitted for {self.spent_s:.1f} s already: give more --seconds"
            )

    def go(self) -> dict[str, Any]:
        try:
            done = fit_in_slices(
                self.model,
                self.data.training,
                self._score,
                marks_s(self.request.seconds),
                self._scored,
                self.spent_s,
                self.spent_steps,
            )
        except KeyboardInterrupt:  # during an evaluation: the last complete one is kept
            done = False
        if not done:
            print("stopped early", flush=True)
        return self.finish()

    def _score(self) -> Score:
        self.processes.append(self.load_meter.row(0.0))
        score, self.rendered = score_views(self.model, self.views, self.scorer)
        return score

    def _scored(self, at: Scored) -> None:
        score = at.score
        self.spent_s = at.seconds
        self.spent_steps = at.steps if at.steps is not None else self.spent_steps
        self.processes[-1]["t_s"] = round(at.seconds, 3)
        outside = outside_cores(self.processes[-1])
        self.load_meter.row(0.0)  # the evaluation is not measured
        self.rows.append(
            UpdateRow(
                number=len(self.rows),
                t_s=at.seconds,
                psnr_db=score.psnr_db,
                ssim=score.ssim,
                lpips=score.lpips,
                psnr_refined_db=score.psnr_refined_db,
                ssim_refined=score.ssim_refined,
                selected=len(self.data.training),
                update_ms=at.slice_s * 1e3,
                steps=at.steps,
                loss=at.loss,
                scored_on=f"{len(self.data.held_out)} views" if self.data.held_out else SELECTED,
            )
        )
        print(progress_line(at, outside, bool(self.data.held_out)), flush=True)

    def finish(self) -> dict[str, Any]:
        """Write checkpoint, images and report; returns report.json."""
        from edge_server.report.build_report import build_report  # draws with matplotlib

        self._say_calibration()
        self._say_misfits()
        checkpoint.save(self.out / "field", self.model.state(), {**self._about(), "steps": self.spent_steps})
        _write_lines(self.out / "series.jsonl", self.rows)
        _write_lines(self.out / "processes.jsonl", self.processes)
        write_json(self.out / "edge.json", self._status())
        if self.rendered is not None:
            truth = to_unit(self.views[0].image, "held-out view", self.background)
            _write_png(self.out / "truth.png", np.rint(truth * 255.0).astype(np.uint8))
            _write_png(self.out / "rendered.png", to_bytes(self.rendered))
        report = build_report(self.out)
        print(self.out / "report.html", flush=True)
        return report

    def _say_calibration(self) -> None:
        """Print and note what the corrections of a carried camera's poses have in common."""
        if not (self.data.carried and isinstance(self.model, RefinesCameras)):
            return
        from edge_server.fields.common.cameras.constant_correction import constant_correction

        refined = [(v, known) for v in self.data.training if (known := self.model.correction(v)) is not None]
        found = constant_correction([v.camera_to_world for v, _ in refined], [k.camera_to_world for _, k in refined])
        if found is not None:
            print(found.words, flush=True)
            self.request.chosen = "; ".join(filter(None, (self.request.chosen, found.words)))

    def _say_misfits(self) -> None:
        """Print and note which training views do not fit the others."""
        if not self.data.carried:
            return
        lines = misfits(self.model, self.data.training, Scorer(None, background=self.background))
        print("\n".join(lines), end="\n" if lines else "", flush=True)
        self.request.chosen = "; ".join(filter(None, (self.request.chosen, *lines)))

    def _about(self) -> dict[str, Any]:
        return {
            "field": self.request.field,
            "options": self.options,
            "seed": self.request.seed,
            "scenario": f"fit {_data_name(self.request.data)}",
            "seconds": self.spent_s,
        }

    def _status(self) -> dict[str, Any]:
        d = self.data
        return {
            **self._about(),
            "kind": "fit",
            "run": run_facts(),
            "chosen": self.request.chosen or None,
            "data": {
                "file": d.file.name,
                "instant": d.instant,
                "training": len(d.training),
                "held_out": [v.camera for v in d.held_out],
                "missing": d.missing,
            },
            "baseline": mean_baselines(d.training, d.held_out, self.background),
            "lpips_missing": self.lpips_missing,
            "lpips_network": None if self.lpips_missing else "alex",
        }


def progress_line(at: Scored, outside: float | None, held_out: bool = True) -> str:
    """A line of text: time, steps, scores and how many cores other processes used."""
    score = at.score
    words = [f"{at.seconds:7.1f} s {'-' if at.steps is None else at.steps:>7} steps"]
    words.append(f"PSNR {score.psnr_db:5.2f} dB" + (f" on {NOTHING_HELD_OUT}" if not held_out else ""))
    words += [f"SSIM {score.ssim:.3f}"] if score.ssim is not None else []
    if score.psnr_refined_db is not None:
        words.append(f"at refined poses {score.psnr_refined_db:5.2f} dB")
        words += [f"SSIM {score.ssim_refined:.3f}"] if score.ssim_refined is not None else []
    words += [f"LPIPS {score.lpips:.3f}"] if score.lpips is not None else []
    words += [f"(others used {outside:.1f} cores)"] if outside is not None else []
    return "  ".join(words)


def _read_lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def _write_lines(path: Path, rows: Sequence[Any]) -> None:
    path.write_text("".join(json.dumps(row, default=asdict, allow_nan=False) + "\n" for row in rows))


def _write_png(path: Path, image: NDArray[np.uint8]) -> None:
    cv2.imwrite(str(path), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
