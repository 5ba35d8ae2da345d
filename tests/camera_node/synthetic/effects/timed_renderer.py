"""A renderer that shows a function of time, for effects that request instants."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic.render import Image
from freshfield.geometry import Pinhole


@dataclass
class TimedRenderer:
    """Shows ``render(t_s)``. asked: the requested instants."""

    render: Callable[[float], NDArray[np.uint8]]
    camera: Pinhole = field(default_factory=lambda: Pinhole.from_fov(2, 2, 60.0))
    asked: list[float] = field(default_factory=list)

    def image(self, t_s: float) -> Image:
        self.asked.append(t_s)
        return self.render(t_s)
