"""What an ``edge:`` section leaves open is chosen by what the cameras do.

Where cameras stand still, ``splat`` works in layers and follows arrivals in short updates; where a camera
moves, earlier viewpoints go on supervising (keyframes). docs/scheduling.md has the figures. Whatever a
scenario says itself is left as it is; ``updates: cycle`` is the thesis's cycle, without layers.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from freshfield.scenario import Scenario

if TYPE_CHECKING:  # config imports this module
    from edge_server.config import EdgeConfig

FIELD = "splat"
ARRIVALS: dict[str, Any] = {"updates": "arrivals", "update_ms": 20.0, "steps": 10}
"""Of a field in layers that follows arrivals."""
CYCLE: dict[str, Any] = {"updates": "cycle", "update_ms": 800.0, "steps": 100}
"""Of everything else."""
_CHOSEN = ("field", "layers", "updates", "update_ms", "steps", "keyframes")


def cameras_move(scenario: Scenario) -> bool:
    """Whether a scenario says that its cameras move: an arm or a trajectory carries them. Others may move,
    too, which their poses tell."""
    return any(scenario.source.get(key) is not None for key in ("arm", "trajectory"))


def with_defaults(section: Mapping[str, Any], moving: bool) -> dict[str, Any]:
    """An ``edge:`` section with what it leaves open of field, layers, updates, update_ms, steps and keyframes.

    moving: whether a camera moves. Keys that it has stay, whatever their values.
    """
    found = {"field": FIELD, **section}
    options = found.get("field_options", {})
    if not isinstance(options, dict):  # refused by who reads the section
        return found
    usual = found["field"] == FIELD and found.get("updates") != "cycle"
    if usual and not moving and "layers" not in options:
        found["field_options"] = options = {**options, "layers": True}
    layers = bool(options.get("layers"))
    if moving and not layers:
        found.setdefault("keyframes", {})
    found.setdefault("updates", (ARRIVALS if layers else CYCLE)["updates"])
    times = ARRIVALS if layers and found["updates"] == "arrivals" else CYCLE
    return {**times, **found}


def described(scenario: Scenario, config: EdgeConfig, moving: str) -> str:
    """One line for people: how the edge works, and why.

    config: the scenario's, with defaults.
    moving: what moves, such as a camera's name; empty: nothing.
    """
    layers = " in layers" if config.field_options.get("layers") else ""
    keyframes = " with keyframes" if config.keyframes is not None else ""
    pace = "at arrivals" if config.updates == "arrivals" else "in a cycle"
    line = f"{config.field}{layers}{keyframes}, updated {pace} for {config.update_ms:g} ms"
    options = scenario.edge.get("field_options") or {}
    given = [key for key in _CHOSEN if key in scenario.edge or key in options]
    open_keys = {"layers", "updates", "keyframes"} - set(given)
    why = [f"{moving} moves" if moving else "no camera moves"] if open_keys else []
    why += [f"the scenario sets {', '.join(given)}"] if given else []
    return f"{line}: {'; '.join(why)}"
