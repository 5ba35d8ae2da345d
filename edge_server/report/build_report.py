"""Builds report.json, report.html and the figures of a run from the files in its folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from edge_server.report.conclusion import conclusion
from edge_server.report.events import events
from edge_server.report.frame_accounting import account_frames
from edge_server.report.run_files import RunFiles, read_run_files
from edge_server.report.run_statistics import ages, depth, fidelity, last_share_s, shown, updates
from edge_server.run_records import UpdateCounts
from freshfield.files import write_json, write_text
from freshfield.machine_load import outside_load


def build_report(out_dir: str | Path) -> dict[str, Any]:
    """Write report.json, report.html and PNGs into the run's folder; returns what report.json holds.

    Works with whatever files exist: after a kill, without the files of other machines, without a channel. ``notes``
    lists what was missing. Raises FileNotFoundError if the folder does not exist.
    """
    # Lazy: only the figures need matplotlib.
    from edge_server.report.figures import draw_all
    from edge_server.report.report_page import render_page

    out = Path(out_dir)
    files = read_run_files(out)
    report = assemble(files)
    write_json(out / "report.json", report, indent=1)
    figures = draw_all(report, files)
    write_text(out / "report.html", render_page(report, figures))
    return report


def assemble(files: RunFiles) -> dict[str, Any]:
    """The contents of report.json. ``kind``: live, or fit for a recorded data set without a network, whose
    frames, ages and channel are None; or simulated, in virtual time. ``run``: facts that the run recorded itself."""
    edge, series = files.edge, files.series
    notes = list(files.notes)
    if edge.lines_lost:
        notes.append(f"the edge could not write {edge.lines_lost} lines of its results (a full disk?)")
    notes += edge.troubles
    accounting = account_frames(files.out)
    seconds = max(edge.seconds or edge.uptime_s or 0.0, series[-1].t_s if series else 0.0)
    counted = updates(series, edge.updates or UpdateCounts(), restarted=bool(files.restarts_s))
    first_ms, ended_s = None, seconds
    if edge.kind == "live":
        first_ms = counted["first_ms"]
        ended_s = max((rows[-1].t_s for rows in (files.ages, series) if rows), default=seconds)
    late_s = last_share_s(first_ms, ended_s)
    report = {
        "kind": edge.kind,
        "scenario": edge.scenario,
        "seed": edge.seed,
        "seconds": seconds,
        "field": edge.field,
        "chosen": edge.chosen,
        "policy": {"name": edge.policy, "value": edge.value},
        "run": {**msgspec.to_builtins(edge.run), **({"command": files.command} if files.command else {})},
        "events": events(files),
        "outside_load": outside_load(files.processes),
        "frames": {**accounting.as_dict(), "ledgers": accounting.ledgers},
        "age_ms": ages(files.ages),
        "updates": counted,
        "foreground": edge.foreground,
        "fidelity": {**fidelity(series, late_s, edge), "shown": shown(files.shown, series, late_s, ended_s)},
        "channel": msgspec.to_builtins(files.channel),
        "notes": notes + accounting.notes,
    }
    if edge.depth is not None:
        report["depth"] = depth(edge.depth, files.ages)
    if edge.kind == "simulated":
        report |= {"frames": None, "age_ms": None, "notes": edge.troubles}  # simulation.json counts frames
    if edge.kind == "fit":
        data = msgspec.to_builtins(edge.data)
        report |= {"data": data, "frames": None, "age_ms": None, "channel": None, "notes": []}
    report["conclusion"] = conclusion(report)
    return report
