"""A run's folder, written by the parts that write it in a real run: journal and ledgers."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from edge_server.fidelity.scorer import Score
from edge_server.live.output.journal import Journal
from edge_server.live.state import Publication
from edge_server.machine import machine, versions
from edge_server.report.build_report import assemble
from edge_server.report.report_page import render_page
from edge_server.report.run_files import read_run_files
from freshfield.files import write_json
from freshfield.ledger import Ledger

CAMERAS = ("cam00", "cam01", "cam02", "cam03")
SECONDS = 40.0
EDGE = {
    "started_ns": 1_000_000_000,
    "scenario": "sample",
    "seed": 7,
    "field": "ngp",
    "policy": "threshold",
    "value": 120.0,
    "uptime_s": SECONDS,
    "updates": {"count": 50, "ms_p50": 800.0, "ms_p95": 900.0, "first_ms": 3100.0, "undecodable": 1},
    "events": [{"t_s": 12.5, "what": "an operator reset the field"}],
    "baseline": {"mean_color_db": 14.5, "nearest_view_db": 13.8},
    "lpips_missing": None,
    "lpips_network": "alex",
    "run": {"started": "2026-02-03T04:05:06+01:00", "host": "bench", "commit": "abc1234567", "command": "edge-server"}
    | {"machine": machine(), "versions": versions()},
}
HISTOGRAM = {"edges_ms": [6.0 * i for i in range(51)], "counts": [500 * 0.9**i for i in range(50)]}
CHANNEL = {
    "changes": [
        {"at_ns": 11_000_000_000, "delay_ms": 400.0, "loss": 0.2},
        {"at_ns": 15_000_000_000, "delay_ms": None, "loss": None},
    ],
    "state_share": {"high": 0.4, "low": 0.6},
    "drawn_delay_ms": {"mean": 60.2, "p50": 41.0, "p95": 180.0, "histogram": HISTOGRAM},
    "delay_error_ms": {"p50": 0.1, "p99": 1.2, "max": 4.0},
}


def publication(number: int) -> Publication:
    """Fidelity rises to 26 dB; every tenth publication found no truth; cam03 moves nothing."""
    t_s, used, psnr = 3.1 + 0.75 * number, 2 + number % 3, 26.0 - 10.0 * 0.9**number
    ages_ms, aaoi_ms, update_ms = (80.0,) * used, 80.0 + number % 7, 740.0 + 3 * (number % 11)
    made = Publication(number, t_s, round(t_s * 1e9), 120.0, CAMERAS[:used], ages_ms, aaoi_ms, update_ms, 40)
    if number % 20 == 5:
        made = replace(made, refused=("cam02",))
    if number % 10 == 9:
        return made
    fidelity = {"psnr_db": psnr, "psnr_moving_db": psnr - 4, "ssim": psnr / 30, "lpips": 0.6 - psnr / 60}
    return replace(made, **fidelity, truth_gap_ms=3.0, scored_on="cam00")


def page_of(out: Path) -> tuple[dict, str]:
    """The report of a run and its page, without the figures, which take seconds; report.json is written."""
    report = assemble(read_run_files(out))
    write_json(out / "report.json", report)
    return report, render_page(report, {})


def write(out: Path, role: str, lines, name: str = "x", start_ns: int = 1, closed: bool = True) -> Path:
    """A real ledger. lines: (sequence, event[, detail]) of camera "a", session "s", or (camera, session, sequence,
    event[, detail])."""
    ledger = Ledger(out, role, name, start_ns)
    for t_ns, line in enumerate(lines):
        camera, session, sequence, event, *detail = ("a", "s", *line) if isinstance(line[0], int) else line
        ledger.write(t_ns, camera, session, sequence, event, *detail)
    if closed:
        ledger.close(len(lines))
    else:
        ledger._lines.close()  # as a killed process: without the line ``closed``
    return ledger.path


def write_run(out: Path, publications: int = 49, ages: int = 200) -> None:
    """The folder after a clean end."""
    journal = Journal(out, lambda: EDGE)
    rng, shown = np.random.default_rng(0), Score("cam00", 0, 24.0, 17.0, 0.8, None, 0.0, psnr_still_db=26.0)
    for i in range(ages):
        found: dict[str, float | None] = {c: 60.0 + 40.0 * float(rng.exponential()) for c in CAMERAS[1:]}
        journal.ages(0.2 * i, {**found, "never": None})
    for number in range(publications):
        journal.published(publication(number))
        journal.scored(publication(number), final=True)
        journal.shown(publication(number).t_s + 0.1, shown, replace(publication(number), network_ms=50.0))
    journal.close()
    (out / "run.json").write_text(json.dumps({"command": "freshfield demo"}))
    (out / "channel.json").write_text(json.dumps(CHANNEL))
    image = np.zeros((48, 64, 3), np.uint8)
    image[10:30, 20:40] = (40, 160, 220)
    cv2.imwrite(str(out / "truth.png"), image)
    cv2.imwrite(str(out / "rendered.png"), cv2.GaussianBlur(image, (0, 0), 2.0))
    node, emulator, edge = [], [], []
    for camera in CAMERAS:
        for i in range(50):
            at = (camera, "s1", i)
            node += [(*at, "captured"), (*at, "replaced" if i % 5 == 4 else "sent")]
            if i % 5 == 4:
                continue
            emulator += [(*at, "received"), (*at, "dropped_busy" if i % 2 else "forwarded")]
            if i % 2 == 0:
                edge.append((*at, "rejected", "crc") if i == 30 else (*at, "delivered"))
    write(out, "node", node)
    write(out, "emulator", emulator)
    write(out, "edge", edge)
    nodes = {f"node-{c}": {"rss_mb": 90.0, "cpu": 0.02, "pid": 4} for c in CAMERAS}
    others = nodes | {"emulator": {"rss_mb": 60.0, "cpu": 0.1, "pid": 3}}
    rows = [others | {"t_s": 2.0 * i, "edge": {"rss_mb": 600.0 + i, "cpu": 1.4, "pid": 2}} for i in range(20)]
    (out / "processes.jsonl").write_text("".join(json.dumps(r) + "\n" for r in rows))
