"""Plates of the synthetic room from fixed cameras, with their exact depth."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic import make_scene
from edge_server.fields.common.threads.thread_pool import shared_pool
from edge_server.fields.splat.layers.depth.depth_plate import smooth
from edge_server.fields.splat.layers.depth.surfaces import Surface
from freshfield.geometry import Pinhole


@cache
def room_plates(count: int, size: int = 128) -> tuple[list[Surface], NDArray[np.float64]]:
    """Plates of the room without a person, and their depths (N, H, W)."""
    scene = make_scene("room", {"count": count + 1, "width": size, "height": size, "people": 0, "supersample": 2})
    plates, depths = [], []
    for name, (lens, pose) in list(scene.cameras.items())[1:]:
        renderer = scene.renderer(name)
        plates.append(plate_of(renderer.image(0.0), pose, lens))
        # Of the four rays around a pixel's center.
        fine = renderer.distance() * lens.scaled(2).rays()[..., 2]
        depths.append(fine.reshape(size, 2, size, 2).mean(axis=(1, 3)))
    return plates, np.stack(depths)


def plate_of(image: NDArray[np.uint8], pose: NDArray[np.float64], lens: Pinhole) -> Surface:
    """A plate of which no depth is known."""
    shape = image.shape[:2]
    nothing = np.zeros((*shape, 2), np.float32)
    return Surface(lens, pose, image.astype(np.float32), np.ones(shape, bool), nothing[..., 0], nothing)


def relative_of(depth_m: NDArray[np.floating], seed: int) -> NDArray[np.float32]:
    """What a network says of a depth: edges blurred by 1.5 pixels, a smooth error of 5 %, any scale and shift."""
    rng = np.random.default_rng(seed)
    waves = cv2.resize(rng.normal(size=(4, 4)), depth_m.shape[::-1], interpolation=cv2.INTER_CUBIC)
    inverse = cv2.GaussianBlur(1.0 / depth_m, (0, 0), 1.5) * np.exp(0.05 * waves / waves.std())
    return (rng.uniform(0.5, 2.0) * inverse + rng.uniform(-0.05, 0.15)).astype(np.float32)


@cache
def room_surfaces(count: int, size: int) -> list[Surface]:
    """The plates with their exact depth, smoothed."""
    found = []
    for plate, depth in zip(*room_plates(count, size)):
        inverse, slope = smooth((1.0 / depth).astype(np.float32), plate.color, shared_pool())
        found.append(replace(plate, inverse=inverse, slope=slope))
    return found
