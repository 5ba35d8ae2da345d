"""Decode buffered frames into views, as late as possible and once.

A frame is decoded only when a decision uses it. A policy may well select the same frame twice, so the decoder
keeps the last view of each camera.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from edge_server.fields import View
from edge_server.live.buffer import BufferedFrame
from freshfield import payload
from freshfield.frame import Frame

if TYPE_CHECKING:
    from edge_server.foreground.foreground import Foreground


class ViewDecoder:
    """Decodes buffered frames.

    foreground: cuts the background out of every image; None leaves images whole.
    undecodable: number of damaged payloads. A failure is remembered, so that a frame counts once.
    """

    def __init__(self, foreground: Foreground | None = None) -> None:
        self.foreground = foreground
        self._views: dict[str, tuple[Frame, View | None]] = {}
        self._earlier: dict[str, tuple[Frame, View | None]] = {}
        self.undecodable = 0

    def views(self, selected: Iterable[BufferedFrame]) -> list[View]:
        """Views of the selected frames in their order, without those that cannot be decoded."""
        return [view for item in selected if (view := self.view(item)) is not None]

    def view(self, item: BufferedFrame) -> View | None:
        """View of one frame, from then on the camera's last; None where it cannot be decoded."""
        frame = item.frame
        cached = self._views.get(frame.camera)
        if cached is not None and cached[0] is frame:
            return cached[1]
        view = self._decode(item)
        self._views[frame.camera] = (frame, view)
        return view

    def others(self, items: Iterable[BufferedFrame]) -> list[View]:
        """Views of frames that are not their cameras' newest and are used once, without those that cannot be
        decoded."""
        return [view for item in items if (view := self._decode(item)) is not None]

    def earlier(self, items: Iterable[BufferedFrame]) -> dict[str, View]:
        """Views of the frames before the newest, by camera, without those that cannot be decoded.

        Call it before ``views``: a frame that was the newest one then needs no second decoding.
        """
        found = {}
        for item in items:
            camera = item.frame.camera
            cached = (self._earlier.get(camera), self._views.get(camera))
            known = next((c for c in cached if c is not None and c[0] is item.frame), None)
            self._earlier[camera] = known or (item.frame, self._decode(item))
            view = self._earlier[camera][1]
            if view is not None:
                found[camera] = view
        return found

    def forget_earlier(self) -> None:
        """Free the views of ``earlier``."""
        self._earlier.clear()

    def _decode(self, item: BufferedFrame) -> View | None:
        frame, k = item.frame, item.frame.intrinsics
        try:
            image = payload.decode(frame.payload, frame.codec, k.width, k.height)
        except payload.PayloadError:
            self.undecodable += 1
            return None
        weight = None
        if self.foreground is not None:
            image, weight = self.foreground.apply(frame.camera, image)
        return View(frame.camera, image, frame.pose.matrix(), k, item.generated_ns, weight)
