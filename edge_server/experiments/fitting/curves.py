"""Runs side by side: fidelity by seconds, the median of several seeds each.

  python -m edge_server.experiments.fitting.curves "with depth=RUN,RUN" none=RUN,RUN --out docs/results/scans

writes scans.json and scans.png of folders that ``edge-server fit --out RUN`` wrote, by the wall clock; where a fit
refines poses, its figures are those at refined poses. Or of folders of ``edge-server simulate --out RUN``: what was
shown, by virtual time.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from edge_server.report.style import CYCLE, figure, label_lines
from freshfield.files import write_json


def median_curve(runs: Sequence[Path]) -> dict[str, Any]:
    """Of runs of one kind, by reported instant, medians over the runs.

    Of fits ``t_s``, ``psnr_db``, ``ssim`` and, where every run measured it, ``lpips``; of simulations ``t_s``,
    ``psnr_db`` and ``psnr_moving_db``, None where nothing that moves was shown.

    runs: folders of ``edge-server fit`` or ``edge-server simulate``. Raises OSError and ValueError for a folder that is
    none, for fits whose instants differ in number from the others', or that did not measure one of them.
    """
    if (runs[0] / "simulation.json").exists():
        return _shown_curve(runs)
    rows = [[json.loads(line) for line in (run / "series.jsonl").read_text().splitlines()] for run in runs]
    if len({len(of_run) for of_run in rows}) != 1:
        raise ValueError(f"{', '.join(map(str, runs))}: reported at different instants")
    columns = {
        "t_s": ("t_s",),
        "psnr_db": ("psnr_refined_db", "psnr_db"),
        "ssim": ("ssim_refined", "ssim"),
        "lpips": ("lpips",),
    }
    curve: dict[str, Any] = {"runs": len(runs)}
    for name, keys in columns.items():
        values: list[list[Any]] = [
            [next((row[k] for k in keys if row.get(k) is not None), None) for row in of_run] for of_run in rows
        ]
        if name == "lpips" and any(None in of_run for of_run in values):
            continue  # it needs its network: a run without it has no such column
        for run, of_run, found in zip(runs, rows, values):
            if None in found:
                raise ValueError(f"{run}: no {name} at {of_run[found.index(None)].get('t_s')} s")
        curve[name] = np.round(np.median(values, axis=0), 3).tolist()
    return curve


def _shown_curve(runs: Sequence[Path]) -> dict[str, Any]:
    found = [json.loads((run / "simulation.json").read_text()) for run in runs]
    shown = [{t_s: (whole, moving) for t_s, whole, moving in one["shown_curve_db"]} for one in found]
    instants = sorted(set.intersection(*(set(one) for one in shown)))
    curve: dict[str, Any] = {"runs": len(runs), "seconds_to_1_db": [one["seconds_to_1_db"] for one in found]}
    curve["t_s"] = instants
    for k, name in enumerate(("psnr_db", "psnr_moving_db")):
        values = [[one[t_s][k] for one in shown] for t_s in instants]
        curve[name] = [None if None in of_one else round(float(np.median(of_one)), 2) for of_one in values]
    return curve


def main(argv: Sequence[str] | None = None) -> int:
    """Write curves and figure; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("fits", nargs="+", metavar="NAME=RUN,RUN", help="folders of runs that differ in their seed")
    parser.add_argument("--out", type=Path, required=True, metavar="NAME", help="writes NAME.json, NAME.png")
    args = parser.parse_args(argv)
    curves = {}
    for fit in args.fits:
        name, _, runs = fit.partition("=")
        try:
            curves[name] = median_curve([Path(run) for run in runs.split(",")])
        except (OSError, ValueError) as error:
            parser.error(f"{name}: {error}")
    fits = "ssim" in next(iter(curves.values()))
    command = "edge-server fit DATA --holdout 8" if fits else "edge-server simulate SCENARIO --out RUN"
    write_json(args.out.with_suffix(".json"), {"command": command, "curves": curves})
    second, label = ("ssim", "SSIM") if fits else ("psnr_moving_db", "where it moves, dB")
    with figure(args.out.with_suffix(".png"), 2) as (_, axes):
        for k, (name, curve) in enumerate(curves.items()):
            style = "-" if k < len(CYCLE) else "--"  # colors begin again
            for line, key in zip(axes[:, 0], ("psnr_db", second)):
                line.plot(curve["t_s"], curve[key], style, marker=".", label=name)
        label_lines(axes[0, 0], "PSNR, dB")
        label_lines(axes[1, 0], label, "seconds of the wall clock" if fits else "seconds since the first frame")
    return 0


if __name__ == "__main__":
    sys.exit(main())
