"""A folder of rendered frames, so that a scene that was streamed before starts at once.

Its name is a key that hashes everything that determines the bytes. A frame is therefore never stale, only unused.
Damaged or missing ones are rendered again. Nothing is kept in memory: ``camera_node.capture.ShotCache`` does that.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
from functools import cache
from pathlib import Path

import cv2
import numpy as np

import freshfield.geometry
from camera_node import node_constants as tuned
from freshfield import payload
from freshfield.files import write_bytes

_NAME = re.compile("[0-9a-f]{32}")  # name of the folder of one camera's frames
_pruned: set[Path] = set()  # roots that this process has pruned
# Files of this package that do not influence what an image looks like.
_NOT_RENDERING = ("depth.py", "depth_sensor.py", "frame_cache.py", "source.py")


def default_folder() -> Path:
    """The folder ``frames`` of $XDG_CACHE_HOME/freshfield, or of ~/.cache/freshfield."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "freshfield" / "frames"


class FrameCache:
    """Encoded frames of one camera, by number.

    key: hash (hex) of what determines their bytes. size: their width and height. root: folder of all caches.
    error: why the folder is no longer used, or None.
    """

    def __init__(self, key: str, codec: str, size: tuple[int, int], root: Path) -> None:
        self.error: str | None = None
        self._root, self._folder = root, root / key[:32]
        self._codec, self._size = codec, size
        with contextlib.suppress(OSError):
            os.utime(self._folder)  # used now: the last to be deleted

    def load(self, frame: int) -> bytes | None:
        """The frame's bytes; None if they are missing or damaged."""
        try:
            data = self._path(frame).read_bytes()
            payload.check(data, self._codec, *self._size)
        except (OSError, payload.PayloadError):
            return None
        return data

    def save(self, frame: int, data: bytes) -> None:
        """Keep a frame. A full or read-only disk costs time, not frames."""
        if self.error is not None:
            return
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            if self._root not in _pruned:  # looking through all folders takes as long as a few frames
                _pruned.add(self._root)
                prune(self._root, self._folder, tuned.RENDERED_DISK_BYTES)
            # Other processes may write the same frame: it is replaced as a whole, by equal bytes.
            write_bytes(self._path(frame), data)
        except OSError as error:
            self.error = f"{self._folder}: {error.strerror}"

    def _path(self, frame: int) -> Path:
        return self._folder / f"{frame:06d}.{self._codec}"


@cache
def renderer_version() -> str:
    """Hash (hex) of the source files and library versions that determine what a frame looks like."""
    here = Path(__file__).parent
    files = [p for p in sorted(here.rglob("*.py")) if p.name not in _NOT_RENDERING]
    files += [Path(freshfield.geometry.__file__), Path(payload.__file__)]
    digest = hashlib.sha256(f"{np.__version__} {cv2.__version__}".encode())
    for path in files:
        digest.update(path.read_bytes())
    return digest.hexdigest()


def prune(root: Path, keep: Path, limit_bytes: int) -> int:
    """Delete the least recently used folders of ``root``, except ``keep``, until it holds at most
    ``limit_bytes``. Returns the bytes freed. Other processes may do the same at the same time."""
    folders: list[tuple[float, int, Path]] = []
    for folder in root.iterdir():
        if not _NAME.fullmatch(folder.name):
            continue  # none of ours
        with contextlib.suppress(OSError):  # somebody else deleted it
            sizes = [f.stat().st_size for f in os.scandir(folder) if f.is_file()]
            folders.append((folder.stat().st_mtime, sum(sizes), folder))
    total, freed = sum(size for _, size, _ in folders), 0
    for _, size, folder in sorted(folders):
        if total - freed <= limit_bytes:
            break
        if folder != keep:
            shutil.rmtree(folder, ignore_errors=True)
            freed += size
    return freed
