"""Presents a fitted channel: as text, as a scenario's YAML, as a plot."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from channel_emu.estimate import estimate_constants as tuned
from channel_emu.estimate.fit import Fit, IntervalEstimate
from freshfield.files import write_bytes
from freshfield.untrusted import YamlWriter


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
    """Plot the first delays, with the means, and below them the probability of the second state. Raises
    ValueError if matplotlib is missing or the file cannot be written."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise ValueError("a picture needs matplotlib: pip install 'freshfield[emu]'") from None
    cameras, two = fit.recording.cameras, fit.states == 2
    start_s = np.concatenate([c.started_ms for c in cameras]) / 1e3
    order = np.argsort(start_s, kind="stable")[: tuned.DRAWN_FRAMES]  # frames that did not start come last
    start_s, delay_ms = start_s[order], np.concatenate([c.delay_ms for c in cameras])[order]
    figure = Figure(figsize=(9, 3 + 1.5 * two), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1 + two, 1, squeeze=False, sharex=True, height_ratios=[3, 1][: 1 + two])
    top, bottom = axes[0, 0], axes[-1, 0]
    top.scatter(start_s, delay_ms, s=5, color="#777777")
    top.set_ylabel("delay (ms)")
    bottom.set_xlabel("start of transmission (s)")
    means = {name: value.value for name, value in fit.parameters.items() if name.startswith("mean")}
    for (name, mean_ms), color in zip(means.items(), ("#0072B2", "#D55E00")):
        top.axhline(mean_ms, color=color, lw=0.8, label=f"{name}: {mean_ms:.3g}")
    if means:
        top.legend(loc="upper right")
    if two:
        bottom.set(ylim=(-0.05, 1.05), ylabel=f"P({fit.channel['chain']['states'][1]})")
        assert fit.second_state is not None
        at_s = fit.sent[0] / 1e3
        shown = at_s <= np.nanmax(start_s)
        bottom.plot(at_s[shown], fit.second_state[shown], lw=0.8, color="#D55E00")
    drawn = io.BytesIO()
    try:
        figure.savefig(drawn, format=path.suffix[1:] or "png", dpi=120)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, drawn.getvalue())
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: cannot be drawn: {error}") from None


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
