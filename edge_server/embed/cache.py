"""Caches embeddings of frames, computed when a decision first uses a frame."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from freshfield.frame import Frame

if TYPE_CHECKING:
    from edge_server.embed.embedder import Embedder

# Number of embeddings to keep: several rounds of the largest rigs.
CAPACITY = 1024

_Key = tuple[str, str, int]
_Row = NDArray[np.float32] | None


class EmbeddingCache:
    """Embeds each frame once. Not thread-safe.

    computed, failed: number of frames. A failure is remembered, so that a frame is tried and counted once.
    """

    def __init__(self, embedder: Embedder, decode: Callable[[Frame], Any], capacity: int = CAPACITY) -> None:
        """decode: gives a frame's view with its ``image``, None if it is damaged. Share it with the field, so
        that a frame that both use is decoded once. capacity: number of embeddings to keep."""
        self._embedder, self._decode, self._capacity = embedder, decode, capacity
        # None: the frame has no embedding.
        self._rows: OrderedDict[_Key, _Row] = OrderedDict()
        self.computed = 0
        self.failed = 0

    def of(self, frames: Sequence[Frame]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Embed frames. Returns embeddings, float32 (n, dim), and their validity, bool (n,).

        A frame that cannot be decoded, or whose embedding is not finite, has a row of zeros and is not valid.
        """
        keys = [(frame.camera, frame.session, frame.sequence) for frame in frames]
        missing = {key: frame for key, frame in zip(keys, frames) if key not in self._rows}
        self._rows |= self._embed(missing)
        for key in keys:
            self._rows.move_to_end(key)
        rows = [self._rows[key] for key in keys]  # before anything is evicted: a decision may be larger than the cache
        while len(self._rows) > self._capacity:
            self._rows.popitem(last=False)
        zeros = np.zeros(self._embedder.dim, np.float32)
        out = np.array([zeros if row is None else row for row in rows], np.float32).reshape(-1, self._embedder.dim)
        return out, np.array([row is not None for row in rows], np.bool_)

    def _embed(self, missing: dict[_Key, Frame]) -> dict[_Key, _Row]:
        found: dict[_Key, _Row] = dict.fromkeys(missing)
        views = {key: view for key, frame in missing.items() if (view := self._decode(frame)) is not None}
        if views:
            rows = self._embedder.embed([view.image for view in views.values()])
            # An embedder gives zeros where its model gave NaN.
            good = {key: row.copy() for key, row in zip(views, rows) if np.isfinite(row).all() and row.any()}
            found |= good
        self.computed += len(missing)
        self.failed += sum(row is None for row in found.values())
        return found
