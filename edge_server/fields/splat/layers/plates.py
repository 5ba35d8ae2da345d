"""The background plate of a fixed camera; pixels of a frame that differ from it are foreground.

Each pixel remembers a few colors that it has shown while it was constant, with decaying votes. The color with the most
votes is the plate, once it has enough of them. Colors are in steps of 255.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.field_state import give_attributes, load_arrays, take_attributes
from edge_server.fields.splat.layers import layer_constants as tuned
from edge_server.fields.splat.layers.kernels.plates import (
    MODES,
    PlateArrays,
    blur,
    compare_with_plate,
    count_exposure,
    vote,
)
from freshfield.geometry import Pinhole

Arrays = dict[str, NDArray]
_KEPT = ("gain", "count", "_frames", "_gains", "_held", "_static", "_has_static")  # of a state


class Plate:
    """The plate of one camera.

    arrays: ``PlateArrays``.
    picture: float32 (H, W, 3), the plate; where it is unknown, the static field's rendering.
    gain: float32 (3,), ratio of the newest frame's exposure to the common exposure of all cameras, by channel.
        Until ``correct_exposure``, the common exposure is that of this camera's first frame.
    count: number of frames taken in.
    """

    def __init__(self, height: int, width: int) -> None:
        def zeros(*shape: int) -> NDArray[np.float32]:
            return np.zeros((height, width, *shape), np.float32)

        self.arrays = PlateArrays(
            means=np.stack([zeros(3)] * MODES),
            blurred=np.stack([zeros(3)] * MODES),
            weight=np.stack([zeros()] * MODES),
            total=zeros(),
            run=np.zeros((height, width), np.int32),
            deviation=zeros(),
            known=np.zeros((height, width), bool),
        )
        self.picture, self.gain, self.count = zeros(3), np.ones(3, np.float32), 0
        # The latest frames, a ring: as taken, their gains since, and blurred.
        self._frames = np.zeros((max(tuned.LAGS), height, width, 3), np.uint8)
        self._gains = np.ones((max(tuned.LAGS), 3), np.float32)
        self._recent, self._blurred = [zeros(3) for _ in self._frames], zeros(3)
        self._held: NDArray[Any] = np.zeros((height, width), np.uint8)
        self._static, self._has_static = zeros(3), False
        self._static_blurred: NDArray[Any] = zeros(3)
        self._difference, self._flags = zeros(), np.zeros((height, -(-width // 8) * 8), np.uint8)

    @property
    def known(self) -> NDArray[np.bool_]:
        """bool (H, W), where there is a plate."""
        return self.arrays.known

    def at_common_exposure(self) -> NDArray[np.float32]:
        """The plate as the camera would see it with the common exposure, float32 (H, W, 3)."""
        return self.picture / self.gain

    def exposure_over(self, color: NDArray[np.float32]) -> NDArray[np.float32] | None:
        """Median ratio by channel of the plate at the common exposure to the static field's rendering at it,
        float32 (H, W, 3) in [0, 1]; None if too few pixels are usable."""
        theirs = color[::2, ::2] * np.float32(255.0)
        use = self.known[::2, ::2]
        for picture in (self.picture[::2, ::2], theirs):
            use = use & (picture.min(axis=2) > tuned.DARK) & (picture.max(axis=2) < tuned.BRIGHT)
        if use.sum() < tuned.COMMON_SHARE * use.size:
            return None
        ours = self.at_common_exposure()[::2, ::2]
        ratio: NDArray[np.float32] = np.median(ours[use] / theirs[use], axis=0).astype(np.float32)
        return ratio

    def correct_exposure(self, ratio: NDArray[np.float32]) -> None:
        """Multiply this camera's assumed exposure by ``ratio``, float32 (3,), one factor a channel."""
        self.gain = self.gain * ratio

    def take(
        self, image: NDArray[np.uint8], may_refuse: bool = False, by_itself: bool = False
    ) -> NDArray[np.bool_] | None:
        """Take in a frame, uint8 (H, W, 3). Returns its foreground, bool (H, W).

        may_refuse: a frame that is nearly all foreground changes nothing; None is returned for it.
        by_itself: do not use the fields' renderings to decide what is background. While plates are not certain, fields
            learned from them would confirm their errors.
        """
        before, image = dict(vars(self)), np.ascontiguousarray(image)
        self._follow_exposure(image)
        earlier = [self._recent[(self.count - lag) % len(self._recent)] for lag in tuned.LAGS]
        foreground, changing = masks = np.empty((2, *self.known.shape), np.uint8)
        counts = np.zeros(2, np.int64)
        compare_with_plate(
            image,
            self._blurred,
            self.arrays,
            tuple(earlier),
            sum(lag <= self.count for lag in tuned.LAGS),
            self._static_blurred,
            self._has_static,
            self._difference,
            self._flags,
            self._flags.view(np.uint64),
            masks,
            counts,
        )
        if self.count == 0:
            masks[:] = 0
        elif may_refuse and counts[0] > tuned.REFUSED_SHARE * foreground.size:
            vars(self).update(before)  # what ``_scale`` has replaced
            return None
        vote(
            image,
            self._blurred,
            self._difference,
            self._flags,
            foreground,
            changing if self.count > 1 else foreground,
            not by_itself,
            np.zeros_like(self._held) if by_itself else self._held,
            self.arrays,
            self._static,
            self._has_static,
            self.picture,
        )
        slot = self.count % len(self._recent)
        self._frames[slot], self._gains[slot] = image, 1.0
        self._recent[slot], self._blurred = self._blurred, self._recent[slot]
        self.count += 1
        return foreground > 0

    def exclude_explained(
        self, image: NDArray[np.uint8], shown: NDArray[np.float32], opacity: NDArray[np.float32]
    ) -> None:
        """Exclude pixels that the moving set explains from the plate, until the next call.

        image: uint8 (H, W, 3), the camera's newest frame.
        shown: float32 (H, W, 3) in [0, 1], the moving set over the plate. opacity: float32 (H, W), its own.
        """
        error = cv2.blur(cv2.absdiff(shown, image * np.float32(1.0 / 255.0)), (3, 3))
        worst = np.maximum(np.maximum(error[..., 0], error[..., 1]), error[..., 2])
        explained = ((opacity > tuned.HELD_OPACITY) & (worst < tuned.HELD_ERROR)).astype(np.uint8)
        self._held = cv2.dilate(explained, np.ones((3, 3), np.uint8))

    def fill_unknown(self, color: NDArray[np.float32]) -> None:
        """Use the static field's rendering, float32 (H, W, 3) in [0, 1] at the common exposure, where there
        is no plate."""
        self._static = np.clip(color * self.gain, 0.0, 1.0).astype(np.float32) * np.float32(255.0)
        self._has_static = True
        self._static_blurred = cv2.blur(self._static, (3, 3))
        self._fill()

    def _blur(self) -> None:
        """Update what derives from the static field's rendering and the latest frames."""
        self._static_blurred = cv2.blur(self._static, (3, 3))
        self._recent = []
        for frame, gain in zip(self._frames, self._gains, strict=True):
            blurred = np.empty(frame.shape, np.float32)
            blur(frame, blurred)
            self._recent.append(blurred * gain)

    def _fill(self) -> None:
        """Update the picture from the result of ``vote``."""
        shows_plate = self.known[..., None] | (not self._has_static)
        self.picture = np.where(shows_plate, self.arrays.means[0], self._static)

    def state(self) -> Arrays:
        """Everything needed to continue bit for bit."""
        return {**{n: a.copy() for n, a in self.arrays._asdict().items()}, **take_attributes(self, _KEPT)}

    def load_state(self, state: Arrays) -> None:
        """Continue from ``state``. KeyError, ValueError: it lacks something, or is of other images."""
        arrays = self.arrays._asdict()
        load_arrays(arrays | {name: getattr(self, name) for name in ("_frames", "_gains", "_held", "_static")}, state)
        give_attributes(self, _KEPT, state)
        self._blur()
        self._fill()

    def _follow_exposure(self, image: NDArray[np.uint8]) -> None:
        """Rescale all stored colors when light or exposure change: by the median ratio of frame and plate per channel,
        if any channel is off by more than GAIN_STEP."""
        if self.count == 0:
            return
        counts = np.zeros((3, 3), np.int64)
        count_exposure(image, self.arrays, counts)
        used = counts[:, 0]
        few = used[0] < tuned.GAIN_SHARE * image.shape[0] * image.shape[1] / 4
        # The median is beyond a bound if more than half of the ratios are.
        if few or (2 * counts[:, 1:] <= used[:, None]).all():
            return
        plate = self.arrays.means[0, ::2, ::2]
        use = self.known[::2, ::2] & (plate.min(axis=2) > tuned.DARK) & (plate.max(axis=2) < tuned.BRIGHT)
        gain = np.median(image[::2, ::2][use] / plate[use], axis=0).astype(np.float32)
        if ((gain > 1.0 / tuned.GAIN_MOST) & (gain < tuned.GAIN_MOST)).all():  # no black or broken frame
            self._scale(gain)

    def _scale(self, gain: NDArray[np.float32]) -> None:
        """Replace the stored colors by scaled copies; the old arrays are not modified."""
        means, blurred = (np.clip(a * gain, 0.0, 255.0) for a in (self.arrays.means, self.arrays.blurred))
        self.arrays = self.arrays._replace(means=means, blurred=blurred)
        self.gain, self._static, self._gains = self.gain * gain, self._static * gain, self._gains * gain
        self._blur()


