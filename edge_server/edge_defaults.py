"""What an ``edge:`` section leaves open is chosen by what the cameras do.

Where cameras stand still, ``splat`` works in layers and follows arrivals in short updates; where a camera
moves, it is a scan that chooses its own keyframes. With many cameras, with other fields, and in the thesis's cycle
(``updates: cycle``), earlier viewpoints go on supervising. docs/scheduling.md has the figures. Whatever a scenario
says itself is left as it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from freshfield.scenario import Scenario

FIELD = "splat"
ARRIVALS: dict[str, Any] = {"updates": "arrivals", "update_ms": 20.0, "steps": 10}
"""Of a field in layers that follows arrivals."""
CYCLE: dict[str, Any] = {"updates": "cycle", "update_ms": 800.0, "steps": 100}
"""Of everything else."""
CARRIED: dict[str, Any] = {"updates": "cycle", "update_ms": 150.0, "steps": 24}
"""Of a scan by cameras that move: a keyframe an update."""
MOST_CARRIED = 4
"""Cameras: photos that are dealt to twelve (``fox``) are no tracks, and read 8 dB less as a scan (19 against 27)."""
SCAN: dict[str, Any] = {"scan": True, "refine": True, "carried": True, "gaussians": 60_000}
"""Options of ``splat`` for that; few pixels bound the Gaussians further."""
CHOSEN = ("field", "layers", "updates", "update_ms", "steps", "keyframes")


def cameras_move(scenario: Scenario) -> bool:
    """Whether a scenario says that its cameras move: an arm, a trajectory or somebody carries them. Others may move,
    too, which their poses tell."""
    known = any(scenario.source.get(key) is not None for key in ("arm", "trajectory"))
    return known or bool(scenario.source.get("carried")) or bool(scenario.held_out_every)


def with_defaults(section: Mapping[str, Any], moving: bool, cameras: int) -> dict[str, Any]:
    """An ``edge:`` section with what it leaves open of field, layers, updates, update_ms, steps and keyframes.

    moving: whether a camera moves. cameras: how many are trained on. Keys that it has stay, whatever their values.
    """
    found = {"field": FIELD, **section}
    options = found.get("field_options", {})
    if not isinstance(options, dict):  # refused by who reads the section
        return found
    usual = found["field"] == FIELD and found.get("updates") != "cycle"
    if usual and not moving and "layers" not in options:
        found["field_options"] = options = {**options, "layers": True}
    layers = bool(options.get("layers"))
    if usual and moving and not layers and cameras <= MOST_CARRIED and "keyframes" not in found:
        found["field_options"] = {**SCAN, **options}
        return {**CARRIED, **found}
    if moving and not layers:
        found.setdefault("keyframes", {})
    found.setdefault("updates", (ARRIVALS if layers else CYCLE)["updates"])
    times = ARRIVALS if layers and found["updates"] == "arrivals" else CYCLE
    return {**times, **found}
