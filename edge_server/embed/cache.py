"""Embeddings of buffered frames, computed when a decision first uses a frame and then kept."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from edge_server.live.buffer import Buffered
from edge_server.live.view_decoder import Decoder

# Frames whose embeddings are kept: several rounds of the largest rigs. A kilobyte each at most.
CAPACITY = 1024


class Embeds(Protocol):
    """An Embedder, as far as the cache needs it."""

    @property
    def name(self) -> str: ...

    @property
    def dim(self) -> int: ...

    def embed(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]: ...


class EmbeddingCache:
    """Embeds each frame once. ``computed`` and ``failed`` count frames; one that failed is remembered, so
    that a frame that stays newest for long is tried and counted once. One owner: not thread-safe."""

    def __init__(self, embedder: Embeds, decoder: Decoder, capacity: int = CAPACITY) -> None:
        """decoder: shared with the field's, so that a frame that both use is decoded once."""
        self._embedder, self._decoder, self._capacity = embedder, decoder, capacity
        # Frame -> its row, or None where it has none.
        self._rows: OrderedDict[tuple[str, str, int], NDArray[np.float32] | None] = OrderedDict()
        self.computed = 0
        self.failed = 0

    def of(self, items: Sequence[Buffered]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """(embeddings (n, dim), ok (n,)) of buffered frames, in their order. Where a frame cannot be decoded
        or the model gave no finite embedding, its row is zero and its ok False: that camera counts as one
        without embedding."""
        keys = [(i.frame.camera, i.frame.session, i.frame.sequence) for i in items]
        missing = {key: item for key, item in zip(keys, items) if key not in self._rows}
        # What this decision needs is not evicted by it, however large it is.
        found = {key: self._rows[key] for key in keys if key in self._rows} | self._embed(missing)
        for key in keys:
            self._rows[key] = found[key]
            self._rows.move_to_end(key)
        while len(self._rows) > self._capacity:
            self._rows.popitem(last=False)
        out = np.zeros((len(keys), self._embedder.dim), dtype=np.float32)
        ok = np.zeros(len(keys), dtype=np.bool_)
        for k, key in enumerate(keys):
            row = found[key]
            if row is not None:
                out[k], ok[k] = row, True
        return out, ok

    def _embed(
        self, missing: dict[tuple[str, str, int], Buffered]
    ) -> dict[tuple[str, str, int], NDArray[np.float32] | None]:
        found: dict[tuple[str, str, int], NDArray[np.float32] | None] = dict.fromkeys(missing)
        views = {key: view for key, item in missing.items() for view in self._decoder.views([item])}
        if views:
            rows = self._embedder.embed([view.image for view in views.values()])
            found |= {key: row.copy() if _good(row) else None for key, row in zip(views, rows)}
        self.computed += len(missing)
        self.failed += sum(row is None for row in found.values())
        return found


def _good(row: NDArray[np.float32]) -> bool:
    """Whether it is an embedding: an Embedder gives zeros where the model gave NaN."""
    return bool(np.isfinite(row).all() and row.any())