class FinePlate:
    """A plate at the full resolution of frames that are taken in at a lower one: the mean of some of them,
    outside their foregrounds.

    view: a frame at full resolution.
    color: float32 (H, W, 3), at the exposure that all cameras have in common, steps of 255.
    frames: uint8 (H, W), in how many each pixel was seen, up to FINE_MEMORY.
    count: number of frames taken in.
    """

    def __init__(self, view: View) -> None:
        self.view = view
        self.color = np.zeros(view.image.shape, np.float32)
        self.frames, self.count = np.zeros(view.image.shape[:2], np.uint8), 0

    @property
    def known(self) -> NDArray[np.bool_]:
        """bool (H, W), where there is a plate."""
        return self.frames >= tuned.FINE_KNOWN

    def take(self, image: NDArray[np.uint8], away: NDArray[np.bool_], gain: NDArray[np.float32]) -> None:
        """Take in a frame.

        image: uint8 (H, W, 3).
        away: bool, at the lower resolution, where it does not show the plate.
        gain: float32 (3,), ratio of its exposure to the common one.
        """
        grown = cv2.dilate(away.astype(np.uint8), np.ones((3, 3), np.uint8))
        use = cv2.resize(grown, image.shape[1::-1], interpolation=cv2.INTER_NEAREST) == 0
        self.frames += use & (self.frames < tuned.FINE_MEMORY)
        rate = use / np.maximum(self.frames, 1).astype(np.float32)
        self.color += (image / gain - self.color) * rate[..., None]
        self.count += 1

    def state(self) -> Arrays:
        """Everything needed to continue bit for bit."""
        lens = self.view.intrinsics
        numbers = [lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion]
        return {"lens": np.array(numbers), **take_attributes(self, ("color", "frames", "count"))}

    @staticmethod
    def from_state(view: View, state: Arrays) -> FinePlate:
        """What ``state`` gave. view: the camera's, at the lower resolution. KeyError: it lacks something."""
        height, width = state["frames"].shape
        fx, fy, cx, cy, k1, k2, p1, p2 = (float(n) for n in state["lens"])
        lens = Pinhole(width, height, fx, fy, cx, cy, (k1, k2, p1, p2))
        fine = FinePlate(replace(view, image=np.zeros((height, width, 3), np.uint8), intrinsics=lens))
        give_attributes(fine, ("color", "frames", "count"), state)
        return fine


def plain_share(colors: Sequence[NDArray[np.float32]]) -> float:
    """Share of untextured pixels: no channel differs by PLAIN_STEPS (standard deviation) within PLAIN_PX pixels.
    colors: of plates, float32 (H, W, 3), steps of 255."""
    plain = []
    for color in colors:
        size = (tuned.PLAIN_PX, tuned.PLAIN_PX)
        mean = cv2.blur(color, size)
        variance = cv2.blur(color * color, size) - mean * mean
        plain.append(float((variance.max(axis=2) < tuned.PLAIN_STEPS**2).mean()))
    return float(np.mean(plain))
