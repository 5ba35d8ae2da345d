"""What a field keeps of the cameras that feed it: newest views, the scene's box, the background color."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields import field_constants as tuned
from edge_server.fields.common.background import find_background
from edge_server.fields.common.kernels.rays import Views
from edge_server.fields.common.scene_box import SceneBox, scene_box
from edge_server.fields.common.settings import FieldSettings
from edge_server.fields.common.supervision import CameraMemory, check_view, pack_views, remember_views
from freshfield.geometry import Pinhole

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class PackedUpdate:
    """The views of one fit, packed, and what they changed.

    data: what the kernels read.
    box_changed: the scene's box was found anew, so what was learned is void.
    visibility_changed: cameras or moving pixels changed, so visibility must be counted again.
    """

    data: Views
    box_changed: bool
    visibility_changed: bool


class ViewStore:
    """The newest view of each camera of one field, and what follows from them."""

    def __init__(self, settings: FieldSettings) -> None:
        self.settings = settings
        self.box: SceneBox | None = None
        self.memory: dict[str, CameraMemory] = {}
        self.auto_background = np.full(3, 0.5, np.float32)
        self.background_is_plain = False  # whether that is the color of a plain background
        self._box_cameras = 0
        self._packed: tuple[tuple[View, ...], Views] | None = None

    @property
    def views(self) -> tuple[View, ...]:
        """The newest view of every camera."""
        return tuple(m.view for m in self.memory.values())

    def add(self, views: Sequence[View]) -> PackedUpdate:
        """Remember ``views`` and pack them for a fit. ValueError for one that cannot be a view."""
        if self._packed is not None and same_views(views, self._packed[0]):
            return PackedUpdate(self._packed[1], False, False)
        for view in views:
            check_view(view)
        visibility_changed, has_new_images = remember_views(self.memory, views)
        box_changed = False
        if self.box is None or self._box_cameras < min(len(self.memory), tuned.FINAL_BOX_CAMERAS):
            # Two or three cameras say little about where the scene is: find it anew when there are more.
            s = self.settings
            box = scene_box(self.views, s.center_m, s.radius_m, s.near_m, s.contracted)
            if self.box is None or not _similar(box, self.box):
                self.box, box_changed = box, True
            self._box_cameras = len(self.memory)
            self.auto_background, self.background_is_plain = find_background(views)
        if has_new_images and any(m.moved is not None for m in self.memory.values()):
            visibility_changed = True
        data = pack_views(views, self.box, self.memory)
        self._packed = (tuple(views), data)
        return PackedUpdate(data, box_changed, visibility_changed or box_changed)

    def keep_box(self) -> None:
        """Keep the scene's box, whatever cameras come."""
        self._box_cameras = tuned.FINAL_BOX_CAMERAS

    def forget_scene(self) -> None:
        """Forget the views, too: box and background are found anew, from those that come next."""
        self.box, self._box_cameras, self._packed, self.memory = None, 0, None, {}

    def forget_views(self) -> None:
        """Forget the views; box and background stay."""
        self.memory, self._packed = {}, None

    def background(self) -> NDArray[np.float32]:
        """The color (3,) behind everything that is rendered."""
        name = self.settings.background
        if name.startswith("#"):
            return np.array([int(name[k : k + 2], 16) / 255 for k in (1, 3, 5)], np.float32)
        if name in ("white", "black"):
            return np.full(3, 1.0 if name == "white" else 0.0, np.float32)
        return self.auto_background.copy()

    def meta(self) -> dict[str, Any]:
        """The part of the state that is not arrays, ready for JSON."""
        return {
            "box": asdict(self.box) if self.box else None,
            "box_cameras": self._box_cameras,
            "plain": self.background_is_plain,
            "cameras": [
                {"camera": m.view.camera, "generated_ns": m.view.generated_ns, **asdict(m.view.intrinsics)}
                for m in self.memory.values()
            ],
        }

    def arrays(self) -> Arrays:
        """The arrays of the state."""
        arrays: Arrays = {"behind": self.auto_background}
        for k, m in enumerate(self.memory.values()):
            arrays[f"image_{k}"], arrays[f"pose_{k}"] = m.view.image, np.asarray(m.view.camera_to_world)
            if m.moved is not None:
                arrays[f"moved_{k}"] = m.moved
        return arrays

    def load(self, meta: dict[str, Any], arrays: Arrays) -> None:
        """Restore what ``meta`` and ``arrays`` returned, into an empty store. ValueError, KeyError or
        TypeError where they are something else; the store is then of no use."""
        self._packed, self.memory = None, {}
        self._box_cameras = int(meta["box_cameras"])
        self.background_is_plain = bool(meta.get("plain", False))
        box = meta["box"]
        self.box = SceneBox(**{**box, "center_m": tuple(box["center_m"])}) if box else None
        if self.box is not None:
            _check_box(self.box)
        self.auto_background = np.array(arrays["behind"], dtype=np.float32)
        if self.auto_background.shape != (3,) or not np.isfinite(self.auto_background).all():
            raise ValueError(f"the state's background must be a color, not {self.auto_background.tolist()}")
        for k, entry in enumerate(meta["cameras"]):
            known = dict(entry)
            camera, generated_ns = known.pop("camera"), known.pop("generated_ns")
            known["distortion"] = tuple(known["distortion"])
            view = View(camera, arrays[f"image_{k}"], arrays[f"pose_{k}"], Pinhole(**known), generated_ns)
            check_view(view)
            moved = arrays.get(f"moved_{k}")
            if moved is not None and (moved.dtype != np.bool_ or moved.shape != view.image.shape[:2]):
                raise ValueError(f"camera {camera}: the pixels that moved are not those of its image")
            self.memory[camera] = CameraMemory(view, moved)


def same_views(a: Sequence[View], b: Sequence[View]) -> bool:
    """Whether both hold the very same objects."""
    return len(a) == len(b) and all(x is y for x, y in zip(a, b))


def _check_box(box: SceneBox) -> None:
    """ValueError for a box that ``scene_box`` never makes."""
    lengths = (box.radius_m, box.distance_m, box.pixel_m)
    if not np.isfinite([*box.center_m, *lengths, box.near_m]).all() or min(lengths) <= 0 or box.near_m < 0:
        raise ValueError(f"the state's scene box is none: {box}")


def _similar(a: SceneBox, b: SceneBox) -> bool:
    apart = float(np.linalg.norm(np.subtract(a.center_m, b.center_m)))
    near = tuned.SIMILAR_BOX * b.radius_m
    return apart < near and abs(a.radius_m - b.radius_m) < near
