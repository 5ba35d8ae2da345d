"""Writes the output of the frontier: two figures and tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes

from edge_server.experiments.common.tables import markdown_table, number
from edge_server.experiments.frontier.update_time import field_label
from edge_server.live.best_update_time import best_point, points_of
from edge_server.matplotlib_figures import CYCLE, INK, figure
from edge_server.settings import LEAST_UPDATE_MS

Row = dict[str, Any]
_METRICS = (("psnr_db", "PSNR (dB)"), ("ssim", "SSIM"), ("lpips", "LPIPS"))


def write_output(out: Path, data: Row) -> str:
    """Write frontier.png and, with a moving scene, updates.png; returns the text for the terminal."""
    rows, updates = data["from_scratch"], data["updates"]
    draw_frontier(out / "frontier.png", rows, data)
    text = [table(rows)]
    if updates:
        draw_updates(out / "updates.png", updates)
        text.append(updates_table(updates))
    return "\n\n".join(["", *text])


def table(rows: Sequence[Row]) -> str:
    """Table of representations and seconds with PSNR, SSIM and LPIPS; a star marks the Pareto front."""
    digits = {"seconds": 2, "steps": 0, "ms_per_step": 2, "psnr_db": 2, "ssim": 3, "lpips": 3}
    cells = [[row["field"], *_cells(row, digits), "*" if row["on_front"] else ""] for row in rows]
    head = ("representation", "seconds", "steps", "ms a step", "PSNR, dB", "SSIM", "LPIPS", "")
    front = "* on the Pareto front: nothing measured is both faster and more accurate"
    return f"{markdown_table(head, cells)}\n{front}"


def updates_table(rows: Sequence[Row]) -> str:
    """Table of the shown fidelity by speed and seconds per update."""
    digits = {"speed_m_per_s": 1, "update_s": 2, "steps": 0, "aaoi_ms": 0}
    digits |= {"shown_psnr_db": 2, "shown_psnr_moving_db": 2, "shown_ssim": 3, "shown_lpips": 3}
    cells = [[field_label(row["field"], row["layers"]), *_cells(row, digits)] for row in rows]
    head = "field|m/s|an update, s|steps|age, ms|shown, dB|moving|SSIM|LPIPS"
    about = "shown: at random instants, the newest publication carried on; age: of its views at publication"
    return f"{markdown_table(head.split('|'), cells)}\n{about}"


def _cells(row: Row, digits: dict[str, int]) -> list[str]:
    return [number(row[name], n) for name, n in digits.items()]


def recommendation(rows: Sequence[Row]) -> str:
    """The line that says which ``edge.update_ms`` the rows of figure 2 recommend at a person's speed; without
    rows nothing moves, and an update may take any time."""
    points = points_of(rows)
    update_ms = max(round(best_point(points).update_ms), round(LEAST_UPDATE_MS)) if points else "any"
    return f"for this scene: update_ms: {update_ms}"


def draw_frontier(path: Path, rows: Sequence[Row], data: Row) -> None:
    """Draw PSNR, SSIM and LPIPS of every representation against seconds from scratch, with the PSNR front
    marked."""
    shown = [(key, label) for key, label in _METRICS if any(row[key] is not None for row in rows)]
    fields = list(dict.fromkeys(row["field"] for row in rows))
    front = sorted((r for r in rows if r["on_front"]), key=lambda r: r["seconds"])
    with figure(path, len(shown), height_inch=2.7, sharex=True) as (fig, axes):
        for ax, (key, label) in zip(axes[:, 0], shown):
            for field, look in zip(fields, _line_styles([(field, False) for field in fields])):
                group = sorted((r for r in rows if r["field"] == field), key=lambda r: r["seconds"])
                ax.plot(
                    [r["seconds"] for r in group],
                    [r[key] for r in group],
                    marker=".",
                    **look,
                    label=f"{field} ({data['ms_per_step'][field]:.1f} ms a step)",
                )
            if key == "psnr_db":
                _encircle(ax, [r["seconds"] for r in front], [r[key] for r in front], "Pareto front")
            name = f"LPIPS-{data['lpips_network']}" if key == "lpips" else label
            ax.set_ylabel(f"{name}, {'lower' if key == 'lpips' else 'higher'} is better")
        axes[0, 0].set_title(f"What accuracy costs in time: {data['scene']}")
        axes[-1, 0].set_xlabel("seconds from scratch")
        fig.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside right upper")
        _seconds_axis(axes[-1, 0], [row["planned_s"] for row in rows])


def draw_updates(path: Path, rows: Sequence[Row]) -> None:
    """Draw the shown fidelity against seconds per update: a column for each speed, a color for each
    representation, dashed in layers, the best of all encircled."""
    speeds = list(dict.fromkeys(row["speed_m_per_s"] for row in rows))
    settings = list(dict.fromkeys((row["field"], row["layers"]) for row in rows))
    panels = (("psnr_db", "shown, whole image (dB)"), ("psnr_moving_db", "shown where it moves (dB)"))
    with figure(path, len(panels), len(speeds), height_inch=3.0, sharex=True, sharey="row") as (fig, axes):
        for row, (key, label) in enumerate(panels):
            axes[row, 0].set_ylabel(label)
            for ax, speed in zip(axes[row], speeds):
                here = [r for r in rows if r["speed_m_per_s"] == speed and r[f"shown_{key}"] is not None]
                for who, look in zip(settings, _line_styles(settings)):
                    group = sorted((r for r in here if (r["field"], r["layers"]) == who), key=lambda r: r["update_s"])
                    x = [r["update_s"] for r in group]
                    shown = [r[f"shown_{key}"] for r in group]
                    ax.plot(x, shown, marker=".", linewidth=1.2, label=field_label(*who), **look)
                if here:
                    top = max(here, key=lambda row: row[f"shown_{key}"])
                    _encircle(ax, [top["update_s"]], [top[f"shown_{key}"]], "best")
        for ax, speed in zip(axes[0], speeds):
            ax.set_title(f"{speed:g} m/s")
        for ax in axes[-1]:
            ax.set_xlabel("seconds an update takes")
            _seconds_axis(ax, [row["planned_update_s"] for row in rows])
            ax.tick_params(axis="x", labelrotation=90)
        fig.suptitle("More is not always better: the world moves while the field is fitted")
        fig.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside right center")


def _encircle(axes: Axes, x: Sequence[float], y: Sequence[float], label: str) -> None:
    axes.plot(x, y, "o", markersize=9, mfc="none", color=INK, label=label)


def _line_styles(settings: Sequence[tuple[str, bool]]) -> list[Row]:
    """Color and line style of each representation, in layers or not."""
    fields = list(dict.fromkeys(field for field, _ in settings))
    return [
        {"color": CYCLE[fields.index(field) % len(CYCLE)], "linestyle": "--" if layers else "-"}
        for field, layers in settings
    ]


def _seconds_axis(axes: Axes, seconds: Sequence[float]) -> None:
    """A logarithmic axis, shared by all panels, with a tick at every value that was planned."""
    axes.set_xscale("log")
    ticks = sorted(set(seconds))
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
