"""``freshen``: optical flow warps a stale view forward to the present.

Every moving pixel continues as it moved between the camera's last two frames, in proportion to the view's
age. The motion is splatted forward, faster pixels in front of slower ones, and colors are gathered along it.
Where a body uncovers something, the old color stays, with little weight. All this becomes less certain with
age and distance, so the weight of pixels that may have moved, and of those around them, falls with age: the
youngest views say where things are, the others what stands around them. Pixels that did not move stay the
same, bit for bit.

A warped view says which instant it shows (``View.carried_to_ns``), and fields use it: the splat field's own
tracking (``fields.splat.motion``) takes the view as seen then and does not move it a second time, and
``age_tau_ms`` and ``mask_stale_ms`` do not doubt it for an age that it no longer has. Capture times, and so
all reported ages, stay as they were.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.treatments.change_detection import AgedView, compare, dilated, with_ages
from edge_server.treatments.optical_flow import Motion, estimate_motion, grid, sample

_SPEED_EXPONENT = 4.0  # the fastest pixel outweighs a still one by e^4
_COVERED = 0.4  # share of a pixel from which on it shows what was warped there
_RELATIVE_ERROR = 0.5  # a displacement may be wrong by this share of its length, in length or direction,
_LEAST_ERROR_PX = 1.0  # and by at least this much


@dataclass(frozen=True)
class FlowWarp:
    """Warps stale views forward in time.

    max_ms: longest time to warp over: people turn.
    tau_ms: age beyond that of the youngest views over which the weight of warped pixels falls to 1/e.
    young: share of the views that count as youngest.
    uncovered: factor on that weight for pixels that something has left and nothing has reached.
    least_weight: lower bound of the weight, ``uncovered`` apart: a new field would otherwise learn nothing of
    what only old views see.
    """

    max_ms: float = 300.0
    tau_ms: float = 40.0
    young: float = 0.25
    uncovered: float = 0.3
    least_weight: float = 0.1
    name: str = "freshen"

    def treat(self, views: Sequence[View], earlier: Mapping[str, View], now_ns: int) -> list[View]:
        """See ``treatments.Treatment``."""
        return [self._treated(each) for each in with_ages(views, earlier, now_ns, self.young)]

    def _treated(self, each: AgedView) -> View:
        view, before, age_ms, young_ms = each.view, each.before, each.age_ms, each.young_ms
        changes = compare(before, view) if before is not None and age_ms > 0.0 else None
        if before is None or changes is None:
            return view
        carried_ms = min(age_ms, self.max_ms)
        carried_to_ns = view.generated_ns + round(carried_ms * 1e6)
        if not changes.changed.any():  # the view seems to show the present
            return dataclasses.replace(view, carried_to_ns=carried_to_ns)
        motion = estimate_motion(before, view, changes)
        image, landed = warp_forward(view.image, motion, carried_ms)
        moved_px = float(np.percentile(motion.length[motion.moving], 90)) if motion.moving.any() else 0.0
        touched = changes.changed | motion.moving | landed
        uncertain = dilated(touched, _LEAST_ERROR_PX + _RELATIVE_ERROR * moved_px * carried_ms)
        confidence = max(float(np.exp(-max(age_ms - young_ms, 0.0) / self.tau_ms)), self.least_weight)
        weight: NDArray[np.float32] = np.ones(uncertain.shape, np.float32)
        weight[uncertain] = confidence
        weight[motion.moving & ~landed] *= np.float32(self.uncovered)
        if view.weight is not None:
            weight *= view.weight  # of where things were; what has moved since has little weight anyway
        return dataclasses.replace(view, image=image, weight=weight, carried_to_ns=carried_to_ns)


def warp_forward(image: NDArray[np.uint8], motion: Motion, by_ms: float) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Warp an image by ``by_ms`` of motion.

    image: uint8 (H, W, C).
    Returns the warped image, and bool (H, W), where pixels landed.
    Softmax splatting (Niklaus and Liu 2020) of the motion, with speed in place of depth: what moves passes in
    front of what stands. Colors are gathered along the motion, so that they are interpolated once.
    """
    shape = image.shape[:2]
    y, x = np.nonzero(motion.moving)
    displacement = motion.speed[y, x].astype(np.float64) * by_ms
    length = np.linalg.norm(displacement, axis=1)
    weight = np.exp(_SPEED_EXPONENT * length / max(float(length.max(initial=0.0)), 1e-6))
    target = np.stack([x, y], axis=1) + displacement
    corner = np.floor(target).astype(np.int64)
    fraction = target - corner
    cover, total, sums = np.zeros(shape), np.zeros(shape), np.zeros((*shape, 2))
    for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
        column, row = corner[:, 0] + right, corner[:, 1] + down
        share = np.abs(1 - right - fraction[:, 0]) * np.abs(1 - down - fraction[:, 1])
        inside = (column >= 0) & (row >= 0) & (column < shape[1]) & (row < shape[0])
        at, share = row[inside] * shape[1] + column[inside], share[inside]
        splat_weight = share * weight[inside]
        cover += _scatter_add(at, share, shape)
        total += _scatter_add(at, splat_weight, shape)
        for k in (0, 1):
            sums[..., k] += _scatter_add(at, splat_weight * displacement[inside, k], shape)
    landed = cover > _COVERED
    source = grid(shape) - (sums / np.maximum(total, 1e-12)[..., None]).astype(np.float32)
    shown = image.copy()
    shown[landed] = sample(image, source)[landed]
    return shown, landed


def _scatter_add(at: NDArray[np.int64], values: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
    """float64 (H, W): sums of the values (N,) at flat pixel indices (N,)."""
    sums: NDArray[np.float64] = np.asarray(np.bincount(at, values, shape[0] * shape[1]), np.float64)
    return sums.reshape(shape)
