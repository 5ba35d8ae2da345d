"""A camera's effects, and sources whose images or poses they change."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import cv2
import numpy as np

from camera_node.settings import SourceConfig, WorldConfig, errors_of
from camera_node.sources.base import Derived, Shot, Source, pixels
from freshfield.depth import DepthImage
from freshfield.scenario import Scenario, ScenarioError

if TYPE_CHECKING:
    from camera_node.synthetic.effects import Effects


def camera_effects(scenario: Scenario, config: SourceConfig, camera: str) -> Effects | None:
    """The effects of one camera, or of the camera whose captures it shows; None, without importing any, if the scenario
    lists none. Raises ScenarioError for an invalid effect, or one that needs a synthetic world."""
    if not config.effects:
        return None
    camera = scenario.path_of(camera)
    from camera_node.synthetic.effects import load_effects

    with errors_of(f"{scenario.path}: source.effects"):
        held_out = camera in scenario.held_out
        effects = load_effects(config.effects, lambda name: scenario.rng(f"effect {name}", camera), held_out, camera)
    for name, given in config.effects.items():
        if unknown := [each for each in (given or {}).get("cameras", ()) if each not in scenario.cameras]:
            raise ScenarioError(
                f"{scenario.path}: source.effects.{name}.cameras: {unknown[0]!r} is not one of the cameras"
            )
        if shares := [each for each in (given or {}).get("cameras", ()) if scenario.path_of(each) != each]:
            raise ScenarioError(
                f"{scenario.path}: source.effects.{name}.cameras: {shares[0]} shows captures of "
                f"{scenario.path_of(shares[0])}: name that one"
            )
    if config.kind != "world" and (effects.delay or effects.mount):
        raise ScenarioError(
            f"{scenario.path}: source.effects: effects of the kinds delay and mount need source kind world"
        )
    if isinstance(config, WorldConfig) and effects.mount:
        carried = camera in config.carried
        if config.arm is not None and camera in config.arm.cameras:
            from camera_node.robot.arm.camera_poses import watching

            carried = not watching(scenario, config.arm, [camera])
        if carried:
            raise ScenarioError(
                f"{scenario.path}: source.effects: {camera} is carried, and a bump (kind mount) turns a camera that "
                "stands still: leave it out, or name those that do in its cameras"
            )
    return effects


class AffectedSource(Derived):
    """Another source's shots, changed by effects.

    Effects differ from tick to tick, so shots do not repeat, unless the only effect is a pose error that is
    the same in every frame.
    """

    def __init__(self, source: Source, effects: Effects, codec: str) -> None:
        super().__init__(source, source.camera)
        self.repeats_after, self.timed = source.repeats_after, source.timed
        self._each_differs = bool(effects.image) or effects.pose_varies
        self.contents = None if self._each_differs else source.contents
        self._effects, self._codec = effects, codec

    def content(self, tick: int) -> int:
        return tick if self._each_differs else self._source.content(tick)

    def read(self, content: int) -> Shot:
        shot = self._source.read(self._source.content(content) if self._each_differs else content)
        t_s = float(content / self.fps)
        shot = dataclasses.replace(shot, pose=self._effects.reported_pose(shot.pose, content, t_s))
        if not self._effects.image:
            return shot
        image = self._effects.apply(pixels(shot, self._codec), content, t_s)
        return dataclasses.replace(shot, image=image)

    def depth(self, content: int, shot: Shot) -> DepthImage | None:
        """The source's depth, taken as exact, as the listed sensor would measure it."""
        exact = self._source.depth(self._source.content(content) if self._each_differs else content, shot)
        if exact is None or not self._effects.depth:
            return exact
        height, width = exact.counts.shape
        image = cv2.resize(pixels(shot, self._codec), (width, height), interpolation=cv2.INTER_AREA)
        lens = exact.intrinsics or shot.intrinsics.scaled(width / shot.intrinsics.width)
        measured = self._effects.depth[0].measure(exact.meters(), np.asarray(image, np.uint8), lens, content)
        return dataclasses.replace(exact, counts=measured.counts, meters_per_count=measured.meters_per_count)
