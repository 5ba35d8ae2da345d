"""Checks the report of a run: ``python -m tests.tools.check_report OUT``; exit code 1 if it is wrong.

Continuous integration runs it after a short demo. It checks properties of every healthy run, not how good the
results are.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any


def problems(out: Path) -> list[str]:
    """The problems of the report in ``out``, one line each."""
    for name in ("report.json", "report.html"):
        if not (out / name).is_file():
            return [f"{out / name} is missing"]
    report: dict[str, Any] = json.loads((out / "report.json").read_text())
    frames, fidelity = report["frames"], report["fidelity"]
    updates, baseline = report["updates"], fidelity["baseline"]
    checks = {
        f"every frame is accounted for ({'; '.join(frames['doubts'])})": frames["closes"],
        "no two ledgers contradict each other": not frames["contradiction_count"],
        "no line of a ledger was lost": not frames["lines_lost"],
        "no frame was cut off by a kill": not frames["cut_off"],
        "frames were delivered": frames["delivered"] > 0,
        "no frame was rejected": not frames["rejected"],
        "the field was updated at least three times": updates["count"] >= 3,
        "every frame could be decoded": updates["undecodable"] == 0,
        "the held-out view was scored": fidelity["final"]["psnr_db"] is not None,
        "the field beats an image of the mean color": (fidelity["final"]["psnr_db"] or 0.0)
        > (baseline["mean_color_db"] or 0.0),
        "every camera reported": all(age is not None for age in report["age_ms"]["by_camera"].values()),
    }
    return [f"not true: {what}" for what, holds in checks.items() if not holds]


def main() -> int:
    found = problems(Path(sys.argv[1]))
    print("\n".join(found) if found else f"{sys.argv[1]}: the report is complete and every frame is accounted for")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
