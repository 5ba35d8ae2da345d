"""The pose of a new frame by direct image alignment with the field (Gauss-Newton, coarse to fine).

One rendering with depth serves several iterations: its pixels are warped by the current motion estimate, which needs
no further rendering (Lucas and Kanade 1981; gradients are the means of both images', as in the efficient second-order
minimization of Benhimane and Malis 2004).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields.splat.carried_camera import carried_camera_constants as tuned
from freshfield.geometry import Pinhole, se3_inverse, so3_exp, so3_log

Array = NDArray[np.float64]
Gray = NDArray[np.float32]


class Rendered(NamedTuple):
    """The field rendered from a pose.

    pose: camera to world (4, 4). lens: of the rendering. gray, depth, opacity: (H, W); depth along the optical axis,
    meters.
    """

    pose: Array
    lens: Pinhole
    gray: Gray
    depth: Gray
    opacity: Gray


class Alignment(NamedTuple):
    """pose: camera to world (4, 4), of the frame. overlap: share of the rendering's pixels that show a surface within
    the frame. agreeing: share of these that are consistent."""

    pose: Array
    overlap: float
    agreeing: float

    @property
    def fits(self) -> bool:
        """Whether overlap and consistency suffice to accept the pose whatever is reported."""
        return self.overlap >= tuned.LEAST_OVERLAP and self.agreeing >= tuned.LOCATED


def gray(image: NDArray) -> Gray:
    """(H, W) in [0, 1] of an image (H, W, 3 or 4), bytes or float."""
    scale = 255.0 if image.dtype == np.uint8 else 1.0
    found: Gray = cv2.cvtColor(image[..., :3].astype(np.float32), cv2.COLOR_RGB2GRAY) / np.float32(scale)
    return found


def align(
    shown: Rendered,
    frame: Gray,
    given: Array,
    begin: Array | None = None,
    levels: Sequence[tuple[int, int]] = tuned.LEVELS,
    prior: float | None = None,
) -> Alignment:
    """Find the pose of a frame near that of a rendering.

    frame: (H, W) in [0, 1], of the rendering's size or larger. given: its reported pose, (4, 4), the mean of the prior.
    begin: initial pose, (4, 4); None: the rendering's. levels: see ``LEVELS``. prior: None: ``PRIOR_ERROR``. Levels
    with too few pixels are skipped; if equations cannot be solved, the initial pose is kept.
    """
    motion = np.eye(4) if begin is None else se3_inverse(begin) @ shown.pose
    prior, light = tuned.PRIOR_ERROR if prior is None else prior, np.array([1.0, 0.0])
    offset, overlap, agreeing = se3_inverse(shown.pose) @ given, 0.0, 0.0
    for halvings, iterations in levels:
        level = _Level(shown, frame, halvings)
        for _ in range(iterations):
            found = level.equations(motion, light)
            if found is None:
                break
            hessian, gradient, count, overlap, agreeing = found
            away = motion @ offset
            weight = prior * count / np.square([tuned.PRIOR_RAD] * 3 + [tuned.PRIOR_M] * 3)
            damping = np.append(weight, [tuned.TOWARDS_ONE * count] * 2)
            pull = np.concatenate([so3_log(away[:3, :3]), away[:3, 3], light - [1.0, 0.0]])
            step = -np.linalg.solve(hessian + np.diag(damping), gradient + damping * pull)
            if not np.isfinite(step).all():
                return Alignment(shown.pose if begin is None else begin, overlap, agreeing)
            step[:3] *= min(1.0, tuned.LONGEST_RAD / max(float(np.linalg.norm(step[:3])), 1e-12))
            move = np.eye(4)
            move[:3, :3], move[:3, 3] = so3_exp(step[:3]), step[3:6]
            motion, light = move @ motion, light + step[6:]
    return Alignment(shown.pose @ se3_inverse(motion), overlap, agreeing)


def align_from(shown: Rendered, frame: Gray, candidates: Sequence[Array], last: float = 0.0) -> Alignment:
    """Find the pose of a frame from several guesses, (4, 4) each: the best one at the coarse levels is refined to the
    finest. last: the last guess is taken if it fits worse than the best by less than this share."""
    coarse, finest = tuned.LEVELS[:-1], tuned.LEVELS[-1:]
    found = [align(shown, frame, pose, pose, coarse, tuned.GUESSED_ERROR) for pose in candidates]
    fit = [min(each.overlap, tuned.ENOUGH_OVERLAP) * each.agreeing for each in found]
    best = found[-1 if fit[-1] > (1.0 - last) * max(fit) else fit.index(max(fit))]
    return align(shown, frame, best.pose, best.pose, finest, tuned.GUESSED_ERROR)


class _Level:
    """Rendering and frame at one size."""

    def __init__(self, shown: Rendered, frame: Gray, halvings: int) -> None:
        self.lens = lens = shown.lens.halved(halvings)
        size, every = (lens.width, lens.height), 1 << halvings
        self.frame = cv2.resize(frame, size, interpolation=cv2.INTER_AREA)
        reference = cv2.resize(shown.gray, size, interpolation=cv2.INTER_AREA)
        self.slopes = tuple(cv2.Sobel(self.frame, cv2.CV_32F, x, y, scale=0.125) for x, y in ((1, 0), (0, 1)))
        own = tuple(cv2.Sobel(reference, cv2.CV_32F, x, y, scale=0.125) for x, y in ((1, 0), (0, 1)))
        depth, opacity = (part[::every, ::every] for part in (shown.depth, shown.opacity))
        # Every second pixel of the largest level: neighbors are redundant.
        few = max(1, round(np.sqrt(depth.size / tuned.MOST_ALIGNED)))
        chosen = np.zeros(depth.shape, np.bool_)
        chosen[::few, ::few] = True
        y, x = np.nonzero(chosen & (opacity >= tuned.ALIGNED_OPACITY) & (depth > 0))
        self.share = len(y) / max(int(chosen.sum()), 1)
        z = depth[y, x].astype(np.float64)
        across, down = (x + 0.5 - lens.cx) / lens.fx, (y + 0.5 - lens.cy) / lens.fy
        self.points = np.stack([across * z, down * z, z], axis=1)
        self.reference = reference[y, x].astype(np.float64)
        self.own = [each[y, x].astype(np.float64) for each in own]

    def equations(self, motion: Array, light: Array) -> tuple[Array, Array, int, float, float] | None:
        """Normal matrix (8, 8) and gradient (8,) by rotation, shift, gain and bias, number of pixels, and the shares
        of ``Alignment``; None: too few pixels."""
        lens = self.lens
        a, b, c = (self.points @ motion[:3, :3].T + motion[:3, 3]).T
        safe = np.maximum(c, 1e-6)
        u, v = lens.fx * a / safe + lens.cx - 0.5, lens.fy * b / safe + lens.cy - 0.5
        inside = (c > 1e-3) & (u >= 1) & (v >= 1) & (u < lens.width - 2) & (v < lens.height - 2)
        count = int(inside.sum())
        if count < tuned.LEAST_ALIGNED:
            return None
        a, b, c, u, v, r = (each[inside] for each in (a, b, c, u, v, self.reference))
        maps = u.astype(np.float32)[None], v.astype(np.float32)[None]
        seen, across, down = (
            cv2.remap(each, *maps, cv2.INTER_LINEAR)[0].astype(np.float64) for each in (self.frame, *self.slopes)
        )
        error = seen - light[0] * r - light[1]
        weight = 1.0 / (1.0 + np.square(error / tuned.SOFT))
        x = 0.5 * (across + light[0] * self.own[0][inside]) * lens.fx / c
        y = 0.5 * (down + light[0] * self.own[1][inside]) * lens.fy / c
        z = -(x * a + y * b) / c
        slopes = np.stack([z * b - y * c, x * c - z * a, y * a - x * b, x, y, z, -r, np.full_like(r, -1.0)])
        # Without BLAS: its order of summation depends on the number of threads.
        hessian = np.einsum("in,jn,n->ij", slopes, slopes, weight, optimize=False)
        gradient = np.einsum("in,n->i", slopes, weight * error, optimize=False)
        return hessian, gradient, count, self.share * count / len(inside), float((np.abs(error) < tuned.SOFT).mean())
