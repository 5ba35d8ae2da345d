"""The figures of a report, one function each. A function returns False if its data are missing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from matplotlib.axes import Axes

from edge_server.edge_constants import ERROR_GAIN
from edge_server.fidelity.scorer import SELECTED, fidelity_title
from edge_server.matplotlib_figures import BLUE, GRAY, GREEN, INK, ORANGE, PURPLE, SKY, VERMILION, figure, label_lines
from edge_server.report import report_constants as tuned
from edge_server.report.run_files import RunFiles

Report = dict[str, Any]


def draw_all(report: Report, files: RunFiles) -> dict[str, Path]:
    """Write every figure that has data into the run's folder. Returns their paths by name, in reading order.
    Figures of an earlier report that are not drawn again are removed."""
    drawn = {}
    for name, draw in FIGURES.items():
        path = files.out / f"figure-{name}.png"
        path.unlink(missing_ok=True)
        if draw(report, files, path):
            drawn[name] = path
    return drawn


def draw_fidelity(report: Report, files: RunFiles, path: Path) -> bool:
    """PSNR (whole image, moving pixels, both baselines), SSIM and LPIPS at every publication; of held-out cameras that
    move, PSNR and SSIM of the newest frame and of all so far."""
    series, found = report["fidelity"]["series"], report["fidelity"]
    if found["so_far"] is not None and _draw_so_far(report, files, path):
        return True  # runs of earlier versions kept no such rows
    if not _points(series, "psnr_db")[0]:
        return False
    scored = any(_points(series, name)[0] for name in ("ssim", "lpips"))
    with figure(path, 2 if scored else 1, height_inch=2.5, sharex=True) as (_, axes):
        top = axes[0, 0]
        _plot(top, series, "psnr_db", BLUE, "whole image")
        _plot(top, series, "psnr_moving_db", VERMILION, "moving pixels")
        _plot_baselines(top, report)
        fit = report["kind"] == "fit"
        title = fidelity_title(found["scored_on"])
        if fit and SELECTED not in found["scored_on"]:
            title = "Fidelity on held-out views"
        label_lines(top, "PSNR (dB)", title=title)
        seconds = "seconds of fitting" if fit else "seconds since the edge started"
        _mark(axes, report)
        if len(axes) == 1:
            top.set_xlabel(seconds)
            return True
        bottom = axes[1, 0]
        _plot(bottom, series, "ssim", GREEN, "SSIM (higher is better)")
        network = found.get("lpips_network") or "network unknown"
        _plot(bottom, series, "lpips", ORANGE, f"LPIPS-{network} (lower is better)")
        bottom.set_ylim(0.0, 1.02)
        drawn = bottom.get_legend_handles_labels()[1]  # without the marks of events, which are lines, too
        label_lines(bottom, "score" if len(drawn) > 1 else drawn[0], seconds)
    return True


def _draw_so_far(report: Report, files: RunFiles, path: Path) -> bool:
    rows = [{"t_s": row.t_s, **msgspec.to_builtins(row.so_far)} for row in files.shown if row.so_far is not None]
    if not rows:
        return False
    poses = ", at refined poses" if report["fidelity"]["so_far"]["refined"] else ""
    with figure(path, 2, height_inch=2.5, sharex=True) as (_, axes):
        top, bottom = axes[:, 0]
        for ax, score in ((top, "psnr_db"), (bottom, "ssim")):
            _plot(ax, rows, f"now_{score}", SKY, "newest held-out frame")
            _plot(ax, rows, f"all_{score}", BLUE, "all held-out frames so far")
        _plot_baselines(top, report)
        label_lines(top, "PSNR (dB)", title=f"Fidelity on a held-out camera that moves{poses}")
        bottom.set_ylim(0.0, 1.02)
        label_lines(bottom, "SSIM", "seconds since the edge started")
        _mark(axes, report)
    return True


def _plot_baselines(axes: Axes, report: Report) -> None:
    flat = {"nearest_view_db": "nearest view", "mean_color_db": "mean color"}
    for (key, label), dash in zip(flat.items(), ("--", ":")):
        if (level := report["fidelity"]["baseline"].get(key)) is not None:
            axes.axhline(level, color=GRAY, linestyle=dash, linewidth=1.2, label=label)


def draw_ages(report: Report, files: RunFiles, path: Path) -> bool:
    """Age over time (median and range over cameras, mean age of what was selected), and by camera."""
    rows = [r for r in files.ages if any(a is not None for a in r.age_ms.values())]
    if not rows or report["age_ms"] is None:
        return False
    spreads = {c: s for c, s in report["age_ms"]["by_camera"].items() if s is not None}
    if not spreads:
        return False
    t = [r.t_s for r in rows]
    known = [[a for a in r.age_ms.values() if a is not None] for r in rows]
    low, mid, high = (np.array([np.percentile(k, p) for k in known]) for p in (0, 50, 100))
    aaoi = _points(report["fidelity"]["series"], "aaoi_ms")
    with figure(path, 2, height_inch=2.6) as (_, axes):
        over_time, by_camera = axes[:, 0]
        over_time.fill_between(t, low, high, color=SKY, alpha=0.35, linewidth=0, label="all cameras")
        over_time.plot(t, mid, color=BLUE, label="median camera")
        if len(aaoi[0]):
            over_time.plot(*aaoi, color=VERMILION, linewidth=1.2, label="selected views, at publication")
        over_time.set_ylim(0, _robust_top([*high, *aaoi[1]]))
        label_lines(over_time, "age (ms)", "seconds since the edge started", "Age of information")
        _mark(axes[:1], report)
        x = np.arange(len(spreads))
        mean, p50, p95 = (np.array([s[k] for s in spreads.values()]) for k in ("mean", "p50", "p95"))
        by_camera.vlines(x, p50, p95, color=SKY, linewidth=5, label="median to 95 %")
        by_camera.plot(x, mean, "o", color=BLUE, markersize=4.5, label="mean")
        step = max(1, -(-len(x) // tuned.MOST_LABELS))
        by_camera.set_xticks(x[::step], list(spreads)[::step], rotation=60, ha="right", fontsize=8)
        by_camera.set_ylim(bottom=0)
        by_camera.grid(axis="x", visible=False)
        label_lines(by_camera, "age (ms)", title="Age by camera")
    return True


def draw_updates(report: Report, files: RunFiles, path: Path) -> bool:
    """Time of every update, and how many views it used."""
    series = report["fidelity"]["series"]
    spent = _points(series, "update_ms")
    if not len(spent[0]) or report["kind"] == "fit":
        return False
    counts = [(r["t_s"], len(used) if isinstance(used := r.get("selected"), list) else 0) for r in series]
    with figure(path, 2, height_inch=1.9, sharex=True) as (_, axes):
        top, bottom = axes[:, 0]
        top.plot(*spent, ".", color=BLUE, markersize=4, label="each update")
        top.axhline(report["updates"]["ms_p50"], color=INK, linewidth=1.0, label="median")
        top.set_ylim(0, _robust_top(spent[1]))
        label_lines(top, "ms", title="From decision to publication")
        bottom.step(*zip(*counts), where="post", color=GREEN)
        bottom.set_ylim(bottom=0)
        label_lines(bottom, "views used", "seconds since the edge started")
        _mark(axes, report)
    return True


def draw_channel(report: Report, files: RunFiles, path: Path) -> bool:
    """Share of time in each state of the chain, and the histogram of drawn delays."""
    if report["channel"] is None:
        return False
    shares, drawn = files.channel.state_share or {}, files.channel.drawn_delay_ms
    histogram = drawn.histogram if drawn and drawn.histogram and sum(drawn.histogram.counts) > 0 else None
    if not shares and histogram is None:
        return False
    ratios = [1] * bool(shares) + [2] * (histogram is not None)
    with figure(path, 1, len(ratios), height_inch=2.7, width_ratios=ratios) as (_, axes):
        left, right = axes[0, 0], axes[0, -1]
        if shares:
            left.bar(range(len(shares)), [100 * s for s in shares.values()], color=SKY, width=0.6)
            left.set_xticks(range(len(shares)), list(shares))
            left.set_ylim(0, 100)
            left.grid(axis="x", visible=False)
            label_lines(left, "% of the time", "state of the channel", "Channel states")
        if drawn and histogram:
            edges, counts = np.array(histogram.edges_ms), np.array(histogram.counts)
            width = np.diff(edges)
            right.bar(edges[:-1], counts / counts.sum() / width, width, align="edge", color=BLUE, alpha=0.85)
            if drawn.mean is not None:
                right.axvline(drawn.mean, color=VERMILION, linewidth=1.4, label=f"mean {drawn.mean:.1f} ms")
                right.legend()
            right.set_xlim(0, edges[-1])
            right.set_yticks([])
            label_lines(right, "density", "drawn delay (ms)", "Drawn delays")
    return True


def draw_comparison(report: Report, files: RunFiles, path: Path) -> bool:
    """The last scored image beside the field's rendering of it, and the absolute error."""
    truth, rendered = _image(files, "truth"), _image(files, "rendered")
    if truth is None or rendered is None or truth.shape != rendered.shape:
        return False
    error = np.clip(np.abs(truth - rendered) * ERROR_GAIN, 0.0, 1.0)
    height = 2.75 * truth.shape[0] / truth.shape[1] + 0.35
    with figure(path, 1, 3, height_inch=height) as (_, axes):
        truth_is = "held-out truth" if report["kind"] == "fit" else "truth at the present"
        if SELECTED in report["fidelity"]["scored_on"]:
            truth_is = "a training view"
        titles = (truth_is, "the field's rendering", f"error, {ERROR_GAIN:g} times")
        for ax, image, title in zip(axes[0], (truth, rendered, error), titles):
            ax.imshow(image, interpolation="nearest")
            ax.set_title(title)
            ax.set_axis_off()
    return True


