"""Real frames for the edge's tests: encoded, posed, checksummed, as a node would send them; and a real field, small
enough that an update takes milliseconds."""

from dataclasses import replace

import numpy as np

from edge_server.fields.registry import make_field
from freshfield import payload
from freshfield.frame import Frame
from freshfield.geometry import Pinhole, Pose, look_at

CAMERA = Pinhole.from_fov(32, 24, 60.0)
TINY = {"levels": 2, "log2_table": 10, "rays": 256, "batch_samples": 4096, "samples": 24}
TINY |= {"center_m": [0.0, 0.0, 0.0], "radius_m": 1.0}


def tiny_field(seed: int = 0):
    return make_field("ngp", TINY, seed)


def frame(camera: str = "cam01", sequence: int = 0, generated_ns: int = 0, **other) -> Frame:
    """A 32 x 24 JPEG frame of ``camera``; ``other`` overrides any field of Frame."""
    image = np.full((24, 32, 3), 40 + 10 * abs((sequence + 20) % 40 - 20), np.uint8)  # no jump
    image[4:12, 6:20, 0] = 220
    pose = Pose.from_matrix(look_at([2.0, 0.0, 1.0], [0.0, 0.0, 0.0]))
    taken = Frame(camera, "s1", sequence, generated_ns, pose, CAMERA, "jpeg", payload.encode(image))
    return replace(taken, **other)


def damaged_frame(camera: str = "cam01", **other) -> Frame:
    """A frame that passes every check of its headers and cannot be decoded: its image data is cut off."""
    noise = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
    return frame(camera, codec="png", payload=payload.encode(noise, "png")[:60], **other)
