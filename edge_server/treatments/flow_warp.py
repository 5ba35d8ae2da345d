"""``freshen``: a stale view is carried forward to the present by its camera's own optical flow.

Every moving pixel goes on as it went between the camera's last two frames, in proportion to the view's age.
The motion is splatted forward, faster pixels before slower ones, and the picture is gathered along it; what
a body leaves uncovered keeps its old colour and little weight. All of this is less certain the older the
view and the longer the way, so the weight of what may have moved, and of its surroundings, falls with age:
the youngest views say where things are, the others what stands around them. What did not move is untouched,
bit for bit.

A freshened view says which instant it shows (``View.carried_to_ns``), and fields go by that: the splat's own
tracking (``fields.splat.motion``) takes it as seen then and does not move it on a second time, and
``age_tau_ms`` and ``mask_stale_ms`` do not doubt it for an age that it no longer has. Capture times, and so
all ages that are reported, stay as they were.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.treatments.change_detection import Aged, aged, compare, dilated
from edge_server.treatments.optical_flow import Motion, grid, motion_of, sample

_FRONT = 4.0  # the fastest pixel hides a still one by e^4
_COVERED = 0.4  # of a pixel, from which on what was carried there is shown
_WRONG = 0.5  # of the way that pixels were carried: by so much it may be too long, too short or beside
_LEAST_PX = 1.0  # and by so much at least


@dataclass(frozen=True)
class Freshen:
    """most_ms: no farther is anything carried, for people turn. tau_ms: what was carried counts less by 1/e
    for so much age beyond that of the youngest views. young: share of the views that are these.
    uncovered: share of that weight for pixels that something has left and nothing has come to.
    least_weight: nothing else falls below it, or a field that begins would know nothing of what only old
    views see."""

    most_ms: float = 300.0
    tau_ms: float = 40.0
    young: float = 0.25
    uncovered: float = 0.3
    least_weight: float = 0.1
    name: str = "freshen"

    def treat(self, views: Sequence[View], earlier: Mapping[str, View], now_ns: int) -> list[View]:
        """See ``treatments.Treatment``."""
        return [self._treated(each) for each in aged(views, earlier, now_ns, self.young)]

    def _treated(self, each: Aged) -> View:
        view, before, age_ms, young_ms = each.view, each.before, each.age_ms, each.young_ms
        changes = compare(before, view) if before is not None and age_ms > 0.0 else None
        if before is None or changes is None:
            return view
        carried_ms = min(age_ms, self.most_ms)
        carried_to_ns = view.generated_ns + round(carried_ms * 1e6)
        if not changes.changed.any():  # as far as can be seen, it shows the present as it is
            return dataclasses.replace(view, carried_to_ns=carried_to_ns)
        motion = motion_of(before, view, changes)
        image, landed = carry(view.image, motion, carried_ms)
        far_px = float(np.percentile(motion.length[motion.moving], 90)) if motion.moving.any() else 0.0
        touched = changes.changed | motion.moving | landed
        unsure = dilated(touched, _LEAST_PX + _WRONG * far_px * carried_ms)
        trust = max(float(np.exp(-max(age_ms - young_ms, 0.0) / self.tau_ms)), self.least_weight)
        weight: NDArray[np.float32] = np.ones(unsure.shape, np.float32)
        weight[unsure] = trust
        weight[motion.moving & ~landed] *= np.float32(self.uncovered)
        if view.weight is not None:
            weight *= view.weight  # of where things were; what has moved since has little weight already
        return dataclasses.replace(view, image=image, weight=weight, carried_to_ns=carried_to_ns)


def carry(
    image: NDArray[np.uint8], motion: Motion, by_ms: float
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """The picture (H, W, C) after ``by_ms`` of ``motion``, and bool (H, W), where something was carried to.

    Softmax splatting (Niklaus and Liu 2020) of the motion, with speed in the place of nearness: what moves
    passes in front of what stands. Colours are gathered along it, so that they are interpolated once.
    """
    shape = image.shape[:2]
    y, x = np.nonzero(motion.moving)
    way = motion.speed[y, x].astype(np.float64) * by_ms
    length = np.linalg.norm(way, axis=1)
    front = np.exp(_FRONT * length / max(float(length.max(initial=0.0)), 1e-6))
    to = np.stack([x, y], axis=1) + way
    corner = np.floor(to).astype(np.int64)
    part = to - corner
    cover, total, sums = np.zeros(shape), np.zeros(shape), np.zeros((*shape, 2))
    for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
        column, row = corner[:, 0] + right, corner[:, 1] + down
        share = np.abs(1 - right - part[:, 0]) * np.abs(1 - down - part[:, 1])
        inside = (column >= 0) & (row >= 0) & (column < shape[1]) & (row < shape[0])
        at, share = row[inside] * shape[1] + column[inside], share[inside]
        pull = share * front[inside]
        cover += _added(at, share, shape)
        total += _added(at, pull, shape)
        for k in (0, 1):
            sums[..., k] += _added(at, pull * way[inside, k], shape)
    landed = cover > _COVERED
    came = grid(shape) - (sums / np.maximum(total, 1e-12)[..., None]).astype(np.float32)
    shown = image.copy()
    shown[landed] = sample(image, came)[landed]
    return shown, landed


def _added(at: NDArray[np.int64], values: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
    """The values (N,) added up at pixel numbers (N,): float64 (H, W)."""
    sums: NDArray[np.float64] = np.asarray(np.bincount(at, values, shape[0] * shape[1]), np.float64)
    return sums.reshape(shape)
