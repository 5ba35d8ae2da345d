"""Frames of a periodic scene, rendered ahead and kept on disk, so that streaming costs only a look-up.

A folder's key hashes everything that determines its bytes: scene, parameters, camera, frame rate, codec,
quality, rendered effects and the renderer's source. A frame is therefore never stale, only unused. Damaged or
missing ones are rendered again. Nothing is kept in memory: ``camera_node.capture.ShotCache`` does that.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable
from fractions import Fraction
from functools import cache
from pathlib import Path

import cv2
import numpy as np

import freshfield.geometry
from camera_node.synthetic.effects import NO_EFFECTS, Effects
from camera_node.synthetic.motion import PERIOD_UNIT_S
from camera_node.synthetic.render import Image
from camera_node.synthetic.scene import Scene
from freshfield import payload
from freshfield.files import write_bytes
from freshfield.settings import as_mapping

# A sequence with more different frames counts as not repeating: frames are rendered on demand and not kept.
MAX_FRAMES = 3000
MAX_DISK_BYTES = 2 << 30
_NAME = re.compile("[0-9a-f]{32}")  # name of the folder of one camera's frames
_pruned: set[Path] = set()  # roots that this process has pruned
# Files of this package that do not influence what a frame looks like.
_NOT_RENDERING = ("frame_cache.py", "source.py")


def default_folder() -> Path:
    """The folder ``frames`` of $XDG_CACHE_HOME/freshfield, or of ~/.cache/freshfield."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "freshfield" / "frames"


