"""Keeps the embedding of each camera's newest frame, computed when a decision first uses it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from freshfield.frame import Frame

if TYPE_CHECKING:
    from edge_server.embed.embedder import Embedder

_Row = NDArray[np.float32] | None


class EmbeddingCache:
    """Embeds each frame once, as long as no other one of its camera is asked for. Not thread-safe.

    A failure is remembered, so that a frame is tried once.
    """

    def __init__(self, embedder: Embedder, decode: Callable[[Frame], Any]) -> None:
        """decode: gives a frame's view with its ``image``, None if it is damaged. Share it with the field, so
        that a frame that both use is decoded once."""
        self._embedder, self._decode = embedder, decode
        # By camera: session and sequence of its frame; None: it has no embedding.
        self._rows: dict[str, tuple[tuple[str, int], _Row]] = {}

    def of(self, frames: Sequence[Frame]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Embed frames, one of a camera. Returns embeddings, float32 (n, dim), and their validity, bool (n,).

        A frame that cannot be decoded, or whose embedding is not finite, has a row of zeros and is not valid.
        """
        self._embed([f for f in frames if self._rows.get(f.camera, ("",))[0] != (f.session, f.sequence)])
        rows = [self._rows[frame.camera][1] for frame in frames]
        nothing = np.zeros(self._embedder.dim, np.float32)
        out = np.array([nothing if row is None else row for row in rows], np.float32)
        return out.reshape(len(rows), len(nothing)), np.array([row is not None for row in rows], np.bool_)

    def _embed(self, missing: Sequence[Frame]) -> None:
        views = {frame.camera: view for frame in missing if (view := self._decode(frame)) is not None}
        rows = self._embedder.embed([view.image for view in views.values()]) if views else ()
        # An embedder gives zeros where its model gave NaN.
        good = {camera: row.copy() for camera, row in zip(views, rows) if np.isfinite(row).all() and row.any()}
        for frame in missing:
            self._rows[frame.camera] = (frame.session, frame.sequence), good.get(frame.camera)
