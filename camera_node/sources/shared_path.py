"""Held-out frames of cameras that are carried about: every n-th capture of a camera's path is not trained on.

No second camera sees what a moving one sees, so it is divided between two cameras of the scenario, the training camera
and its held-out camera, with all its errors of pose and exposure (``cameras.held_out_every``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from camera_node.capture_schedule import PartialSchedule, RateSchedule
from camera_node.settings import McapConfig, SourceConfig
from camera_node.sources.base import Derived, Source
from freshfield.scenario import Scenario, ScenarioError


class PathShare(Derived):
    """The captures of ``source`` that one of two cameras sends.

    every: of so many captures the first is held out.
    held_out: this camera sends those; otherwise the others, numbered without a gap.
    """

    def __init__(self, source: Source, camera: str, every: int, held_out: bool) -> None:
        super().__init__(source, camera)
        self.fps = source.fps / every if held_out else source.fps
        self._every = every
        self._others = None if held_out else PartialSchedule(source.fps, source.phase_ns, every)

    def rate_schedule(self) -> RateSchedule:
        return self._others or super().rate_schedule()

    def content(self, tick: int) -> int:
        return self._source.content(self._others.whole(tick) if self._others else tick * self._every)


def check_divisible(scenario: Scenario, config: SourceConfig) -> None:
    """Raises ScenarioError if the captures of this source cannot be divided."""
    if config.waits or isinstance(config, McapConfig) or getattr(config, "arm", None) is not None:
        raise ScenarioError(
            f"{scenario.path}: cameras.held_out_every: needs a recorded data set or a synthetic world: two processes "
            "cannot read one device"
        )


def divide(scenario: Scenario, opened: Mapping[str, Source], cameras: Sequence[str]) -> dict[str, Source]:
    """The shares of ``cameras``. opened: the sources of their paths, by training camera. Raises ScenarioError."""
    every = scenario.held_out_every
    for camera, source in opened.items():
        after = source.repeats_after
        if after is not None and after % every:
            raise ScenarioError(
                f"{scenario.path}: cameras.held_out_every: {camera}'s path repeats after {after} captures, expected a "
                f"multiple of {every}: others would be held out in the next round"
            )
    return {c: PathShare(opened[scenario.path_of(c)], c, every, c in scenario.held_out) for c in cameras}
