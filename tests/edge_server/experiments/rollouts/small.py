"""A small deployment whose decisions cost milliseconds: real cameras, channel and fits."""

from pathlib import Path
from typing import Any

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.rollouts.setting import Setting
from freshfield.scenario import Scenario, parse
from tests.support import small_world

NOTHING = Folders()
FIELD = {"gaussians": 128, "start": 96, "seed_cells": 8}


RAW: dict[str, Any] = {
    "name": "small",
    "seed": 3,
    "cameras": {"count": 5, "held_out": ["cam00"]},
    "source": small_world(width=24, height=24, speed_m_per_s=2.0),
    "channel": {"preset": "ch5"},
    "edge": {"field": "splat", "field_options": FIELD, "updates": "cycle", "lpips": "none"},
}


def scenario(channel: dict[str, Any] | None = None, **other: Any) -> Scenario:
    data = {**RAW, **other}
    return parse(data if channel is None else {**data, "channel": channel}, Path("small.yaml"))


def setting(channel: dict[str, Any] | None = None, **more: Any) -> Setting:
    """One held-out camera, updates from nothing and one motion, unless ``more`` says otherwise."""
    sizes: dict[str, Any] = {"steps": 4, "decisions": 2, "lead_ms": 800.0, "span_ms": 600.0, "warm_steps": 6}
    return Setting(scenario(channel), **{**sizes, "scratch": True, "motions": False, **more})
