"""How features become fewer numbers: by the model's own projection, or a fixed random one."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge_server.embed import EmbeddingError

# Written by edge-server train-detector of tag v0.1-all: mean (C,) and axes (C, K) of the pooled features.
PROJECTION_KEY = "freshfield.projection"
# Fixed, so that a model's embeddings do not depend on the scenario's seed.
_SEED = 20240631


@dataclass(frozen=True)
class Projection:
    """A model's learned projection: embeddings are (features - mean) @ axes. mean: (C,). axes: (C, K)."""

    mean: NDArray[np.float32]
    axes: NDArray[np.float32]


def stored_projection(meta: dict[str, str], channels: int, path: Path) -> Projection | None:
    """The projection that a model of ours carries in its metadata; None without one."""
    if PROJECTION_KEY not in meta:
        return None
    try:
        values = np.frombuffer(base64.b64decode(meta[PROJECTION_KEY], validate=True), "<f4")
        mean, axes = values[:channels], values[channels:].reshape(channels, -1)
    except ValueError:
        raise EmbeddingError(f"{path}: its projection is damaged: fetch the file again") from None
    if len(mean) != channels or not np.isfinite(values).all():
        raise EmbeddingError(f"{path}: its projection is damaged: fetch the file again")
    return Projection(mean.astype(np.float32), axes.astype(np.float32))


def mean_and_axes(
    projection: Projection | None, channels: int, dim: int, of: str
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean (C,) and axes (C, dim): the model's own, else fixed, random and orthonormal, which keeps distances
    as well as any projection that ignores the data.

    projection: the model's own. channels: C. of: whose features these are, for people.
    EmbeddingError: ``dim`` exceeds what there is.
    """
    if projection is not None:
        if dim > projection.axes.shape[1]:
            raise EmbeddingError(f"dim: {of} has {projection.axes.shape[1]} axes, {dim} were asked for")
        return projection.mean, np.ascontiguousarray(projection.axes[:, :dim])
    if dim > channels:
        raise EmbeddingError(f"dim: {of} has {channels} channels, {dim} numbers were asked for")
    draw = np.random.default_rng(_SEED).standard_normal((channels, dim))
    q, r = np.linalg.qr(draw)
    # QR is unique only up to signs: fixed, they are the same in all libraries.
    return np.zeros(channels, np.float32), (q * np.sign(np.diag(r))).astype(np.float32)
