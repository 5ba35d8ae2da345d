"""``mask``: pixels of stale views that were moving count for less.

The pixels that changed between a camera's last two frames, dilated by the distance that they can have moved
since, get a weight that falls with the view's age. The youngest views keep their full weight, so that moving
things stay supervised where all views are old. There is no optical flow: a view of 128 x 128 pixels takes
about a millisecond. A field's own ``mask_stale_ms`` (the same idea with the last two *updates*, all or
nothing) multiplies these weights.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.treatments.change_detection import AgedView, Changes, blurred, compare, difference, dilated, with_ages

_LEAST_GRADIENT = 0.02  # of the blurred image, per pixel: flatter pixels say nothing about speed
_MAX_REACH = 0.25  # largest dilation, as a share of the image's longer side


@dataclass(frozen=True)
class MotionMask:
    """Lowers the weight of pixels that were moving.

    tau_ms: age beyond that of the youngest views over which a changed pixel's weight falls to 1/e.
    young: share of the views, youngest first, that keep their full weight.
    least_weight: lower bound of the weight.
    """

    tau_ms: float = 40.0
    young: float = 0.25
    least_weight: float = 0.1
    name: str = "mask"

    def treat(self, views: Sequence[View], earlier: Mapping[str, View], now_ns: int) -> list[View]:
        """See ``treatments.Treatment``."""
        return [self._treated(each) for each in with_ages(views, earlier, now_ns, self.young)]

    def _treated(self, each: AgedView) -> View:
        view, before, age_ms, young_ms = each.view, each.before, each.age_ms, each.young_ms
        if before is None or age_ms <= young_ms:
            return view
        changes = compare(before, view)
        if changes is None or not changes.changed.any():
            return view
        weight_left = max(float(np.exp(-(age_ms - young_ms) / self.tau_ms)), self.least_weight)
        max_reach_px = _MAX_REACH * max(changes.changed.shape)
        reach_px = min(speed_px_per_ms(before, view, changes) * age_ms, max_reach_px)
        weight: NDArray[np.float32] = np.ones(changes.changed.shape, np.float32)
        weight[dilated(changes.changed, reach_px)] = weight_left
        return dataclasses.replace(view, weight=weight if view.weight is None else weight * view.weight)


def speed_px_per_ms(before: View, view: View, changes: Changes) -> float:
    """Speed of the changed pixels: the median of their normal flow, change in time over change in space (Horn
    and Schunck 1981); 0 where none of them has a gradient."""
    a, b = blurred(before.image), blurred(view.image)
    gray = b[..., :3].mean(axis=2)
    down, right = np.gradient(gray)
    gradient = np.hypot(down, right)
    usable = changes.changed & (gradient > _LEAST_GRADIENT)
    if not usable.any():
        return 0.0
    return float(np.median(difference(b, a)[usable] / gradient[usable]) / changes.gap_ms)
