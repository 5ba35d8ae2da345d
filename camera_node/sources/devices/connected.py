"""Which cameras are plugged in (``camera-node devices``): what to write as ``source.devices``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from camera_node.sources.devices import oak, realsense
from camera_node.sources.devices.feed import CameraError, Plugged


class Connected(NamedTuple):
    """A camera. kind: of the source that reads it. device: its name in ``source.devices``; "" where nothing was found.
    about: its make, or why there is none."""

    kind: str
    device: str
    about: str


def connected(root: Path = Path("/")) -> Iterator[Connected]:
    """All cameras, kind by kind, each opened by none of the drivers.

    root: folder that holds the system's ``dev`` and ``sys``.
    """
    yield from _video_devices(root)
    yield from _of_library("oak", oak.plugged_in)
    yield from _of_library("realsense", realsense.plugged_in)


def _video_devices(root: Path) -> Iterator[Connected]:
    """Linux's video devices. A camera has several; the first one gives its images."""
    names = {link.resolve().name: link for link in sorted((root / "dev/v4l/by-id").glob("*"))}
    entries = sorted((root / "sys/class/video4linux").glob("video*"), key=lambda e: int(e.name.removeprefix("video")))
    found = False
    for entry in entries:
        index = entry / "index"
        if index.is_file() and index.read_text().strip() != "0":
            continue
        found = True
        label = entry / "name"
        link = names.get(entry.name)
        lasting = f"; the same at every start: /{link.relative_to(root)}" if link else ""
        about = (label.read_text(errors="replace").strip() if label.is_file() else "a video device") + lasting
        yield Connected("camera", entry.name.removeprefix("video"), about)
    if not found:
        yield Connected("camera", "", "no video device is plugged in, or this is not Linux")


def _of_library(kind: str, plugged_in: Callable[[], Sequence[Plugged]]) -> Iterator[Connected]:
    try:
        there = plugged_in()
    except (CameraError, RuntimeError) as error:
        yield Connected(kind, "", str(error))
        return
    yield from (Connected(kind, each.serial, each.about) for each in there)
    if not there:
        yield Connected(kind, "", "none is plugged in")
