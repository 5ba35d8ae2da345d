"""Presents a fitted channel: as text, as a scenario's YAML."""

from __future__ import annotations

from typing import Any

import yaml

from channel_emu.estimate.fit import Fit, IntervalEstimate
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
