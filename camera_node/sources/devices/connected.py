"""Which cameras are plugged in (``camera-node devices``): what to write as ``source.devices``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from camera_node.sources.devices.feed import CameraError


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
    yield from _oak()
    yield from _realsense()


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


def _oak() -> Iterator[Connected]:
    try:
        from camera_node.sources.devices.oak import library

        there = library().Device.getAllAvailableDevices()
        yield from (Connected("oak", each.getDeviceId(), f"{each.name} {each.state.name}") for each in there)
        if not there:
            yield Connected("oak", "", "none is plugged in")
    except (CameraError, RuntimeError) as error:
        yield Connected("oak", "", str(error))


def _realsense() -> Iterator[Connected]:
    try:
        from camera_node.sources.devices.realsense import library

        rs = library()
        there = rs.context().query_devices()
        for each in there:
            about = each.get_info(rs.camera_info.name)
            yield Connected("realsense", each.get_info(rs.camera_info.serial_number), about)
        if not len(there):
            yield Connected("realsense", "", "none is plugged in")
    except (CameraError, RuntimeError) as error:
        yield Connected("realsense", "", str(error))