def draw_processes(report: Report, files: RunFiles, path: Path) -> bool:
    """Memory and processor time of every process."""
    names = sorted({n for row in files.processes for n, v in row.items() if _is_usage(v)} - {"machine"})
    if not names:
        return False
    # Camera processes can be many: their sum keeps the legend readable.
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(name if name in ("edge", "emulator") else "camera nodes", []).append(name)
    with figure(path, 2, height_inch=1.9, sharex=True) as (_, axes):
        top, bottom = axes[:, 0]
        for (group, members), color in zip(groups.items(), (BLUE, VERMILION, GREEN, PURPLE)):
            rows = [r for r in files.processes if any(_is_usage(r.get(m)) for m in members)]
            t = [r["t_s"] for r in rows]
            for ax, key, label in ((top, "rss_mb", group), (bottom, "cpu", None)):
                total = [sum(r[m][key] for m in members if _is_usage(r.get(m))) for r in rows]
                ax.plot(t, total, color=color, label=label)
        top.set_ylim(bottom=0)
        bottom.set_ylim(bottom=0)
        label_lines(top, "resident (MB)", title="Memory and processor time of the processes")
        label_lines(bottom, "cores", "seconds since the start")
        _mark(axes, report)
    return True


def draw_frontier(report: Report, files: RunFiles, path: Path) -> bool:
    """The measured trade-off of accuracy against time (OUT/frontier.json), and the run's own point: PSNR as shown in
    its last fifth, against the time from one update to the next."""
    measured, shown = files.frontier, report["fidelity"]["shown"]
    late_s = report["fidelity"]["late_s"]
    late = [(row.t_s, row.number) for row in files.series if row.t_s >= late_s and row.number is not None]
    updates = late[-1][1] - late[0][1] if late else 0  # not all have a row
    if measured is None or not measured.points or shown["psnr_db"] is None or not updates > 0:
        return False
    update_s = (late[-1][0] - late[0][0]) / updates
    with figure(path, height_inch=2.6) as (_, ((ax,),)):
        update_ms, *both = np.array(sorted((p.update_ms, p.psnr_db, p.psnr_moving_db) for p in measured.points)).T
        for psnr_db, dashes, about in zip(both, ("-", "--"), ("measured, whole image", "measured, moving")):
            ax.plot(update_ms / 1e3, psnr_db, dashes, color=BLUE, marker=".", label=about)
        for key, label in (("psnr_db", "this run, shown"), ("psnr_moving_db", None)):
            if shown[key] is not None:
                ax.plot([update_s], [shown[key]], "o", color=VERMILION, markersize=8, label=label)
        ax.set_xscale("log")
        label_lines(ax, "PSNR (dB)", "seconds an update takes", f"Measured: {measured.about}")
    return True


