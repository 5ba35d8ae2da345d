"""A moving scene, frame by frame, with all its cameras: a synthetic scene or a recording."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera_node.sources.datasets.formats import open_dataset
from camera_node.sources.datasets.records import DatasetError
from camera_node.synthetic import make_scene
from camera_node.synthetic.scene import HELD_OUT
from edge_server.experiments.scenes.recorded import split
from edge_server.experiments.virtual.truth import NOISE_FRAMES, noise_bound
from edge_server.fidelity.moving_pixels import BOUND, LAGS_MS, frames_at_lags
from edge_server.fidelity.scorer import Score, Scorer, mean_score
from edge_server.fields import Renderer, View
from freshfield.geometry import Pinhole

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class MultiviewSequence:
    """Frames 0, 1, 2, ... of a moving scene, without end, because it repeats.

    period_ms: time between frames.
    cameras: name -> (intrinsics, camera-to-world), in the order of training.
    held_out: the cameras that are scored and not trained on.
    key: frame -> key of its images; frames with equal keys have equal images.
    image: (camera, key) -> image; every call returns the same object.
    before: (camera, frame) -> the camera's images ``LAGS_MS`` earlier.
    bounds: held-out camera -> least difference of a pixel that counts as moving.
    """

    name: str
    period_ms: float
    cameras: Mapping[str, tuple[Pinhole, NDArray[np.float64]]]
    held_out: tuple[str, ...]
    key: Callable[[int], int]
    image: Callable[[str, int], Image]
    before: Callable[[str, int], list[Image]]
    bounds: Mapping[str, float]

    def describe(self) -> str:
        lens = next(iter(self.cameras.values()))[0]
        count = len(self.cameras) - len(self.held_out)
        return f"{self.name}: {count} views of {lens.width} x {lens.height}"

    def training(self, frame: int, late: int = 0) -> tuple[View, ...]:
        """The views of all training cameras at a frame.

        late: the first camera's view is of this frame, the next one's of the frame before, and so on to
            ``late`` frames before, then of this one again, as at an edge behind a network with delays.
        """
        names = [camera for camera in self.cameras if camera not in self.held_out]
        return tuple(self._view(camera, frame - k % (late + 1)) for k, camera in enumerate(names))

    def truth(self, frame: int) -> tuple[View, ...]:
        """The held-out views at a frame."""
        return tuple(self._view(camera, frame) for camera in self.held_out)

    def score(self, field: Renderer, frame: int, scorer: Scorer) -> Score:
        """Mean score of ``field`` at a frame over the held-out cameras: of whole images and of moving
        pixels."""
        scores = []
        for view in self.truth(frame):
            shown = field.render(view.camera_to_world, view.intrinsics).color
            now, earlier = view.generated_ns, self.before(view.camera, frame)
            scores.append(scorer.score(view.camera, shown, now, view.image, now, earlier, self.bounds[view.camera]))
        return mean_score(scores)

    def _view(self, camera: str, frame: int) -> View:
        lens, pose = self.cameras[camera]
        image = self.image(camera, self.key(frame))
        return View(camera, image, pose, lens, round(frame * self.period_ms * 1e6))


def synthetic_sequence(
    name: str = "room", cameras: int = 19, size: int = 128, fps: float = 15.0, **params: Any
) -> MultiviewSequence:
    """A synthetic scene with its first camera held out. size: width and height in pixels. params: parameters
    of the scene (``speed_m_per_s``). Raises camera_node's SceneError."""
    scene = make_scene(name, {"count": cameras, "width": size, "height": size, **params})
    loop = max(1, round(scene.period_s * fps))  # a scene repeats after a whole number of frames

    @cache
    def before(camera: str, key: int) -> list[Image]:
        # An analytic scene is known at any instant, also before the first frame and between two frames.
        return [scene.render(camera, key / fps - lag / 1e3) for lag in LAGS_MS]

    return MultiviewSequence(
        name,
        1e3 / fps,
        scene.cameras,
        (HELD_OUT,),
        bounds={HELD_OUT: BOUND},
        key=lambda frame: frame % loop,
        image=cache(lambda camera, key: scene.render(camera, key / fps)),
        before=lambda camera, frame: before(camera, frame % loop),
    )


def recorded_sequence(path: Path, holdout: str, scale: float = 1.0) -> MultiviewSequence:
    """A recording of several cameras, played back and forth. holdout: as in ``load_recorded``. Raises
    DatasetError, also for a data set in which nothing moves."""
    file, dataset = open_dataset(path, scale)
    if not dataset.moving:
        raise DatasetError(f"{file}: its images have no cameras and times: nothing moves in it")
    records = {camera: dataset.of(camera) for camera in dataset.cameras}
    count = min(len(r) for r in records.values())
    if count < 2:
        raise DatasetError(f"{file}: one instant only: nothing moves in it")
    cameras = {c: (r[0].intrinsics, r[0].camera_to_world) for c, r in records.items()}
    # The split needs no images.
    blank = np.zeros((1, 1, 3), np.uint8)
    _, held_out = split([View(c, blank, pose, lens) for c, (lens, pose) in cameras.items()], holdout)
    if not held_out:
        raise DatasetError(f"{file}: --holdout {holdout} holds out no camera: nothing to score on")
    period_ms = 1e3 / (dataset.fps or _fps([r.time_s for r in next(iter(records.values()))]))
    history = 1 + round(1.5 * LAGS_MS[-1] / period_ms)

    def key(frame: int) -> int:
        at = frame % (2 * (count - 1))
        return at if at < count else 2 * (count - 1) - at

    def before(camera: str, frame: int) -> list[Image]:
        frames = range(frame - history, frame + 1)
        found = frames_at_lags([round(f * period_ms * 1e6) for f in frames], round(frame * period_ms * 1e6))
        return [read(camera, key(frames[i])) for i in found]

    @cache
    def read(camera: str, at: int) -> Image:
        return records[camera][at].read()

    names = tuple(view.camera for view in held_out)
    bounds = {c: noise_bound(read(c, k) for k in range(min(count, NOISE_FRAMES))) for c in names}
    name = file.resolve().parent.name
    return MultiviewSequence(name, period_ms, cameras, names, key, read, before, bounds)


def _fps(times_s: Sequence[float | None]) -> float:
    known = [t for t in times_s if t is not None]
    return float(1.0 / np.median(np.diff(known)))
