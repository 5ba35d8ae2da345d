"""The part of ``camera-node doctor`` that reckons what fixed cameras see, and draws it."""

from __future__ import annotations

from pathlib import Path

from camera_node.settings import LiveConfig, SourceConfig
from camera_node.sources.registry import open_sources
from freshfield.coverage import Camera, plan_svg, reckon
from freshfield.scenario import Scenario

_LATER = 30  # shots from the first to the one that tells whether a camera moves


def check(scenario: Scenario, config: SourceConfig, data: Path | None, plan: Path | None) -> str:
    """What the training cameras see, in words. plan: SVG file to write; None: none. Raises ValueError or OSError."""
    cameras = _fixed_cameras(scenario, config, data)
    if cameras is None:
        return "not reckoned: the cameras move"
    if not cameras:
        return "not reckoned: no camera has a pose before the run"
    coverage = reckon(list(cameras.values()))
    if plan is None:
        return f"{coverage.words}; --plan FILE.svg draws it"
    plan.write_text(plan_svg(cameras, coverage))
    return f"{coverage.words}; drawn in {plan}"


def _fixed_cameras(scenario: Scenario, config: SourceConfig, data: Path | None) -> dict[str, Camera] | None:
    """Lens and pose of each training camera that has one; None where a camera moves."""
    training = [camera for camera in scenario.cameras if camera not in scenario.held_out]
    if getattr(config, "arm", None) is not None or getattr(config, "trajectory", None) is not None:
        return None
    if isinstance(config, LiveConfig):
        from camera_node.sources.devices.live import calibrations

        known = calibrations(scenario, config)
        return {c: (k.intrinsics, k.pose.matrix()) for c, k in known.items() if c in training and k.pose is not None}
    found: dict[str, Camera] = {}
    for camera, source in open_sources(scenario, config, training, data).items():
        first, later = (source.read(source.content(tick)) for tick in (0, _LATER))
        source.release()
        if first.pose != later.pose:
            return None
        found[camera] = (first.intrinsics, first.pose.matrix())
    return found
