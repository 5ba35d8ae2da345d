"""Which cameras are plugged in (``camera-node devices``): what to write as ``source.devices``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from camera_node.sources.devices import oak, realsense
from camera_node.sources.devices.feed import CameraError, Plugged


def connected(root: Path = Path("/")) -> Iterator[tuple[str, Plugged]]:
    """All cameras, kind by kind, each opened by none of the drivers, with the kind of source that reads it.

    root: folder that holds the system's ``dev`` and ``sys``.
    """
    yield from _video_devices(root)
    yield from _of_library("oak", oak.plugged_in)
    yield from _of_library("realsense", realsense.plugged_in)


def _video_devices(root: Path) -> Iterator[tuple[str, Plugged]]:
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
        yield "camera", Plugged(entry.name.removeprefix("video"), about)
    if not found:
        yield "camera", Plugged("", "no video device is plugged in, or this is not Linux")


def _of_library(kind: str, plugged_in: Callable[[], Sequence[Plugged]]) -> Iterator[tuple[str, Plugged]]:
    try:
        there = plugged_in() or [Plugged("", "none is plugged in")]
    except (CameraError, RuntimeError) as error:
        there = [Plugged("", str(error))]
    yield from ((kind, each) for each in there)
