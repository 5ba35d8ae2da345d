"""Makes the shots that repeat before the first is due, so that streaming is cheap."""

from __future__ import annotations

import contextlib
import ctypes
import logging
from collections.abc import Callable, Sequence

from camera_node.capture import Camera

log = logging.getLogger("camera-node")


def prepare(cameras: Sequence[Camera], stopped: Callable[[], bool]) -> None:
    """Fill the cache with the shots of each camera whose shots all fit, and free what made them.

    Shots that do not all fit are made as they are captured: making a part of them now would delay the first
    frame and save little.
    """
    for camera in cameras:
        camera.source.prepare(stopped)
        contents = camera.source.contents
        if contents is None or not camera.fits():
            continue
        for content in range(contents):
            if stopped():
                return
            try:
                camera.shot(content)
            except (ValueError, OSError):
                continue  # counted when the capture is due
        camera.source.release()
    return_memory()


def return_memory() -> None:
    """Hand freed memory back to the system where the C library can (glibc keeps it otherwise)."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