FIGURES: dict[str, Callable[[Report, RunFiles, Path], bool]] = {
    "comparison": draw_comparison,
    "fidelity": draw_fidelity,
    "ages": draw_ages,
    "updates": draw_updates,
    "frontier": draw_frontier,
    "channel": draw_channel,
    "processes": draw_processes,
}


def _image(files: RunFiles, name: str) -> np.ndarray | None:
    """An image of the run as RGB (H, W, 3) in [0, 1], or None."""
    image = cv2.imread(str(files.images[name])) if name in files.images else None
    return None if image is None else np.asarray(image)[..., ::-1] / 255.0


def _points(series: list[dict[str, Any]], name: str) -> tuple[list[float], list[float]]:
    """Times and values of the rows that have a value."""
    rows = [r for r in series if r.get(name) is not None]
    return [r["t_s"] for r in rows], [r[name] for r in rows]


def _plot(axes: Axes, series: list[dict[str, Any]], name: str, color: str, label: str) -> None:
    """Draw the values of a row's entry over time, where there are any."""
    points = _points(series, name)
    if points[0]:
        axes.plot(*points, color=color, label=label)


def _mark(axes: np.ndarray, report: Report) -> None:
    """Mark the report's events, by their numbers in its list, on curves over time. axes: (rows, columns)."""
    for number, event in enumerate(report["events"], 1):
        for ax in axes.flat:
            ax.axvline(event["t_s"], color=PURPLE, linestyle=":", linewidth=1.0)
        top = axes.flat[0]
        at = {"xycoords": ("data", "axes fraction"), "xytext": (2, -1), "textcoords": "offset points", "va": "top"}
        top.annotate(str(number), (event["t_s"], 1.0), **at, color=PURPLE, fontsize=8)


def _robust_top(values: list[float]) -> float:
    """An axis limit that a single outlier (a start, a kill) does not set."""
    return 1.25 * float(np.percentile(values, 99)) + 1e-9 if len(values) else 1.0


def _is_usage(value: Any) -> bool:
    return isinstance(value, dict) and None not in (value.get("rss_mb"), value.get("cpu"))
