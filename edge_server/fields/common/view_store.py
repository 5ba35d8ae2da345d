"""What a field remembers of the cameras that feed it: newest views, the scene's box, the mean colour."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.kernels.rays import Views
from edge_server.fields.common.scene_box import SceneBox, plain_background, scene_box
from edge_server.fields.common.supervision import CameraMemory, check_view, leave_out, pack_views, remember
from edge_server.fields.common.view_outliers import Pixels, TrustSettings, refused, weights
from freshfield.geometry import Pinhole

Arrays = dict[str, NDArray[Any]]

FINAL = 4  # cameras from which on a scene's box is kept
SETTLED = 100  # steps after which a field may doubt what it is shown


class RigSettings(TrustSettings, Protocol):
    """The options that are read here; ``TrainerSettings`` says what they mean."""

    @property
    def centre_m(self) -> tuple[float, float, float] | None: ...
    @property
    def radius_m(self) -> float | None: ...
    @property
    def near_m(self) -> float | None: ...
    @property
    def contracted(self) -> bool | None: ...
    @property
    def background(self) -> str: ...
    @property
    def refuse_beyond(self) -> float: ...


class PixelRenderer(Protocol):
    """Shows single pixels, as ``NgpSnapshot`` does: colour (N, 3), depth (N,) in metres and opacity (N,) at
    image points (N, 2)."""

    def render_pixels(
        self, camera_to_world: NDArray[np.float64], intrinsics: Pinhole, pixels: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]: ...


@dataclass(frozen=True)
class Intake:
    """data: what the kernels read. new_box: the scene was found anew, so what was learnt is void.
    look: cameras or moving pixels changed, so visibility must be counted again. fresh: some picture was not
    known before (a field that was loaded knows the pictures it was saved with)."""

    data: Views
    new_box: bool
    look: bool
    fresh: bool


class Rig:
    """The cameras of one field."""

    def __init__(self, settings: RigSettings) -> None:
        self.settings = settings
        self.box: SceneBox | None = None
        self.memory: dict[str, CameraMemory] = {}
        self.behind = np.full(3, 0.5, np.float32)
        self.plain = False  # whether ``behind`` is the colour of a plain background
        self.left_out: set[str] = set()  # cameras whose newest view is refused
        self._box_cameras = 0
        self._packed: tuple[tuple[View, ...], Views] | None = None

    @property
    def views(self) -> tuple[View, ...]:
        """The newest view of every camera."""
        return tuple(m.view for m in self.memory.values())

    def take_in(self, views: Sequence[View]) -> Intake:
        """Learn from ``views`` and pack them. Raises ValueError for one that cannot be a view."""
        if self._packed is not None and same_views(views, self._packed[0]):
            return Intake(self._packed[1], new_box=False, look=False, fresh=False)
        for view in views:
            check_view(view)
        fresh = any(self._unknown(view) for view in views)
        look, new_box = remember(self.memory, views), False
        if self.box is None or self._box_cameras < min(len(self.memory), FINAL):
            # Two or three cameras say little about where the scene is: look again when there are more.
            s = self.settings
            box = scene_box(self.views, s.centre_m, s.radius_m, s.near_m, s.contracted)
            if self.box is None or not _alike(box, self.box):
                self.box, new_box = box, True
            self._box_cameras = len(self.memory)
            self.behind, self.plain = _behind(views)
        look = look or (fresh and any(m.moved is not None for m in self.memory.values()))
        data = pack_views(views, self.box, self.memory, weights(views, self.memory, self.settings))
        self._packed = (tuple(views), data)
        return Intake(data, new_box, look or new_box, fresh)

    def _unknown(self, view: View) -> bool:
        known = self.memory.get(view.camera)
        return known is None or (
            known.view.shows_ns != view.shows_ns or not np.array_equal(known.view.image, view.image)
        )

    def trusted(self, views: Sequence[View], intake: Intake, step: int, field: PixelRenderer) -> Views:
        """The data without the views that contradict ``field``, which has learnt for ``step`` steps. Pictures
        that were known already are not judged again: nothing new contradicts."""

        def pixels(views: Sequence[View], points: Sequence[NDArray[np.float64]]) -> list[NDArray[np.float32]]:
            return [
                field.render_pixels(view.camera_to_world, view.intrinsics, where)[0]
                for view, where in zip(views, points)
            ]

        if intake.fresh:
            flags = self.refused(views, step, pixels)
            given = {view.camera for view in views}
            refused = {view.camera for view, flag in zip(views, flags) if flag}
            self.left_out = (self.left_out - given) | refused
        return leave_out(intake.data, np.array([view.camera in self.left_out for view in views]))

    def left_out_of(self, views: Sequence[View]) -> tuple[str, ...]:
        """The cameras of ``views`` that are refused."""
        return tuple(view.camera for view in views if view.camera in self.left_out)

    def refused(self, views: Sequence[View], step: int, pixels: Pixels) -> NDArray[np.bool_]:
        """Which of the views (V,) contradict a field that has learnt for ``step`` steps. pixels: what it
        shows."""
        beyond, settled = self.settings.refuse_beyond, step >= SETTLED
        return refused(views, self.memory, beyond, settled, pixels)

    def background(self) -> NDArray[np.float32]:
        """The colour (3,) behind everything that is rendered."""
        name = self.settings.background
        if name.startswith("#"):
            return np.array([int(name[k : k + 2], 16) / 255 for k in (1, 3, 5)], np.float32)
        if name in ("white", "black"):
            return np.full(3, 1.0 if name == "white" else 0.0, np.float32)
        return self.behind.copy()

    def meta(self) -> dict[str, Any]:
        """The part of the state that is not arrays, ready for JSON."""
        return {
            "box": asdict(self.box) if self.box else None,
            "box_cameras": self._box_cameras,
            "plain": self.plain,
            "left_out": sorted(self.left_out),
            "cameras": [
                {
                    "camera": m.view.camera,
                    "generated_ns": m.view.generated_ns,
                    "carried_to_ns": m.view.carried_to_ns,
                    "credit": m.credit,
                    **asdict(m.view.intrinsics),
                }
                for m in self.memory.values()
            ],
        }

    def arrays(self) -> Arrays:
        """The arrays of the state."""
        arrays: Arrays = {"behind": self.behind}
        for k, m in enumerate(self.memory.values()):
            arrays[f"image_{k}"], arrays[f"pose_{k}"] = m.view.image, np.asarray(m.view.camera_to_world)
            if m.moved is not None:
                arrays[f"moved_{k}"] = m.moved
        return arrays

    def load(self, meta: dict[str, Any], arrays: Arrays) -> None:
        """Undo ``meta`` and ``arrays``, for a rig that has seen nothing. ValueError, KeyError or TypeError
        where they are not what those made; the rig is then of no use."""
        self._packed, self.memory = None, {}
        self._box_cameras = int(meta["box_cameras"])
        self.plain = bool(meta.get("plain", False))
        self.left_out = set(meta.get("left_out", ()))
        box = meta["box"]
        self.box = SceneBox(**{**box, "centre_m": tuple(box["centre_m"])}) if box else None
        if self.box is not None:
            _check_box(self.box)
        self.behind = np.array(arrays["behind"], dtype=np.float32)
        if self.behind.shape != (3,) or not np.isfinite(self.behind).all():
            raise ValueError(f"the state's background must be a colour, not {self.behind.tolist()}")
        for k, entry in enumerate(meta["cameras"]):
            known = dict(entry)
            camera, generated_ns = known.pop("camera"), known.pop("generated_ns")
            credit = int(known.pop("credit", 0))
            carried_to_ns = known.pop("carried_to_ns", None)
            known["distortion"] = tuple(known["distortion"])
            view = View(
                camera, arrays[f"image_{k}"], arrays[f"pose_{k}"], Pinhole(**known), generated_ns,
                carried_to_ns=carried_to_ns,
            )  # fmt: skip
            check_view(view)
            moved = arrays.get(f"moved_{k}")
            if moved is not None and (moved.dtype != np.bool_ or moved.shape != view.image.shape[:2]):
                raise ValueError(f"camera {camera}: the pixels that moved are not those of its image")
            self.memory[camera] = CameraMemory(view, moved, credit)


def same_views(a: Sequence[View], b: Sequence[View]) -> bool:
    """Whether they are the very same objects."""
    return len(a) == len(b) and all(x is y for x, y in zip(a, b))


def _behind(views: Sequence[View]) -> tuple[NDArray[np.float32], bool]:
    """What is taken to be behind everything: white for cut-out pictures, else the plain colour along the
    pictures' edges, else the mean colour, which is the smallest mistake where rays find nothing. Also returns
    whether it is such a plain colour."""
    if any(v.image.shape[2] == 4 for v in views):
        return np.ones(3, np.float32), False
    plain = plain_background(views)
    if plain is not None:
        return plain, True
    return np.mean([v.image.mean(axis=(0, 1)) / 255.0 for v in views], axis=0).astype(np.float32), False


def _check_box(box: SceneBox) -> None:
    """ValueError for one that no rig has."""
    lengths = (box.radius_m, box.distance_m, box.pixel_m)
    if not np.isfinite([*box.centre_m, *lengths, box.near_m]).all() or min(lengths) <= 0 or box.near_m < 0:
        raise ValueError(f"the state's scene box is none: {box}")


def _alike(a: SceneBox, b: SceneBox) -> bool:
    apart = float(np.linalg.norm(np.subtract(a.centre_m, b.centre_m)))
    return apart < 0.1 * b.radius_m and abs(a.radius_m - b.radius_m) < 0.1 * b.radius_m
