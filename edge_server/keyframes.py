"""Earlier viewpoints of cameras that move go on supervising: one camera on an arm is many cameras in time.

The buffer holds the newest frame of a camera and nothing else. For a camera that stands still that is all
there is to know; one that moves would have its field forget, update by update, what it no longer looks at. So
of every view that was used, its viewpoint is kept if it lies apart from those kept before; where it does not,
the newer picture takes the older one's place. They go to the field as views of cameras of their own, named
``hand#3``: no camera of a scenario may be called so. Their ages are what they are: a scene that changes asks
for few of them, or for a field that trusts old views less (``age_tau_ms``).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from edge_server.config import KeyframesConfig
from edge_server.fields import View

MARK = "#"


class Keyframes:
    """At most ``config.most`` viewpoints of each camera; the oldest gives way."""

    def __init__(self, config: KeyframesConfig) -> None:
        self.config = config
        self._kept: dict[str, dict[int, View]] = {}

    def with_earlier(self, views: Sequence[View]) -> list[View]:
        """``views``, each with its own name, and the earlier viewpoints of their cameras after them."""
        earlier: list[View] = []
        for view in views:
            kept = self._kept.setdefault(view.camera, {})
            own = self._keep(kept, view)
            earlier.extend(each for slot, each in kept.items() if slot != own)
        return [*views, *earlier]

    def forget(self) -> None:
        """The scene is another one."""
        self._kept.clear()

    def __len__(self) -> int:
        return sum(map(len, self._kept.values()))

    def _keep(self, kept: dict[int, View], view: View) -> int:
        """The slot that ``view`` now has."""
        slot = next((each for each, known in kept.items() if self._alike(known, view)), len(kept))
        if slot == self.config.most:
            slot = min(kept, key=lambda each: kept[each].generated_ns)
        if slot not in kept or kept[slot].generated_ns != view.generated_ns:
            kept[slot] = dataclasses.replace(view, camera=f"{view.camera}{MARK}{slot}")
        return slot

    def _alike(self, a: View, b: View) -> bool:
        """Whether two views are from one viewpoint, through one lens."""
        if a.intrinsics != b.intrinsics:
            return False
        apart_m = float(np.linalg.norm(a.camera_to_world[:3, 3] - b.camera_to_world[:3, 3]))
        turned = a.camera_to_world[:3, :3].T @ b.camera_to_world[:3, :3]
        turned_deg = float(np.rad2deg(np.arccos(np.clip((np.trace(turned) - 1.0) / 2.0, -1.0, 1.0))))
        return apart_m < self.config.apart_m and turned_deg < self.config.apart_deg
