"""Fits a field to the views of one instant and measures it on views that it never saw: from the command and as a
library."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec.structs import asdict
from numpy.typing import NDArray

from camera_node.sources.datasets.records import DatasetError
from edge_server.experiments import experiment_constants as tuned
from edge_server.experiments.common.arguments import OptionError, check_seconds
from edge_server.experiments.fitting.misfits import misfits
from edge_server.experiments.scenes.multiview_still import mean_baselines, open_still, score_views
from edge_server.experiments.scenes.recorded import MultiviewStill
from edge_server.export.run_source import Source, holds_checkpoint, open_source
from edge_server.export.viewed_field import ViewedField
from edge_server.fidelity.images import color_behind, to_bytes, to_unit, write_png
from edge_server.fidelity.lpips_weights import open_lpips
from edge_server.fidelity.scorer import SELECTED, Scorer
from edge_server.fields import Budget, FitReport, RefinesCameras, checkpoint
from edge_server.fields.registry import FIELD, make_field, option_help
from edge_server.fields.splat.carried_camera.carried_camera_constants import scan_options
from edge_server.machine import run_facts
from edge_server.run_records import UpdateRow
from freshfield.files import write_json
from freshfield.machine_load import LoadMeter, outside_cores


class Fit(ViewedField):
    """A field that is fitted to a data set. ``ViewedField`` has ``render``, ``depth``, ``orbit`` and ``export``.

    data: the views. field: the model, which ``Field`` describes.
    rows: one for each evaluation so far. outside: cores that other processes used before each.
    spent_s, spent_steps: seconds and optimizer steps so far, evaluation not counted.
    notes: what people should know of how the data were learned.
    lpips_missing: why LPIPS is not measured, if so.
    """

    def __init__(
        self,
        data: MultiviewStill,
        field: str = FIELD,
        options: Mapping[str, Any] | None = None,
        *,
        seed: int = 0,
        lpips: Path | None = None,
    ) -> None:
        """data: from ``load``. field: name of the representation. options: of the field, e.g. ``{"gaussians": 4096}``.
        lpips: folder of LPIPS weights. Transparent images lie over white, or the option ``background``.

        Raises OptionError for a field or option that there is not, DatasetError for a camera that no field can use.
        """
        from edge_server.fields.common.supervision import check_view  # compiles

        self.data, self.seed = data, seed
        self.notes: list[str] = []
        given = dict(options or {})
        if any(v.image.shape[2] == 4 for v in data.training):
            given = {"background": "white", **given}
        try:
            self.options = {**self._scan_options(field), **given}
            model = make_field(field, self.options, seed=seed)
        except (ValueError, TypeError) as error:
            raise OptionError(f"--field {field}: {error}") from None
        try:
            for view in (*data.training, *data.held_out):
                check_view(view)
        except ValueError as error:
            raise DatasetError(f"{data.file}: {error}") from None
        super().__init__(field, model, data.training, data.held_out)
        metric, self.lpips_missing = open_lpips(lpips)
        self.rows: list[UpdateRow] = []
        self.outside: float | None = None
        self.spent_s, self.spent_steps = 0.0, 0
        self._scorer = Scorer(metric, background=color_behind(self.options))
        self._scored_views = data.held_out or data.training[: tuned.SCORED_OF_TRAINING]
        self._shown: NDArray[np.float32] | None = None
        self._processes: list[dict[str, Any]] = []
        self._load_meter = LoadMeter("fit")

    def _scan_options(self, field: str) -> dict[str, Any]:
        """What the data set says of how to learn it: see ``MultiviewStill.carried`` and ``timed``."""
        data = self.data
        if not data.carried or "scan" not in option_help(field):
            return {}
        note = "a scan: one camera, carried about a scene that stands still"
        if data.timed:
            note += "; its frames have times, so a tracker gave their poses: poses and exposures are refined"
        self.notes.append(note)
        return scan_options(data.training[0].image[..., 0].size, data.timed)

    @property
    def psnr(self) -> NDArray[np.float64]:
        """The curve of fidelity, (evaluations, 2): seconds of fitting, and dB on the held-out views, or on training
        views if none is held out; at refined poses where the field refines them."""
        rows = [(row.t_s, row.psnr_db if row.psnr_refined_db is None else row.psnr_refined_db) for row in self.rows]
        return np.array(rows, np.float64).reshape(-1, 2)

    def run(self, until_s: float, progress: Callable[[UpdateRow], None] | None = None) -> bool:
        """Fit until ``until_s`` seconds in total and score on the way. Returns False if Ctrl-C ended it early.

        progress: called with each evaluation. Raises OptionError for a time out of range.
        """
        check_seconds(until_s)
        try:
            for mark_s in marks_s(until_s):
                if mark_s - self.spent_s >= tuned.SHORTEST_SLICE_S and not self._run_slice(mark_s, progress):
                    return False
        except KeyboardInterrupt:  # during an evaluation: the last complete one is kept
            return False
        return True

    def _run_slice(self, until_s: float, progress: Callable[[UpdateRow], None] | None) -> bool:
        """Fit until then, and score. Returns False if Ctrl-C was pressed meanwhile: the parameters, those of the last
        step, are scored all the same."""
        began_s, began_at = time.perf_counter(), getattr(self.field, "step", 0)
        report: FitReport | None = None
        with suppress(KeyboardInterrupt):
            report = self.field.fit(self.data.training, Budget(seconds=until_s - self.spent_s))
        slice_s = time.perf_counter() - began_s
        usage = self._load_meter.row(0.0)
        score, self._shown = score_views(self.field, self._scored_views, self._scorer)
        self.spent_s += slice_s
        # After Ctrl-C there is no report, but most fields count their steps, from 0 again where they begin anew.
        after = getattr(self.field, "step", 0)
        steps = report.steps if report else after - began_at if after >= began_at else after
        self.spent_steps += steps
        self._processes.append(usage | {"t_s": round(self.spent_s, 3)})
        self.outside = outside_cores(usage)
        self._load_meter.row(0.0)  # the evaluation is not measured
        row = UpdateRow(
            number=len(self.rows),
            t_s=self.spent_s,
            psnr_db=score.psnr_db,
            ssim=score.ssim,
            lpips=score.lpips,
            psnr_refined_db=score.psnr_refined_db,
            ssim_refined=score.ssim_refined,
            selected=len(self.data.training),
            update_ms=slice_s * 1e3,
            steps=self.spent_steps if report or steps else None,
            loss=report.loss if report else None,
            scored_on=f"{len(self.data.held_out)} views" if self.data.held_out else SELECTED,
        )
        self.rows.append(row)
        if progress is not None:
            progress(row)
        return report is not None

    def resume(self, folder: Path, until_s: float) -> None:
        """Go on from what ``save`` wrote. Raises OptionError if there is nothing, if it has been fitted for ``until_s``
        seconds already, or if it has learned from what is held out now."""
        try:
            state, about = checkpoint.load(folder / "field")
            self.field.load_state(state)
            self.spent_s, self.spent_steps = float(about["seconds"]), int(about["steps"])
            self.rows = msgspec.convert(_read_lines(folder / "series.jsonl"), list[UpdateRow])
            self._processes = _read_lines(folder / "processes.jsonl")
        except (OSError, ValueError, KeyError) as error:
            raise OptionError(f"--resume: {folder} holds no fit to go on from: {error}") from None
        learned = {view.camera for view in self.field.views}
        if known := [view.camera for view in self.data.held_out if view.camera in learned]:
            raise OptionError(
                f"--resume: {folder} has learned {known[0]} already, which is to be held out now: give the --holdout "
                "that it began with"
            )
        if self.spent_s > until_s - tuned.SHORTEST_SLICE_S:
            raise OptionError(
                f"--resume: {folder} has been fitted for {self.spent_s:.1f} s already: give more --seconds"
            )

    def findings(self) -> list[str]:
        """What a fit found out about a carried camera, a line each: what the corrections of its poses have in common,
        and which training views do not fit the others. They become notes."""
        if not self.data.carried:
            return []
        found = []
        if isinstance(self.field, RefinesCameras):
            from edge_server.fields.common.cameras.mount_error import constant_correction

            refined = [(v, c) for v in self.data.training if (c := self.field.correction(v)) is not None]
            common = constant_correction(
                [v.camera_to_world for v, _ in refined], [c.camera_to_world for _, c in refined]
            )
            found += [] if common is None else [common.words]
        found += misfits(self.field, self.data.training, Scorer(None, background=self._scorer.background))
        self.notes += found
        return found

    def save(self, folder: Path | str) -> dict[str, Any]:
        """Write checkpoint, images and report to a folder, which ``load``, ``edge-server render`` and ``edge-server
        export`` open. Returns report.json. Raises OSError."""
        from edge_server.report.build_report import build_report  # draws with matplotlib

        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        checkpoint.save(folder / "field", self.field.state(), {**self._about(), "steps": self.spent_steps})
        _write_lines(folder / "series.jsonl", self.rows)
        _write_lines(folder / "processes.jsonl", self._processes)
        write_json(folder / "edge.json", self._status())
        if self._shown is not None:
            truth = to_unit(self._scored_views[0].image, "held-out view", self._scorer.background)
            write_png(folder / "truth.png", np.rint(truth * 255.0).astype(np.uint8))
            write_png(folder / "rendered.png", to_bytes(self._shown))
        return build_report(folder)

    def _about(self) -> dict[str, Any]:
        return {
            "field": self.name,
            "options": self.options,
            "seed": self.seed,
            "scenario": f"fit {self.data.name}",
            "seconds": self.spent_s,
        }

    def _status(self) -> dict[str, Any]:
        d = self.data
        return {
            **self._about(),
            "kind": "fit",
            "run": run_facts(),
            "chosen": "; ".join(self.notes) or None,
            "data": {
                "file": d.file.name,
                "instant": d.instant,
                "training": len(d.training),
                "held_out": [v.camera for v in d.held_out],
                "missing": d.missing,
            },
            "baseline": mean_baselines(d.training, d.held_out, self._scorer.background),
            "lpips_missing": self.lpips_missing,
            "lpips_network": None if self.lpips_missing else "alex",
        }


def load(
    path: Path | str,
    *,
    holdout: int | str | None = None,
    scale: float = 1.0,
    frame: int = 0,
    format: str | None = None,
    allow_plugins: bool = False,
) -> MultiviewStill | Source:
    """A data set to fit, or the field that a run or fit saved.

    path: folder of a data set or the file that describes it, the name of a synthetic scene (room, tile, tower), or the
        folder of a run or fit, or a checkpoint in it, for which the other arguments mean nothing.
    holdout: every how many views one is held out, or names of images or cameras, separated by commas; ``split``: the
        data set's own test set; 0: none. None: its own test set, else every 8th.
    scale: divides the image sizes.
    frame: number of the instant of a moving data set, from 0.
    format: of the data set; None finds it from its files.
    allow_plugins: run code from outside that a checkpoint's field names, if you trust it.
    Returns a ``MultiviewStill``, whose ``training`` and ``held_out`` are views (``camera``, ``image`` uint8 (H, W, 3 or
    4), ``camera_to_world`` (4, 4), ``intrinsics``, ``depth`` float32 (H, W) meters or None), or a ``Source``
    (``ViewedField``).
    Raises DatasetError, OptionError or, of a checkpoint, ExportError.
    """
    if holds_checkpoint(Path(path)):
        return open_source(Path(path), allow_plugins)
    return open_still(Path(path), None if holdout is None else str(holdout), scale, frame, format)


def fit(
    data: MultiviewStill | Path | str,
    *,
    seconds: float = 60.0,
    field: str = FIELD,
    holdout: int | str | None = None,
    options: Mapping[str, Any] | None = None,
    seed: int = 0,
    progress: Callable[[UpdateRow], None] | None = None,
) -> Fit:
    """Fit a field to a data set.

    data: from ``load``, or a path as ``load`` takes it.
    seconds: of fitting; evaluation is not counted. holdout: as of ``load``, where data is a path.
    field: name of the representation (``freshfield scenario keys edge NAME``). options: of it, by name.
    progress: called with each evaluation: ``t_s``, ``psnr_db``, ``ssim``, ...
    Raises DatasetError or OptionError, and KeyboardInterrupt at Ctrl-C; ``Fit.run`` keeps what was fitted until then.
    """
    if not isinstance(data, MultiviewStill):
        data = open_still(Path(data), None if holdout is None else str(holdout))
    elif holdout is not None:
        raise OptionError("holdout: these views are loaded and split already: give it to load")
    check_seconds(seconds)
    made = Fit(data, field, options, seed=seed)
    made.field.warm_up()
    if not made.run(seconds, progress):
        raise KeyboardInterrupt
    made.findings()
    return made


def marks_s(total_s: float) -> list[float]:
    """Seconds of fitting after which to evaluate, the last being ``total_s``."""
    later = np.arange(tuned.FIT_MARKS_S[-1] + tuned.FIT_THEN_EVERY_S, total_s, tuned.FIT_THEN_EVERY_S)
    before_s = (1.0 - tuned.FIT_LAST_SHARE) * total_s
    return [m for m in (*tuned.FIT_MARKS_S, *map(float, later)) if m <= before_s] + [total_s]


def _read_lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def _write_lines(path: Path, rows: Sequence[Any]) -> None:
    path.write_text("".join(json.dumps(row, default=asdict, allow_nan=False) + "\n" for row in rows))
