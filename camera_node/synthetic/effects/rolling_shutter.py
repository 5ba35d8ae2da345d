"""Rolling shutter: a sensor reads its rows one after another, so each row shows its own instant."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from camera_node.synthetic.effects import EffectParameters, Renderer
from camera_node.synthetic.render import Image, Rows
from freshfield.settings import within


class RollingShutter(EffectParameters, frozen=True):
    """Row i of n is read ``(i / (n - 1) - stamped_share) * readout_ms`` after the time stamp. Costs a good
    part of a rendering for every row, ahead; free while streaming. To use it with motion_blur, list it after
    motion_blur: each row is then blurred around its own instant. Errors of several rows at once are up to
    readout_ms * rows_at_once / (2 * height)."""

    readout_ms: Annotated[float, within(0.0, 1000.0, "from the top row to the bottom one")] = 20.0
    stamped_share: Annotated[float, within(0.0, 1.0, "row that the time stamp belongs to; 0: top, 1: bottom")] = 0.5
    rows_at_once: Annotated[int, within(1, 4096, "rows rendered at the instant of their middle; more is faster")] = 1

    kind: ClassVar[str] = "exposure"

    def row_offset_s(self, row: float, height: int) -> float:
        """Time from the time stamp to the reading of a row."""
        share = row / (height - 1) if height > 1 else 0.5
        return (share - self.stamped_share) * self.readout_ms * 1e-3

    def expose(self, renderer: Renderer, t_s: float, rows: Rows | None = None) -> Image:
        height, step = renderer.camera.height, self.rows_at_once
        first, stop = (0, height) if rows is None else rows
        strips = []
        # Bands are counted from the image's top row, so that a row looks the same in any requested range.
        for top in range(first - first % step, stop, step):
            bottom = min(top + step, height)
            middle = 0.5 * (top + bottom - 1)
            part = (max(top, first), min(bottom, stop))
            strips.append(renderer.image(t_s + self.row_offset_s(middle, height), part))
        return np.concatenate(strips)
