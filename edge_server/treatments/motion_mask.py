"""``mask``: every view is admitted, of the stale ones what moved counts for less.

What changed between a camera's last two frames, grown by how far it can have moved since, gets a weight that
falls with the view's age. The youngest views stay whole, so that what moves is not left without supervision
where all views are old. No optical flow: about a millisecond a view of 128 x 128 pixels. With a field's own
``mask_stale_ms`` (the same idea, from the last two *updates*, all or nothing) weights are multiplied.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.treatments.change_detection import Aged, Changes, aged, blurred, compare, difference, dilated

_STEEP = 0.02  # change of the blurred picture from pixel to pixel above which it tells a speed
_FASTEST = 0.25  # of the picture's longer side: nothing is grown by more


@dataclass(frozen=True)
class Mask:
    """tau_ms: a changed pixel's weight falls by 1/e over so much age beyond that of the youngest views.
    young: share of the views, youngest first, that stay whole. least_weight: no pixel's falls below it."""

    tau_ms: float = 40.0
    young: float = 0.25
    least_weight: float = 0.1
    name: str = "mask"

    def treat(self, views: Sequence[View], earlier: Mapping[str, View], now_ns: int) -> list[View]:
        """See ``treatments.Treatment``."""
        return [self._treated(each) for each in aged(views, earlier, now_ns, self.young)]

    def _treated(self, each: Aged) -> View:
        view, before, age_ms, young_ms = each.view, each.before, each.age_ms, each.young_ms
        if before is None or age_ms <= young_ms:
            return view
        changes = compare(before, view)
        if changes is None or not changes.changed.any():
            return view
        left = max(float(np.exp(-(age_ms - young_ms) / self.tau_ms)), self.least_weight)
        longest = _FASTEST * max(changes.changed.shape)
        reach_px = min(speed_px_per_ms(before, view, changes) * age_ms, longest)
        weight: NDArray[np.float32] = np.ones(changes.changed.shape, np.float32)
        weight[dilated(changes.changed, reach_px)] = left
        return dataclasses.replace(view, weight=weight if view.weight is None else weight * view.weight)


def speed_px_per_ms(before: View, view: View, changes: Changes) -> float:
    """How fast what changed is moving: the median over its pixels of the normal flow, change in time over
    change in space (Horn and Schunck 1981); 0 where nothing steep changed."""
    a, b = blurred(before.image), blurred(view.image)
    gray = b[..., :3].mean(axis=2)
    down, right = np.gradient(gray)
    slope = np.hypot(down, right)
    told = changes.changed & (slope > _STEEP)
    if not told.any():
        return 0.0
    return float(np.median(difference(b, a)[told] / slope[told]) / changes.gap_ms)
