"""Of carried cameras: what is shown now, and all that was shown so far, at regular instants of a run in virtual time.

A held-out camera that moves shows another view each time, so a mean over the run says little. *Now* is the newest
held-out frame, *all* each held-out frame so far, both rendered from the newest publication, at the poses and exposures
that the field's corrections of neighboring frames give, where it has any.

  python -m edge_server.experiments.virtual.now_and_all runs/before runs/after --out docs/results/carried

draws runs of ``edge-server simulate SCENARIO --out RUN``: decibels by seconds, and truth beside what each shows; and
writes carried.json, their means and rows.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera_node.capture import Camera
from edge_server.experiments.virtual.virtual_deployment import VirtualDeployment
from edge_server.fidelity.images import to_bytes
from edge_server.fidelity.refined import render_refined
from edge_server.fidelity.scorer import Scorer
from edge_server.fields import RefinesCameras, Snapshot, View
from edge_server.live.camera_motion import pose_distance
from freshfield import payload
from freshfield.files import write_json

MARKS_S = 2.0
SINCE_S = 4.0  # the first seconds are of a field that has seen next to nothing
_FILE, _IMAGES = "now-and-all.json", "now-and-all.npz"
_SEEN = 16  # frames of "all" that are kept as images


class NowAndAll:
    """Watches a deployment before it runs. rows: scores by instant.

    cameras: the held-out cameras, opened. seconds: how long it will run.
    """

    def __init__(self, deployment: VirtualDeployment, cameras: Sequence[Camera], seconds: float) -> None:
        self.rows: list[dict[str, Any]] = []
        self._deployment, self._scorer = deployment, Scorer()
        self._frames: list[View] = []
        self._images: dict[str, NDArray[np.uint8]] = {}
        for camera in cameras:
            schedule, tick = camera.rate_schedule, 0
            while schedule.due_ns(tick) < 1e9 * seconds:
                deployment.at(schedule.due_ns(tick), partial(self._take, camera, tick))
                tick += 1
        for number in range(1, int(seconds / MARKS_S) + 1):
            deployment.at(round(1e9 * number * MARKS_S), partial(self._mark, number * MARKS_S))

    def means(self) -> dict[str, Any]:
        """Means of the rows from SINCE_S on; empty before. revisited: of captures that a recording showed again, how
        far apart the first and the last refined pose are in the end (medians, 0 if no pose drifts), and the mean PSNR
        of each from the newest field."""
        late = [row for row in self.rows if row["t_s"] >= SINCE_S]
        means: dict[str, Any] = {
            name: float(np.mean([row[name] for row in late])) for name in (late[0] if late else ()) if name != "t_s"
        }
        if revisited := self._revisited():
            means["revisited"] = revisited
        return means

    def _revisited(self) -> dict[str, float] | None:
        shown = self._deployment.shown_now()
        if not isinstance(shown, RefinesCameras):
            return None
        found: dict[bytes, list[tuple[View, NDArray[np.float64]]]] = {}
        for frame in self._frames:
            if (known := shown.correction(frame)) is not None:
                found.setdefault(frame.camera_to_world.tobytes(), []).append((frame, known.camera_to_world))
        twice = [(each[0], each[-1]) for each in found.values() if len(each) > 1]
        if not twice:
            return None
        apart_m, apart_deg = np.median([pose_distance(first[1], last[1]) for first, last in twice], axis=0)
        first_db, last_db = np.mean([[self._psnr_db(shown, view) for view, _ in pair] for pair in twice], axis=0)
        return {
            "captures": len(twice),
            "apart_mm": 1e3 * float(apart_m),
            "apart_deg": float(apart_deg),
            "first_db": float(first_db),
            "last_db": float(last_db),
        }

    def _psnr_db(self, shown: Snapshot, frame: View) -> float:
        return self._scorer.score(frame.camera, self._shown(shown, frame), 0, frame.image, 0).psnr_db

    def write(self, out: Path) -> None:
        """Write rows and images to the folder ``out``. Raises OSError."""
        write_json(out / _FILE, self.rows)
        np.savez_compressed(out / _IMAGES, **self._images)  # type: ignore[arg-type]

    def _take(self, camera: Camera, tick: int) -> None:
        shot = camera.capture(tick)
        lens = shot.intrinsics
        image = payload.decode(shot.payload, camera.codec, lens.width, lens.height)[..., :3]
        self._frames.append(View(camera.name, image, shot.pose.matrix(), lens, self._deployment.clock.now_ns()))

    def _mark(self, t_s: float) -> None:
        shown = self._deployment.shown_now()
        if shown is None or not self._frames:
            return
        found = [self._shown(shown, frame) for frame in self._frames]
        scores = [self._scorer.score(f.camera, image, 0, f.image, 0) for f, image in zip(self._frames, found)]
        row: dict[str, Any] = {
            "t_s": t_s,
            "now_db": scores[-1].psnr_db,
            "all_db": float(np.mean([s.psnr_db for s in scores])),
        }
        if all(score.ssim is not None for score in scores):
            row |= {"now_ssim": scores[-1].ssim, "all_ssim": float(np.mean([s.ssim for s in scores]))}
        self.rows.append(row)
        some = np.linspace(0, len(found) - 1, min(_SEEN, len(found))).round().astype(int)
        self._images = {
            "truth_now": self._frames[-1].image,
            "now": to_bytes(found[-1]),
            "truth_all": np.array([self._frames[k].image for k in some]),
            "all": np.array([to_bytes(found[k]) for k in some]),
        }

    @staticmethod
    def _shown(shown: Snapshot, frame: View) -> NDArray[np.float32]:
        refined = render_refined(shown, frame)
        return shown.render(frame.camera_to_world, frame.intrinsics).color if refined is None else refined


def _facts(run: Path) -> dict[str, Any]:
    """What a run was, and what it showed: means from SINCE_S on, and rows."""
    about, rows = (json.loads((run / name).read_text()) for name in ("simulation.json", _FILE))
    late = [row for row in rows if row["t_s"] >= SINCE_S]
    names = [name for name in rows[0] if name != "t_s"]
    means = {name: round(float(np.mean([row[name] for row in late])), 3) for name in names}
    revisited = about["now_and_all"].get("revisited")
    kept = {name: about[name] for name in ("scenario", "seed", "steps", "updates", "update_ms", "digest")}
    return {
        "run": run.name,
        **kept,
        **means,
        **({"revisited": {name: round(value, 2) for name, value in revisited.items()}} if revisited else {}),
        "by_seconds": [[row["t_s"], *(round(row[n], 2) for n in names)] for row in rows],
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Draw runs side by side; returns the exit status."""
    from edge_server.experiments.common.drawn_images import draw_images
    from edge_server.report.style import figure, label_lines

    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("runs", nargs="+", type=Path, help="folders of runs of one scenario")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="NAME", help="writes NAME.json, NAME-time.png, NAME-pictures.png"
    )
    parser.add_argument("--without-truth", action="store_true", help="of footage that may not be published")
    args = parser.parse_args(argv)
    images = [dict(np.load(run / _IMAGES)) for run in args.runs]
    write_json(args.out.with_suffix(".json"), {"runs": [_facts(run) for run in args.runs]})
    with figure(args.out.with_name(f"{args.out.name}-time.png"), 2) as (_, axes):
        for run in args.runs:
            rows = json.loads((run / _FILE).read_text())
            for line, name in zip(axes[:, 0], ("now_db", "all_db")):
                line.plot([row["t_s"] for row in rows], [row[name] for row in rows], label=run.name)
        label_lines(axes[0, 0], "now, dB")
        label_lines(axes[1, 0], "all so far, dB", "seconds")
    half = len(images[0]["all"]) // 2
    rows = []
    for label, name, frame in (("now", "now", ()), ("of all, half-way", "all", half)):
        truth = [] if args.without_truth else [("truth", images[0][f"truth_{name}"][frame])]
        rows.append((label, [*truth, *((run.name, of_run[name][frame]) for run, of_run in zip(args.runs, images))]))
    draw_images(args.out.with_name(f"{args.out.name}-pictures.png"), rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
