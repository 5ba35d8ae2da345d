"""Encoded frames become views, as late as possible and once.

Pay late: a frame is decoded only when a decision uses it. The cache holds the last decoded frame of each
camera, because a policy may well select the same frame twice.
"""

from __future__ import annotations

from collections.abc import Iterable

from edge_server.buffer import Buffered
from edge_server.fields import View
from freshfield import payload
from freshfield.frame import Frame


class Decoder:
    """Decodes buffered frames. ``undecodable`` counts damaged payloads; one that failed is remembered, so
    that a frame that stays newest for long is counted once."""

    def __init__(self) -> None:
        self._views: dict[str, tuple[Frame, View | None]] = {}
        self.undecodable = 0

    def views(self, selected: Iterable[Buffered]) -> list[View]:
        """Views of the selected frames, in their order, without those that cannot be decoded."""
        return [view for item in selected if (view := self._view(item)) is not None]

    def _view(self, item: Buffered) -> View | None:
        frame = item.frame
        cached = self._views.get(frame.camera)
        if cached is not None and cached[0] is frame:
            return cached[1]
        view: View | None = None
        try:
            k = frame.intrinsics
            image = payload.decode(frame.payload, frame.codec, k.width, k.height)
            view = View(frame.camera, image, frame.pose.matrix(), k, item.generated_ns)
        except payload.PayloadError:
            self.undecodable += 1
        self._views[frame.camera] = (frame, view)
        return view
