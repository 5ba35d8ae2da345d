"""Decodes buffered frames into views, as late as possible and only once.

A frame is decoded only when a decision uses it. A policy may select the same frame twice, so the decoder keeps the
last view of each camera.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

from edge_server.fields import View
from freshfield import payload
from freshfield.frame import Frame
from freshfield.geometry import Pinhole

if TYPE_CHECKING:
    from edge_server.foreground.foreground import Foreground


class ViewDecoder:
    """Decodes buffered frames.

    foreground: cuts the background out of every image; None leaves images whole.
    most_pixels: largest number of pixels of an image; larger ones are decoded at 1/2, 1/4 or 1/8 of their
    width and height. None: images keep their size.
    undecodable: number of damaged payloads. A failure is remembered, so that a frame counts once.
    undecodable_depth: number of frames whose depth is damaged, which are used without it.
    """

    def __init__(self, foreground: Foreground | None = None, most_pixels: int | None = None) -> None:
        self.foreground = foreground
        self.most_pixels = most_pixels
        self._views: dict[str, tuple[Frame, View | None]] = {}
        self.undecodable = self.undecodable_depth = 0

    def take_at_most(self, pixels: int | None) -> None:
        """Set ``most_pixels``. Views of another size are forgotten."""
        if pixels != self.most_pixels:
            self.most_pixels = pixels
            self._views.clear()

    def views(self, selected: Iterable[Frame]) -> list[View]:
        """Views of the selected frames in their order, without those that cannot be decoded."""
        return [view for item in selected if (view := self.view(item)) is not None]

    def view(self, frame: Frame) -> View | None:
        """View of one frame, kept as its camera's last; None if it cannot be decoded."""
        cached = self._views.get(frame.camera)
        if cached is not None and cached[0] is frame:
            return cached[1]
        view = self._decode(frame)
        self._views[frame.camera] = (frame, view)
        return view

    def others(self, items: Iterable[Frame]) -> list[View]:
        """Views of frames that are not their cameras' newest and are used once, without those that cannot be
        decoded."""
        return [view for item in items if (view := self._decode(item)) is not None]

    def _decode(self, item: Frame) -> View | None:
        halvings = self._halvings(item.intrinsics)
        view = self._decode_at(item, halvings)
        if view is None:
            self.undecodable += 1
            return None
        self.undecodable_depth += item.depth is not None and view.depth is None
        return replace(view, whole=lambda: self._decode_at(item, 0)) if halvings else view

    def _decode_at(self, frame: Frame, halvings: int) -> View | None:
        k = frame.intrinsics
        try:
            image = payload.decode(frame.payload, frame.codec, k.width, k.height, halvings)
        except payload.PayloadError:
            return None
        if self.foreground is not None:
            image = self.foreground.apply(frame.camera, image)
        taken_ns = frame.generated_edge_ns
        view = View(frame.camera, image, frame.pose.matrix(), k.halved(halvings), taken_ns)
        if frame.depth is None:
            return view
        from edge_server.live.depth_in_image import depth_in_image  # only where a camera measures depth

        try:
            depth = depth_in_image(frame.depth.decode(), k, halvings)
        except payload.PayloadError:
            return view
        return replace(view, depth=depth, depth_ns=taken_ns + frame.depth.after_image_ns)

    def _halvings(self, k: Pinhole) -> int:
        if self.most_pixels is None:
            return 0
        return next((n for n in range(3) if (k.width * k.height) >> 2 * n <= self.most_pixels), 3)
