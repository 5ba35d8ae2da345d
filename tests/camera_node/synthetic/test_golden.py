"""Every scene looks as it did: five small views of each beside the images in ``golden``, so that figures measured on
a scene stay figures of that scene. After a wanted change:

    python -m tests.camera_node.synthetic.test_golden
"""

from pathlib import Path

import cv2
import numpy as np
import pytest

from camera_node.synthetic import make_scene
from camera_node.synthetic.render import Image

GOLDEN = Path(__file__).parent / "golden"
SCENES = {
    "drawn_room": ("drawn_room", {"layout_seed": 2}),
    "room": ("room", {"people": 2}),
    "tower": ("tower", {}),
    "tile": ("tile", {}),
    "bench": ("tile", {"bench": True}),
}
VIEWS = (("cam00", 0.0), ("cam04", 1.3), ("cam08", 2.9), ("cam12", 5.0), ("cam05", 3.7))


# A ray that just hits or misses a moving part does the other a nanosecond earlier or later, as on another kind of
# processor, which rounds the last bits differently.
INSTANTS_S = (0.0, 1e-9, -1e-9)


def views(name: str, later_s: float = 0.0) -> Image:
    """Five views of a scene, side by side."""
    kind, params = SCENES[name]
    scene = make_scene(kind, {**params, "width": 96, "height": 72})
    return np.hstack([scene.render(camera, t_s + later_s) for camera, t_s in VIEWS])


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_looks_as_it_did(name):
    """Of the instants the nearest counts at each pixel, to a level of gray."""
    golden = cv2.imread(str(GOLDEN / f"{name}.png"))[..., ::-1].astype(np.int16)
    off = np.full(golden.shape[:2], 255)
    for later_s in INSTANTS_S:
        off = np.minimum(off, np.abs(views(name, later_s).astype(np.int16) - golden).max(axis=2))
        if (off > 1).sum() <= 3:
            return
    pytest.fail(f"{(off > 1).sum()} pixels differ")


if __name__ == "__main__":
    for scene in SCENES:
        cv2.imwrite(str(GOLDEN / f"{scene}.png"), views(scene)[..., ::-1])
