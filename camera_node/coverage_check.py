"""The part of ``camera-node doctor`` that reckons what fixed cameras see, and draws it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from camera_node.settings import LiveConfig, SourceConfig
from camera_node.sources.base import Source
from camera_node.sources.registry import open_sources
from freshfield.coverage import Camera, plan_svg, reckon
from freshfield.scenario import Scenario

# What `room` reached with so many cameras, dB of the whole image and where it moves: with depth sensors
# (docs/results/few-cameras.json), and without (docs/fields.md).
REACHED_WITH_DEPTH = {2: (22.2, 18.4), 3: (24.5, 21.2), 4: (26.0, 22.0)}
REACHED = {2: (15.2, 16.1), 3: (18.1, 19.4), 4: (20.2, 21.4), 6: (25.2, 23.4), 8: (27.0, 24.6), 12: (29.2, 25.3)}
_TICKS = (0, 7, 30)  # whose shots tell whether a camera moves that never repeats one


def check(scenario: Scenario, config: SourceConfig, data: Path | None, plan: Path | None) -> str:
    """What the training cameras see, in words. plan: SVG file to write; None: none. Raises ValueError or OSError."""
    cameras = _fixed_cameras(scenario, config, data)
    if cameras is None:
        return "not reckoned: the cameras move"
    if not cameras:
        return "not reckoned: no camera has a pose before the run"
    coverage = reckon(list(cameras.values()))
    found = f"{coverage.words}. {_expected(len(cameras), _measures_depth(config))}"
    if plan is None:
        return f"{found}; --plan FILE.svg draws what they see"
    plan.write_text(plan_svg(cameras, coverage))
    return f"{found}; drawn in {plan}"


def _measures_depth(config: SourceConfig) -> bool:
    return bool(config.depth_every) and ("depth_sensor" in config.effects or config.kind in ("realsense", "oak"))


def _expected(cameras: int, depth: bool) -> str:
    """What was measured with as many cameras, or the next fewer."""
    reached = REACHED_WITH_DEPTH if depth else REACHED
    known = [count for count in reached if count <= cameras]
    if not known:
        return "One camera alone shows its own view, and little else"
    whole_db, moving_db = reached[known[-1]]
    sensors = "with depth sensors" if depth else "without depth sensors"
    return (
        f"The shipped room before {known[-1]} cameras {sensors} was shown at {whole_db:g} dB, {moving_db:g} where it "
        "moves; above some 25 dB a picture looks right, one mean color reaches some 15"
    )


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
        return [source.content(tick) for tick in _TICKS]
    return range(0, source.contents, -(-source.contents // 3))
