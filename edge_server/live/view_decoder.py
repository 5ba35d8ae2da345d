"""Encoded frames become views, as late as possible and once.

Pay late: a frame is decoded only when a decision uses it. The cache holds the last decoded frame of each
camera, because a policy may well select the same frame twice.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from edge_server.fields import View
from edge_server.live.buffer import Buffered
from freshfield import payload
from freshfield.frame import Frame

if TYPE_CHECKING:
    from edge_server.foreground.foreground import Foreground


class Decoder:
    """Decodes buffered frames. ``undecodable`` counts damaged payloads; one that failed is remembered, so
    that a frame that stays newest for long is counted once. foreground: cuts the background out of every
    picture, or None."""

    def __init__(self, foreground: Foreground | None = None) -> None:
        self.foreground = foreground
        self._views: dict[str, tuple[Frame, View | None]] = {}
        self._earlier: dict[str, tuple[Frame, View | None]] = {}
        self.undecodable = 0

    def views(self, selected: Iterable[Buffered]) -> list[View]:
        """Views of the selected frames, in their order, without those that cannot be decoded."""
        return [view for item in selected if (view := self._view(item)) is not None]

    def earlier(self, items: Iterable[Buffered]) -> dict[str, View]:
        """The views that cameras delivered before their newest, camera -> view, without those that cannot be
        decoded. To be asked before ``views``: what was newest then need not be decoded again."""
        found = {}
        for item in items:
            camera = item.frame.camera
            known = next(
                (c for c in (self._earlier.get(camera), self._views.get(camera)) if c and c[0] is item.frame),
                None,
            )
            self._earlier[camera] = known or (item.frame, self._decode(item))
            view = self._earlier[camera][1]
            if view is not None:
                found[camera] = view
        return found

    def forget_earlier(self) -> None:
        """Give back the memory of ``earlier``: nobody compares frames any more."""
        self._earlier.clear()

    def _view(self, item: Buffered) -> View | None:
        frame = item.frame
        cached = self._views.get(frame.camera)
        if cached is not None and cached[0] is frame:
            return cached[1]
        view = self._decode(item)
        self._views[frame.camera] = (frame, view)
        return view

    def _decode(self, item: Buffered) -> View | None:
        frame = item.frame
        view: View | None = None
        try:
            k = frame.intrinsics
            image = payload.decode(frame.payload, frame.codec, k.width, k.height)
            weight = None
            if self.foreground is not None:
                image, weight = self.foreground.apply(frame.camera, image)
            view = View(frame.camera, image, frame.pose.matrix(), k, item.generated_ns, weight)
        except payload.PayloadError:
            self.undecodable += 1
        return view
