"""Draws candidates as seen from above the target, and the paths of plans (figure 4.7)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from edge_server.experiments.viewpoints.stage import Stage
from edge_server.report.style import CYCLE, GRAY, INK, figure
from edge_server.viewpoints.capture_planner import Plan

_A_ROW = 3  # panels per row


def draw_plan(path: Path, stage: Stage, plans: Sequence[tuple[str, Plan]]) -> None:
    """Draw one panel for each (title, plan): the candidates, colored by their value at the plan's last
    choice, and its path."""
    candidates = stage.candidates
    azimuth = np.arctan2(candidates.directions[:, 0], -candidates.directions[:, 1])
    zenith_deg = np.rad2deg(np.arccos(np.clip(candidates.directions[:, 2], -1.0, 1.0)))
    x, y = zenith_deg * np.sin(azimuth), -zenith_deg * np.cos(azimuth)
    columns = min(len(plans), _A_ROW)
    with figure(path, -(-len(plans) // columns), columns, height_inch=5.0 / columns + 0.8) as (fig, axes):
        for at in axes.ravel()[len(plans) :]:
            at.axis("off")
        for at, (title, plan) in zip(axes.ravel(), plans):
            none = np.full(len(candidates), np.nan)
            values = plan.stops[-1].values if len(plan.stops) > 1 else none
            known, lost = np.isfinite(values), ~candidates.reachable
            at.scatter(x[lost], y[lost], marker="x", s=14, color=GRAY, linewidths=0.8, label="not reachable")
            at.scatter(x[~lost & ~known], y[~lost & ~known], s=10, color=GRAY, label="taken or closed")
            shown = at.scatter(x[known], y[known], c=values[known], s=16, cmap="viridis")
            if known.any() and len(plans) == 1:
                fig.colorbar(shown, ax=at, label="value at the last choice")
            order = plan.order
            at.plot(x[order], y[order], color=CYCLE[1], linewidth=1.0)
            for n, k in enumerate(order, 1):
                at.annotate(str(n), (x[k], y[k]), color=INK, fontsize=7, textcoords="offset points", xytext=(3, 3))
            at.set_aspect("equal")
            at.set_title(f"{stage.name}, {title}: {plan.path_m:.2f} m", fontsize=8.5)
            at.set_xlabel("from above: degrees from the zenith")
        if not candidates.reachable.all():
            axes[0, 0].legend(loc="lower left", fontsize=7)
