"""What is behind the scene: a color that was chosen, or a plain one that the pictures show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields import field_constants as tuned
from edge_server.fields.common.settings import FieldSettings


def find_background(views: Sequence[View]) -> tuple[NDArray[np.float32], bool]:
    """The color (3,) taken to be behind everything, and whether it is a plain background's.

    White for cut-out pictures, else the plain color along the pictures' edges, else the mean color, which is
    the smallest mistake where rays find nothing.
    """
    if any(v.image.shape[2] == 4 for v in views):
        return np.ones(3, np.float32), False
    plain = plain_background(views)
    if plain is not None:
        return plain, True
    return np.mean([v.image.mean(axis=(0, 1)) / 255.0 for v in views], axis=0).astype(np.float32), False


def plain_background(views: Sequence[View]) -> NDArray[np.float32] | None:
    """The color (3,) in [0, 1] that nearly all pictures have nearly everywhere along their edges, if any."""
    edges = []
    for view in views:
        if view.image.shape[2] == 4:
            return None
        image = view.image
        edges.append(np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]]).astype(np.int16))
    color = np.median(np.concatenate(edges), axis=0)
    plain = [(np.abs(edge - color).max(axis=-1) <= tuned.PLAIN_STEPS).mean() for edge in edges]
    enough = np.percentile(plain, tuned.PLAIN_PERCENTILE) >= tuned.PLAIN_EDGE
    return (color / 255.0).astype(np.float32) if enough else None


def empty_color(settings: FieldSettings, views: Sequence[View]) -> NDArray[np.float32] | None:
    """The pictures' plain background color (3,), if they have one and the field renders it where nothing is.
    With another background, which the user chose, a plain sky has to be learned like everything else."""
    return plain_background(views) if settings.background == "auto" and views else None


def foreground_mask(image: NDArray[np.uint8], plain: NDArray[np.float32] | None) -> NDArray[np.bool_]:
    """Which pixels, bool (H, W), are neither transparent nor of the plain background color (3,)."""
    if image.shape[2] == 4:
        return np.asarray(image[..., 3] >= tuned.EMPTY_ALPHA)
    if plain is None:
        return np.ones(image.shape[:2], bool)
    return np.asarray(np.abs(image / 255.0 - plain).sum(axis=2) >= tuned.EMPTY_COLOR)
