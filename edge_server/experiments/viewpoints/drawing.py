"""Draws the candidates of a plan as seen from above the target, and its path (figure 4.7)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from edge_server.experiments.viewpoints.stage import Stage
from edge_server.matplotlib_figures import CYCLE, GRAY, INK, figure
from edge_server.viewpoints.capture_planner import Plan


def draw_plan(path: Path, stage: Stage, plan: Plan) -> None:
    """Draw the candidates, colored by their value at the plan's last choice, and its path."""
    candidates = stage.candidates
    azimuth = np.arctan2(candidates.directions[:, 0], -candidates.directions[:, 1])
    zenith_deg = np.rad2deg(np.arccos(np.clip(candidates.directions[:, 2], -1.0, 1.0)))
    x, y = zenith_deg * np.sin(azimuth), -zenith_deg * np.cos(azimuth)
    values = plan.stops[-1].values if len(plan.stops) > 1 else np.full(len(candidates), np.nan)
    known, lost = np.isfinite(values), ~candidates.reachable
    with figure(path, 1, height_inch=5.8) as (fig, axes):
        at = axes[0, 0]
        at.scatter(x[~lost & ~known], y[~lost & ~known], s=10, color=GRAY, label="taken or closed")
        if lost.any():
            at.scatter(x[lost], y[lost], marker="x", s=14, color=GRAY, linewidths=0.8, label="not reachable")
            at.legend(loc="lower left", fontsize=7)
        shown = at.scatter(x[known], y[known], c=values[known], s=16, cmap="viridis")
        if known.any():
            fig.colorbar(shown, ax=at, label="value at the last choice")
        at.plot(x[plan.order], y[plan.order], color=CYCLE[1], linewidth=1.0)
        for n, k in enumerate(plan.order, 1):
            at.annotate(str(n), (x[k], y[k]), color=INK, fontsize=7, textcoords="offset points", xytext=(3, 3))
        at.set_aspect("equal")
        at.set_title(f"{stage.name}, {plan.selector}: {plan.path_m:.2f} m", fontsize=8.5)
        at.set_xlabel("from above: degrees from the zenith")
