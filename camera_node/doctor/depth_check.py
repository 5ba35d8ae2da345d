"""Whether measured depth can be right: how much is measured, whether it fits its image, and what other cameras measure.

Cameras are compared by points: each camera's are lifted by its depth and looked for in the depth of another camera,
where a point may be hidden, but never nearer than the surface that is measured there.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.doctor import doctor_constants as tuned
from camera_node.pose.providers import PoseGapError
from camera_node.settings import SourceConfig
from camera_node.sources.base import Shot, Source, pixels
from camera_node.sources.registry import open_sources
from camera_node.sources.with_effects import camera_effects
from freshfield.depth import DepthImage
from freshfield.geometry import Array, Pinhole, Pose, se3_inverse, seen_from
from freshfield.limits import USUAL_DEPTH_M
from freshfield.scenario import Scenario


@dataclass(frozen=True)
class DepthView:
    """One camera's depth with its image: uint8 (H, W, 3), the image's lens, and its pose."""

    camera: str
    image: NDArray[np.uint8]
    lens: Pinhole
    pose: Pose
    depth: DepthImage

    def sensor(self) -> tuple[Pinhole, Array]:
        """Lens of the depth sensor, and its place in the camera's axes (4, 4)."""
        d = self.depth
        lens = d.intrinsics or self.lens.scaled(d.counts.shape[1] / self.lens.width)
        return lens, np.eye(4) if d.to_camera is None else d.to_camera.matrix()

    def points(self, chosen: NDArray[np.bool_]) -> Array:
        """Points (N, 3), in the camera's axes, of chosen pixels (H, W)."""
        lens, place = self.sensor()
        rays = lens.rays()[chosen]
        points = rays / rays[:, 2:] * self.depth.meters()[chosen][:, None]
        return points @ place[:3, :3].T + place[:3, 3]

    def scaled(self, factor: float) -> DepthView:
        """The same with depth times ``factor``."""
        return replace(self, depth=replace(self.depth, meters_per_count=factor * self.depth.meters_per_count))


def first_views(scenario: Scenario, config: SourceConfig, data: Path | None) -> list[DepthView]:
    """The first shot of each training camera that measures depth. Raises ValueError or OSError."""
    training = [camera for camera in scenario.cameras if camera not in scenario.held_out]
    effects = {camera: camera_effects(scenario, config, camera) for camera in training}
    if config.kind == "world" and not any(made is not None and made.depth for made in effects.values()):
        return []
    views = []
    for camera, source in open_sources(scenario, config, training, data, effects).items():
        first = _first_shot(source)
        measured = None if first is None else source.depth(*first)
        source.release()
        if first is not None and measured is not None:
            shot = first[1]
            image = pixels(shot, config.codec)
            views.append(DepthView(camera, image, shot.intrinsics, shot.pose, measured))
    return views


def _first_shot(source: Source) -> tuple[int, Shot] | None:
    """Number and shot of the first capture that has a pose: a tracker may begin after its camera. None: none has."""
    for content in map(source.content, range(source.contents or 1)):
        with contextlib.suppress(PoseGapError):
            return content, source.read(content)
    return None


def check(view: DepthView, others: Sequence[DepthView]) -> str:
    """One line on a camera's depth. others: depth of the same instant, or of a scene that stands still. Raises
    ValueError."""
    counts, meters = view.depth.counts, view.depth.meters()
    measured = counts > 0
    said = f"{counts.shape[1]} x {counts.shape[0]}, {1.0 - measured.mean():.0%} without depth"
    if measured.mean() < tuned.DEPTH_LEAST_MEASURED:
        raise ValueError(f"{said}: is the scene within the sensor's range and lit, is the lens free?")
    near, middle, far = np.quantile(meters[measured], tuned.DEPTH_QUANTILES)
    said += f", {near:.2g} to {far:.2g} m"
    if np.bincount(counts[measured]).max() > tuned.DEPTH_CONSTANT * measured.sum():
        raise ValueError(f"{said}: nearly all of it is the same, {middle:.3g} m: does the sensor measure at all?")
    if not USUAL_DEPTH_M[0] <= middle <= USUAL_DEPTH_M[1]:
        raise ValueError(f"{said}: is the unit wrong?")
    shares = {other.camera: _agreement(view, other)[0] for other in others}
    known = {camera: share for camera, share in shares.items() if share is not None}
    if known:
        best, share = max(known.items(), key=lambda pair: pair[1])
        if share < tuned.DEPTH_AGREES:
            raise ValueError(f"{said}: {share:.0%} of it agrees with {best}'s: {_explained(view, others)}")
        return f"{said}, {share:.0%} of it agrees with {best}'s"
    contrast = edge_contrast(view)
    if contrast is not None and contrast < tuned.DEPTH_LEAST_CONTRAST:
        raise ValueError(
            f"{said}: its edges are not those of the image (contrast {contrast:.2f} of that beside them): is it "
            "registered to this image, of this instant, not mirrored?"
        )
    return said if contrast is None else f"{said}, its edges are those of the image"


