"""The part of ``camera-node doctor`` that reckons what fixed cameras see, and draws it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from camera_node.doctor import doctor_constants as tuned
from camera_node.settings import LiveConfig, SourceConfig
from camera_node.sources.base import Source
from camera_node.sources.registry import open_sources
from freshfield.coverage import Camera, plan_svg, reached, reckon
from freshfield.scenario import Scenario


def check(scenario: Scenario, config: SourceConfig, data: Path | None, plan: Path | None) -> str:
    """What the training cameras see, in words. plan: SVG file to write; None: none. Raises ValueError or OSError."""
    cameras = _fixed_cameras(scenario, config, data)
    if cameras is None:
        return (
            "not reckoned: the cameras move, so what they see depends on their way: let them see each surface from "
            "several sides"
        )
    if not cameras:
        return (
            "not reckoned: no camera has a pose before the run: name the file of camera-node calibrate rig as "
            "source.calibration"
        )
    coverage = reckon(list(cameras.values()))
    found = f"{coverage.words}. {reached(len(cameras), _measures_depth(config))}"
    if plan is None:
        return f"{found}; --plan FILE.svg draws what they see"
    plan.write_text(plan_svg(cameras, coverage))
    return f"{found}; drawn in {plan}"


def _measures_depth(config: SourceConfig) -> bool:
    return bool(config.depth_every) and ("depth_sensor" in config.effects or config.kind in ("realsense", "oak"))


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
        first, *later = (source.read(content) for content in _compared(source))
        source.release()
        if any(shot.pose != first.pose for shot in later):
            return None
        found[camera] = (first.intrinsics, first.pose.matrix())
    return found


def _compared(source: Source) -> Sequence[int]:
    """Numbers of the shots whose poses are compared: up to three, spread over those that repeat."""
    if source.contents is None:
        return [source.content(tick) for tick in tuned.COVERAGE_TICKS]
    return range(0, source.contents, -(-source.contents // 3))
