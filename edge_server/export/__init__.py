"""Exports fields and runs as files for other programs, one module per format.

Files are written atomically (``freshfield.files``). Each module states how its format's conventions differ
from ours (camera-to-world, OpenCV axes, meters, w-first quaternions).
"""

from __future__ import annotations

from collections.abc import Sequence

from edge_server.fields import View


class ExportError(ValueError):
    """The export cannot be written as asked; the message says why and what to do."""


_PICTURES = {"png": (3, 4), "jpg": (3,), "jpeg": (3,)}  # ending -> channels of what is written


def file_names(views: Sequence[View]) -> list[str]:
    """A file name per view: the last part of its camera's name, with .png unless it is a picture's own name; numbered
    if two are equal. A transparent picture is always a .png."""
    names = []
    for view in views:
        plain = view.camera.replace("\\", "/").rsplit("/", 1)[-1]
        plain = "".join(c if c.isalnum() or c in "-_." else "_" for c in plain)
        stem, _, ending = plain.rpartition(".")
        if not stem or view.image.shape[2] not in _PICTURES.get(ending.lower(), ()):
            plain = f"{(stem if ending.lower() in _PICTURES else plain) or 'camera'}.png"
        names.append(plain)
    return names if len(set(names)) == len(names) else [f"{k:05d}_{name}" for k, name in enumerate(names)]
