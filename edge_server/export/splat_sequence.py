"""A saved splat stream as a sequence of PLY files, one a frame, as players of such sequences read them."""

from __future__ import annotations

from pathlib import Path

from edge_server.export import ExportError
from edge_server.export.export_constants import FRAMES_PER_S, GAP_S
from edge_server.export.splats import write_splats
from edge_server.fields.common.scene_box import SceneBox
from edge_server.page.splats.messages import MessageError, SceneBlock, StreamReader, read_saved


def write_sequence(path: Path, stream: Path) -> int:
    """Write what a visitor saw; returns the number of frames.

    path: ``room.ply`` makes ``room-0000.ply`` and so on, FRAMES_PER_S a second of the edge's time, the first once a
    static set is whole. ``.spz`` likewise.
    stream: a saved stream (docs/splat-stream.md).
    Raises ExportError: it cannot be read, or holds no Gaussians.
    """
    try:
        data = stream.read_bytes()
    except OSError as error:
        raise ExportError(f"{stream}: {error.strerror}") from None
    path.parent.mkdir(parents=True, exist_ok=True)
    reader, count, due_s = StreamReader(), 0, -float("inf")
    for number, (_, message) in enumerate(read_saved(data)):
        try:
            reader.read(message)
        except MessageError as error:
            raise ExportError(f"{stream}: message {number}: {error}") from None
        if reader.scene is None or not len(reader.at(reader.instant_s)):
            continue
        if abs(reader.instant_s - due_s) > GAP_S:
            due_s = reader.instant_s
        while due_s <= reader.instant_s:
            write_splats(path.with_stem(f"{path.stem}-{count:04d}"), reader.at(due_s), box_of(reader.scene))
            count, due_s = count + 1, due_s + 1.0 / FRAMES_PER_S
    if count == 0:
        raise ExportError(f"{stream}: holds no Gaussians: is it what the button save of the page /splats/ wrote?")
    return count


def box_of(scene: SceneBlock) -> SceneBox:
    """The box whose units the stream's Gaussians have."""
    return SceneBox(scene.center_m, scene.radius_m, scene.near * scene.radius_m, True, scene.radius_m, 0.0)
