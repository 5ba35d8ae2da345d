"""Parts of small worlds, for tests of rendering and of effects."""

from __future__ import annotations

import numpy as np

from camera_node.synthetic.lighting import Light
from camera_node.synthetic.placement import MovingBody, Part

# Ambient only: every surface shows its albedo.
FLAT_LIGHT = Light(np.array([[0.0, 0.0, 50.0]]), 0.0, 1.0, (1.0, 1.0, 1.0), (1.0, 1.0, 1.0))


def body(part: Part) -> MovingBody:
    """A body of one part that does not move."""
    return MovingBody((part,), lambda t_s: part.matrix[None])
