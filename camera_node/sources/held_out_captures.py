"""Which captures of a stream are held out: no field is trained on them.

Of a camera that is carried about it is every n-th capture of its path: no second camera sees what a moving one sees, so
it is divided between two cameras of the scenario, the training camera and its held-out camera, with all its errors of
pose and exposure (``cameras.held_out_every``). Of photos it is the data set's own test images, else every eighth.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Mapping, Sequence

from camera_node.capture_schedule import PartialSchedule, RateSchedule
from camera_node.settings import McapConfig, SourceConfig
from camera_node.sources.base import Derived, Source
from camera_node.sources.datasets.records import DatasetError
from camera_node.sources.source_constants import HOLD_OUT_EVERY
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


def without_held_out_images(shown: Sequence[int], every: int) -> list[int]:
    """The images of captures, of which the first of ``every`` is held out, so that no other one shows its image: a rate
    above the recording's repeats images, and so does a dropped frame. Those show the one before or after it. Raises
    DatasetError where none is left for them."""
    held = set(shown[::every])
    own = sorted(set(shown) - held)
    apart = list(shown)
    for n, image in enumerate(shown):
        if n % every and image in held:
            if not own:
                raise DatasetError(f"one of {every} captures is held out: no other has an image of its own: lower fps")
            after = bisect_left(own, image)
            apart[n] = own[min(after, len(own) - 1) if n % every <= every // 2 else max(0, after - 1)]
    return apart


def split_photos(
    count: int, training: Sequence[str], held_out: Sequence[str], own: Collection[int] = ()
) -> dict[str, list[int]]:
    """Image indices of each camera. The data set's ``own`` test images, else those with index % 8 == 0, go to the
    held-out cameras in turn (if there are any), the others to the training cameras in turn. Raises DatasetError if a
    camera would get none."""
    truth = sorted(own) or ([i for i in range(count) if i % HOLD_OUT_EVERY == 0] if held_out else [])
    rest = [i for i in range(count) if i not in set(truth)]
    shares = {camera: truth[k :: len(held_out)] for k, camera in enumerate(held_out)}
    shares |= {camera: rest[k :: len(training)] for k, camera in enumerate(training)}
    empty = [camera for camera, share in shares.items() if not share]
    if empty:
        raise DatasetError(f"{count} images are too few: none is left for {', '.join(empty)}; use fewer cameras")
    return shares
