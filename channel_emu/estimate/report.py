"""Presents a fitted channel: as text, as a scenario's YAML, as a plot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from channel_emu.estimate.fit import Fit, IntervalEstimate
from freshfield.files import picture
from freshfield.untrusted import YamlWriter

_MIN_FRAMES, _MAX_FRAMES, _CYCLES = 300, 4000, 40
_COLORS, _GRAY = ("#0072B2", "#D55E00"), "#777777"


def format_fit(fit: Fit) -> str:
    """Text with the estimates and their intervals, warnings, and the section to copy into a scenario."""
    summary = fit.summary()
    lines = [
        f"{summary['file']}: {summary['frames']:,} frames of {summary['cameras']} cameras in "
        f"{summary['seconds']:g} s, {summary['delays']:,} delays; arrivals {fit.arrivals}",
        f"states {fit.states}, by {fit.chosen_by}" + _bic_difference(fit.bic),
        *(_row(name, value) for name, value in fit.parameters.items()),
    ]
    if fit.states == 2:
        names = fit.channel["chain"]["states"]
        stay = [1 / fit.parameters[f"mu{i}_per_ms"].value for i in (1, 2)]
        share = stay[0] / sum(stay)
        lines.append(
            f"  a visit lasts {stay[0]:.4g} ms in {names[0]}, {stay[1]:.4g} ms in {names[1]}; "
            f"shares of time {share:.3f}, {1 - share:.3f}"
        )
    lines.append("how frames fail to come")
    lines += [_row(name, value) for name, value in fit.bursts.items()]
    lines.append(f"intervals: {summary['intervals']}")
    lines += [f"note: {warning}" for warning in fit.warnings]
    return "\n".join([*lines, "", _yaml({"channel": fit.channel}).rstrip()])


def scenario_text(fit: Fit) -> str:
    """Text of a scenario file with the fitted channel, for ``simulate --scenario``; it has no source."""
    cameras = [camera.name for camera in fit.recording.cameras]
    head = f"# Fitted to {fit.recording.path.name}: {fit.recording.frames} frames, states by {fit.chosen_by}\n"
    document = {"name": "fitted", "seed": 0, "cameras": {"count": len(cameras)}, "channel": fit.channel}
    return head + _yaml(document)


def plot(fit: Fit, path: Path) -> None:
    """Plot delays and the second state's probability over time to ``path``; only the first part of a long
    recording. Raises PlotError."""
    cameras = fit.recording.cameras
    start_s = np.concatenate([c.started_ms for c in cameras]) / 1e3
    delay_ms = np.concatenate([c.delay_ms for c in cameras])
    has_delay = ~np.isnan(delay_ms)
    order = np.argsort(start_s[has_delay], kind="stable")[: _plotted_frames(fit, np.sort(start_s[has_delay]))]
    start_s, delay_ms = start_s[has_delay][order], delay_ms[has_delay][order]
    two = fit.states == 2
    ratios = [3, 1] if two else [1]
    with picture(path, 1 + two, 1, sharex=True, size=(9, 3 + 1.5 * two), height_ratios=ratios) as axes:
        top = axes[0, 0]
        top.set_ylabel("delay (ms)")
        if two:
            _draw_states(fit, axes[:, 0], start_s, delay_ms)
        else:
            mean = fit.parameters["mean_ms"].value
            top.scatter(start_s, delay_ms, s=5, color=_GRAY)
            top.axhline(mean, color=_COLORS[0], lw=0.8, label=f"mean {mean:.3g} ms")
        if top.get_legend_handles_labels()[0]:
            top.legend(loc="upper right")
        axes[-1, 0].set_xlabel("start of transmission (s)")


def _plotted_frames(fit: Fit, start_s: np.ndarray) -> int:
    """Number of frames to plot: about forty visits to each state, so that single visits are visible."""
    if fit.states == 1 or not len(start_s):
        return _MAX_FRAMES
    cycle_s = sum(1 / fit.parameters[f"mu{i}_per_ms"].value for i in (1, 2)) / 1e3
    wanted = int(np.searchsorted(start_s, start_s[0] + _CYCLES * cycle_s))
    return min(max(wanted, _MIN_FRAMES), _MAX_FRAMES)


def _draw_states(fit: Fit, axes: Any, start_s: np.ndarray, delay_ms: np.ndarray) -> None:
    """Draw delays colored by the state's probability, the means, and below the probability over time."""
    names, (top, bottom) = fit.channel["chain"]["states"], axes
    bottom.set(ylim=(-0.05, 1.05), ylabel=f"P({names[1]})")
    for i, (name, color) in enumerate(zip(names, _COLORS), start=1):
        if f"mean_{i}_ms" in fit.parameters:
            mean = fit.parameters[f"mean_{i}_ms"].value
            top.axhline(mean, color=color, lw=0.8, label=f"{name}: mean {mean:.3g} ms")
    for (at_ms, _, _), states in zip(fit.lines, fit.second_state):
        at_s = at_ms / 1e3
        bottom.plot(at_s[at_s <= start_s[-1]], states[at_s <= start_s[-1]], lw=0.8, color=_COLORS[1])
        if len(fit.lines) == 1:
            second = states[np.minimum(np.searchsorted(at_s, start_s), len(at_s) - 1)]
            drawn = top.scatter(start_s, delay_ms, c=second, s=8, cmap="coolwarm", vmin=0, vmax=1)
            top.figure.colorbar(drawn, ax=top, label=f"P({names[1]})")
    if len(fit.lines) > 1:
        top.scatter(start_s, delay_ms, s=5, color=_GRAY)


def _bic_difference(bic: dict[int, float]) -> str:
    if len(bic) < 2:
        return ""
    better = "one" if bic[1] <= bic[2] else "two"
    return f" (that of {better} is {abs(bic[1] - bic[2]):.1f} lower; 10 is strong evidence)"


def _row(name: str, value: IntervalEstimate) -> str:
    interval = "" if value.interval is None else f"  [{value.interval[0]:.5g}, {value.interval[1]:.5g}]"
    return f"  {name:34} {value.value:10.5g}{interval}"


def _yaml(document: dict[str, Any]) -> str:
    return yaml.dump(document, Dumper=YamlWriter, sort_keys=False, default_flow_style=None, width=100)