class FrameCache:
    """The frames of one camera at one rate. Frame k shows the scene at k / fps + phase_ns.

    camera_id: camera of the scene.
    fps: frames a second, kept as a fraction (29.97 is 2997/100).
    effects: of this camera, from ``load_effects``.
    codec, quality: of the encoded frames.
    folder: root of the cache; None: ``default_folder()``.
    on_disk: False renders every frame anew.
    Raises ValueError for a rate that is not positive, EffectError for effects that do not fit the scene.

    Attributes:
    repeats_after: frames until the sequence repeats (1 for a static scene); None for more than MAX_FRAMES.
    contents: number of different outputs of ``read``; None if they do not repeat.
    disk_error: why the folder is no longer used, or None.
    """

    def __init__(
        self,
        scene: Scene,
        camera_id: str,
        fps: float | Fraction,
        *,
        effects: Effects = NO_EFFECTS,
        codec: str = "jpeg",
        quality: int = 92,
        folder: Path | None = None,
        on_disk: bool = True,
        phase_ns: int = 0,
    ) -> None:
        self.scene = effects.extend(scene)
        self.camera_id, self.codec, self.quality = camera_id, codec, quality
        self.fps, self.phase_ns = Fraction(fps).limit_denominator(1001), phase_ns
        if self.fps <= 0:
            raise ValueError(f"fps must be positive, got {fps}")
        self.repeats_after = _repeats_after(self.scene, self.fps)
        self.contents = None if effects.image else self.repeats_after
        self.disk_error: str | None = None
        self._effects = effects
        # Frames to which image effects are applied later are stored losslessly.
        self._stored_codec = "zstd" if effects.image else codec
        self._folder: Path | None = None
        if on_disk and self.repeats_after is not None:
            self._root = folder or default_folder()
            self._folder = self._root / self.key()[:32]
            with contextlib.suppress(OSError):
                os.utime(self._folder)  # used now: the last to be deleted

    def content(self, tick: int) -> int:
        """Number of the output of ``read`` that a tick shows."""
        return tick % self.contents if self.contents else tick

    def read(self, content: int) -> Image | bytes:
        """Output number ``content``: encoded bytes or, if there are image effects, an image uint8 (H, W, 3)
        that is still to be encoded."""
        if self._effects.image:
            return self._effects.apply(self.frame(content), content, self._time_s(content))
        return self.encoded(content)

    def frame(self, index: int) -> Image:
        """Frame ``index`` before effects of kind image: uint8 (H, W, 3), exact."""
        if self._stored_codec == "jpeg" or self.repeats_after is None:
            return self._render(self._wrapped(index))
        camera, _ = self.scene.cameras[self.camera_id]
        return payload.decode(self._stored(index), self._stored_codec, camera.width, camera.height)

    def encoded(self, index: int) -> bytes:
        """Frame ``index``, encoded, before effects of kind image."""
        if self._stored_codec != self.codec or self.repeats_after is None:
            return payload.encode(self.frame(index), self.codec, self.quality)
        return self._stored(index)

    def fill(self, stop: Callable[[], bool] = lambda: False) -> int:
        """Render all frames that are not on disk, until ``stop`` returns True. Returns how many were rendered.
        Frames can be read meanwhile: a missing one is rendered at once."""
        rendered = 0
        for index in range(self.repeats_after or 0):
            if stop() or self._folder is None:
                break
            if self._load(index) is None:
                self._render_and_save(index)
                rendered += 1
        return rendered

    def key(self) -> str:
        """Hash (hex) of everything that determines the frames' bytes."""
        camera, pose = self.scene.cameras[self.camera_id]
        what = {
            "scene": self.scene.name,
            "params": as_mapping(self.scene.params),
            "camera": dataclasses.asdict(camera),
            "pose": np.asarray(pose, dtype=np.float64).tolist(),
            "fps": str(self.fps),
            "effects": [[name, as_mapping(p)] for name, p in self._effects.rendered],
            "codec": [self._stored_codec, self.quality if self._stored_codec == "jpeg" else None],
            "renderer": renderer_version(),
            "phase_ns": self.phase_ns,
        }
        # ``count`` determines which cameras there are, not what one of them sees.
        what["params"].pop("count")
        return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()

    def _wrapped(self, index: int) -> int:
        if index < 0:
            raise ValueError(f"frame numbers start at 0, got {index}")
        return index % self.repeats_after if self.repeats_after else index

    def _render(self, frame: int) -> Image:
        view = self._effects.with_exposure(self.scene.renderer(self.camera_id))
        return view.image(self._time_s(frame))

    def _time_s(self, frame: int) -> float:
        return float(frame / self.fps) + self.phase_ns / 1e9

    def _stored(self, index: int) -> bytes:
        frame = self._wrapped(index)
        return self._load(frame) or self._render_and_save(frame)

    def _render_and_save(self, frame: int) -> bytes:
        data = payload.encode(self._render(frame), self._stored_codec, self.quality)
        if self._folder is not None:
            try:
                self._folder.mkdir(parents=True, exist_ok=True)
                if self._root not in _pruned:  # looking through all folders takes as long as a few frames
                    _pruned.add(self._root)
                    prune(self._root, self._folder, MAX_DISK_BYTES)
                # Other processes may write the same frame: it is replaced as a whole, by equal bytes.
                write_bytes(self._path(self._folder, frame), data)
            except OSError as error:
                # A full or read-only disk costs time, not frames.
                self.disk_error = f"{self._folder}: {error.strerror}"
                self._folder = None
        return data

    def _path(self, folder: Path, frame: int) -> Path:
        return folder / f"{frame:06d}.{self._stored_codec}"

    def _load(self, frame: int) -> bytes | None:
        """The frame's bytes; None if they are missing or damaged."""
        if self._folder is None:
            return None
        camera, _ = self.scene.cameras[self.camera_id]
        try:
            data = self._path(self._folder, frame).read_bytes()
            payload.check(data, self._stored_codec, camera.width, camera.height)
        except (OSError, payload.PayloadError):
            return None
        return data


def _repeats_after(scene: Scene, fps: Fraction) -> int | None:
    if not scene.moving:
        return 1
    period = Fraction(round(scene.period_s / PERIOD_UNIT_S)) * Fraction(PERIOD_UNIT_S).limit_denominator(10)
    # The numerator is the least number of frames that take a whole number of periods.
    frames = (period * fps).numerator
    return frames if frames <= MAX_FRAMES else None


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
        try:
            sizes = [f.stat().st_size for f in os.scandir(folder) if f.is_file()]
            folders.append((folder.stat().st_mtime, sum(sizes), folder))
        except OSError:
            continue  # somebody else deleted it
    total, freed = sum(size for _, size, _ in folders), 0
    for _, size, folder in sorted(folders):
        if total - freed <= limit_bytes:
            break
        if folder != keep:
            shutil.rmtree(folder, ignore_errors=True)
            freed += size
    return freed