def _explained(view: DepthView, others: Sequence[DepthView]) -> str:
    """What would make depth agree: another unit of this camera's, of another's or of all; else it is something else."""
    for factor in tuned.DEPTH_FACTORS:
        for own, theirs in ((factor, 1.0), (1.0, factor), (factor, factor)):
            for other in others:
                share, least_same = _agreement(view.scaled(own), other.scaled(theirs))
                if (share or 0.0) >= tuned.DEPTH_AGREES and least_same >= tuned.DEPTH_OVERLAPS:
                    whose = other.camera if own == 1.0 else view.camera if theirs == 1.0 else "both cameras"
                    return f"that of {whose} seems to be {1.0 / factor:.3g} times what it should be: is the unit wrong?"
    return "is the pose, a lens, the scale or the instant of one of them wrong, or are near and far exchanged?"


def _agreement(a: DepthView, b: DepthView) -> tuple[float | None, float]:
    """Share of the points of both that the other's surfaces do not hide on which both agree, None for too few of them;
    and the share of all points, of the camera with fewer of them on the other's surfaces."""
    same, through, hidden = np.array([_compared(a, b), _compared(b, a)]).T
    count = int((same + through).sum())
    share = None if count < tuned.DEPTH_FEWEST_POINTS else float(same.sum()) / count
    return share, float((same / np.maximum(1, same + through + hidden)).min())


def _compared(a: DepthView, b: DepthView) -> tuple[int, int, int]:
    """How many of a's points lie on b's surfaces, in front of them, and behind them."""
    chosen = a.depth.counts > 0
    places = np.flatnonzero(chosen)
    chosen.flat[places[np.arange(places.size) % max(1, places.size // tuned.DEPTH_MOST_POINTS) > 0]] = False
    lens, place = b.sensor()
    a_to_b = se3_inverse(a.pose.matrix()) @ b.pose.matrix() @ place
    points, at, seen = seen_from(lens, a_to_b, a.points(chosen))
    column, row = at[seen].astype(np.int64).T
    depth, surface = points[seen, 2], b.depth.meters()[row, column]
    ratio = depth[surface > 0.0] / surface[surface > 0.0]
    through, hidden = int((ratio < 1.0 - tuned.DEPTH_SAME).sum()), int((ratio > 1.0 + tuned.DEPTH_SAME).sum())
    return len(ratio) - through - hidden, through, hidden


def edge_contrast(view: DepthView) -> float | None:
    """Gradient of the image at edges of depth over that beside them; None for too few edges."""
    points = view.points(_edges(view.depth.meters()))
    points = points[points[:, 2] > 0.0]
    width, height = view.lens.width, view.lens.height
    at = np.floor(view.lens.project(points)).astype(np.int64)
    gray = cv2.GaussianBlur(cv2.cvtColor(view.image[..., :3], cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
    gradient = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1))
    gradient = cv2.dilate(gradient, np.ones((3, 3)))  # depth and image may be a pixel apart
    step = max(3, round(tuned.DEPTH_BESIDE * width))
    shifts = [(dx * step, dy * step) for dx in (0, 1, -1) for dy in (0, 1, -1)]
    found = []
    for shift in shifts:
        moved = at + shift
        moved = moved[((moved >= 0) & (moved < (width, height))).all(axis=1)]
        found.append(gradient[moved[:, 1], moved[:, 0]])
    beside = float(np.concatenate(found[1:]).mean()) if found[0].size else 0.0
    return float(found[0].mean()) / beside if found[0].size >= tuned.DEPTH_FEWEST_EDGES and beside > 0.0 else None


def _edges(meters: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Pixels (H, W) on the nearer side of a jump of depth between neighbors that are both measured."""
    inverse = np.divide(1.0, meters, out=np.full_like(meters, np.nan), where=meters > 0.0)
    edges = np.zeros(meters.shape, dtype=bool)
    for rows, out in ((inverse, edges), (inverse.T, edges.T)):
        a, b = rows[:, :-1], rows[:, 1:]
        with np.errstate(invalid="ignore"):
            jumps = np.abs(a - b) > tuned.DEPTH_JUMP * np.maximum(a, b)  # nothing, where one is NaN
            out[:, :-1] |= jumps & (a > b)
            out[:, 1:] |= jumps & (b > a)
    return edges
