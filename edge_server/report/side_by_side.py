"""The figures of several runs as a table for a terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# label -> (keys in report.json, digits)
_ROWS: dict[str, tuple[tuple[str, ...], int]] = {
    "shown (dB)": (("fidelity", "shown", "psnr_db"), 2),
    "shown, moving pixels (dB)": (("fidelity", "shown", "psnr_moving_db"), 2),
    "published (dB)": (("fidelity", "final", "psnr_db"), 2),
    "published, refined poses (dB)": (("fidelity", "final", "psnr_refined_db"), 2),
    "SSIM": (("fidelity", "final", "ssim"), 3),
    "LPIPS": (("fidelity", "final", "lpips"), 3),
    "age, mean (ms)": (("age_ms", "mean"), 0),
    "age, p95 (ms)": (("age_ms", "p95"), 0),
    "updates": (("updates", "count"), 0),
    "an update, median (ms)": (("updates", "ms_p50"), 0),
    "frames delivered": (("frames", "delivered"), 0),
}


def side_by_side(reports: Mapping[str, Mapping[str, Any]]) -> str:
    """A table with a column for each run; rows that no run has are left out.

    reports: name of the run -> contents of report.json.
    """
    lines = [["", *reports]]
    for title, (keys, digits) in _ROWS.items():
        values = [_at(report, keys) for report in reports.values()]
        if any(value is not None for value in values):
            lines.append([title, *("-" if value is None else f"{value:.{digits}f}" for value in values)])
    widths = [max(len(line[k]) for line in lines) for k in range(len(lines[0]))]
    return "\n".join(
        "  ".join([line[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(line[1:], widths[1:]))]) for line in lines
    )


def _at(report: Mapping[str, Any], keys: tuple[str, ...]) -> float | None:
    found: Any = report
    for key in keys:
        found = found.get(key) if isinstance(found, Mapping) else None
    return float(found) if isinstance(found, int | float) else None
