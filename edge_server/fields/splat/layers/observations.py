"""The layers' records of cameras and of the frames of the last second."""

from __future__ import annotations

from bisect import insort
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Rendering, View
from edge_server.fields.field_constants import SAME_POSE
from edge_server.fields.splat.layers import layer_constants as tuned
from edge_server.fields.splat.layers.bump import degrees_of, find_turn
from edge_server.fields.splat.layers.motion import ViewRow
from edge_server.fields.splat.layers.plates import FinePlate, Plate
from edge_server.fields.splat.layers.static_layer import PlateImage

if TYPE_CHECKING:
    from edge_server.fields.splat.layers.depth.depth_plate import DepthPlate


@dataclass
class FixedCamera:
    """A fixed camera.

    view: its first frame. row: float32 (1, CAMERA), see ``camera_rows``; None before there is a scene box.
    depth_m: float32 (H, W), of the static field; None before it was rendered.
    rendered_step: step of the static field at which it was rendered.
    newest_s: instant of the newest frame that was aligned.
    taken: ``generated_ns`` of the latest frames taken in.
    fine: the plate at full resolution; None if frames are taken in at full resolution.
    depth: the plate's depth; None if the camera has measured none.
    reported: float64 (4, 4), the pose in its frames, if that of ``view`` was corrected.
    depth_scale: factor on the depth in its frames.
    away: float64 (4, 4), pose of the newest frame, if that was taken elsewhere.
    moves: number of other places from which frames came, since it last stood still.
    anew: whether it restarted at its current place, and its plate is still incomplete.
    bumped: float64 (4, 4), its pose according to its images since it was bumped; None: the pose in its frames holds.
    turns: ``bump.find_turn`` of the latest consecutive frames that match its plate rotated, oldest first.
    looked_ns: ``generated_ns`` of the frame in which a turn was last searched for.
    began_ns: that of the first frame since it was knocked or bumped; 0 if it never was.
    """

    view: View
    plate: Plate
    row: NDArray[np.float32] | None = None
    depth_m: NDArray[np.float32] | None = None
    rendered_step: int = -1
    newest_s: float = -np.inf
    taken: deque[int] = field(default_factory=lambda: deque(maxlen=tuned.FRAMES_KNOWN))
    fine: FinePlate | None = None
    depth: DepthPlate | None = None
    reported: NDArray[np.float64] | None = None
    depth_scale: float = 1.0
    away: NDArray[np.float64] | None = None
    moves: int = 0
    anew: bool = False
    bumped: NDArray[np.float64] | None = None
    turns: list[NDArray[np.float64]] = field(default_factory=list)
    looked_ns: int = 0
    began_ns: int = 0

    @classmethod
    def begin(cls, view: View) -> FixedCamera:
        """A camera that has shown nothing yet. view: its first frame."""
        whole = None if view.whole is None else view.whole()
        plate = Plate(view.image.shape[0], view.image.shape[1])
        return cls(replace(view, whole=None, depth=None), plate, fine=None if whole is None else FinePlate(whole))

    def is_late(self, view: View) -> bool:
        """Whether a frame arrived late or out of order and may show the camera's place before it was knocked or bumped:
        it is from before that, or newer frames indicate it."""
        tells = self.away is not None or bool(self.turns)
        overtaken = tells and any(known_ns > view.generated_ns for known_ns in self.taken)
        return overtaken or view.generated_ns < self.began_ns

    def stands_at(self, view: View) -> bool:
        """Whether a frame was taken from the camera's place."""
        if not _same_pose(self.reported_pose, view.camera_to_world):
            return False
        self.away = None
        if self.plate.count > tuned.STANDS_FRAMES:
            self.moves, self.anew = 0, False
        return True

    def leaves_for(self, view: View) -> bool:
        """Whether the camera stands elsewhere now: the second frame in a row from the same other place. The first may
        have a wrong pose, and a moving camera has a new place each time."""
        stands = self.away is not None and _same_pose(self.away, view.camera_to_world)
        self.moves += not stands
        self.away = view.camera_to_world
        return stands

    @property
    def reported_pose(self) -> NDArray[np.float64]:
        """The pose in its frames."""
        return self.view.camera_to_world if self.reported is None else self.reported

    @property
    def assumed_pose(self) -> NDArray[np.float64]:
        """Its assumed pose, before correction by registration."""
        return self.reported_pose if self.bumped is None else self.bumped

    def shows_turned(self, view: View, foreground: NDArray[np.bool_] | None, usual: Callable[[str], float]) -> bool:
        """Whether a frame (foreground None: a refused one) matches the plate seen by a rotated camera; if so, adds to
        ``turns``. usual: see ``Observations.usual_share``."""
        share = 1.0 if foreground is None else float(foreground.mean())
        unusual = share > tuned.BUMP_SHARE and share > tuned.BUMP_UNUSUAL * usual(self.view.camera)
        waits = not self.turns and 0 <= view.generated_ns - self.looked_ns < 1e9 * tuned.BUMP_EVERY_S
        if self.anew or not unusual or waits:
            return False
        self.looked_ns = view.generated_ns
        turn = find_turn(self.plate.picture, self.plate.known, view.image, view.intrinsics)
        if self.turns and turn is not None and degrees_of(self.turns[-1].T @ turn) > tuned.BUMP_AGREE_DEG:
            self.turns = []  # it still swings
        self.turns = [] if turn is None else [*self.turns, turn]
        return turn is not None

    @property
    def was_turned(self) -> bool:
        """Whether enough consecutive frames show the camera rotated."""
        return len(self.turns) >= tuned.BUMP_FRAMES

    def correct(self, pose: NDArray[np.float64], depth_scale: float) -> None:
        """Use a pose (4, 4) and a factor on depth instead of those in its frames."""
        self.reported = self.reported_pose
        self.view, self.row, self.depth_scale = replace(self.view, camera_to_world=pose), None, depth_scale
        if self.fine is not None:
            self.fine.view = replace(self.fine.view, camera_to_world=pose)

    @property
    def fine_count(self) -> int:
        """Number of frames in the fine plate."""
        return 0 if self.fine is None else self.fine.count

    def plate_image(self, fine: bool) -> PlateImage:
        """A copy of the current plate. fine: at full resolution, if there is such a plate."""
        if fine and self.fine is not None:
            return PlateImage(self.fine.view, self.fine.color.copy(), self.fine.known)
        return PlateImage(self.view, self.plate.at_common_exposure(), self.plate.known.copy())

    def take_rendering(self, step: int, rendering: Rendering) -> None:
        """Store the static field's rendering from this camera, and its step."""
        self.depth_m, self.rendered_step, self.anew = rendering.depth, step, False
        self.plate.fill_unknown(rendering.color)

    def correct_exposure(self, ratio: NDArray[np.float32]) -> None:
        """Multiply the assumed exposure by ``ratio``, float32 (3,), one factor a channel."""
        self.plate.correct_exposure(ratio)
        if self.fine is not None:
            self.fine.color /= ratio


@dataclass(order=True)
class Observation:
    """A frame, and its linearization in the anchors' displacements.

    instant_s: capture time, seconds from the field's origin.
    foreground: bool (H, W). share: the foreground's share of the pixels.
    weight: float32 (H, W), how much each pixel counts.
    row: see ``motion.ViewRow``; None: to be aligned. fresh: not aligned since its arrival.
    shown: float32 (H, W, 3) in [0, 1], the moving set over the plate when it was aligned.
    body_m: float32 (H, W), depth of moving objects from ``view.depth``, 0 elsewhere; None: not computed yet.
    """

    instant_s: float
    camera: str
    view: View = field(compare=False)
    foreground: NDArray[np.bool_] = field(compare=False)
    weight: NDArray[np.float32] | None = field(default=None, compare=False)
    row: ViewRow | None = field(default=None, compare=False)
    shown: NDArray[np.float32] | None = field(default=None, compare=False)
    body_m: NDArray[np.float32] | None = field(default=None, compare=False)
    fresh: bool = field(default=True, compare=False)
    share: float = field(init=False, compare=False)

    def __post_init__(self) -> None:
        self.share = float(self.foreground.mean())

    @property
    def knot(self) -> int:
        """The knot at or before the instant."""
        return knot_of(self.instant_s)

    def shown_wrongly(self, most: float) -> NDArray[np.bool_]:
        """The pixels that the moving set misses or shows with an error above ``most`` in a channel, bool (H, W)."""
        if self.shown is None:
            return np.ones(self.foreground.shape, bool)
        error = np.abs(self.shown - self.view.image[..., :3] * np.float32(1.0 / 255.0))
        return np.asarray(error.max(axis=2) > most)


def knot_of(instant_s: float) -> int:
    """The number of the knot at or before an instant. A frame taken at a knot counts there, however its
    nanoseconds are rounded."""
    return int(np.floor(instant_s * tuned.KNOTS_PER_S + 1e-3))


class Observations:
    """The frames of the last second, by instant and camera."""

    def __init__(self) -> None:
        self._sorted: list[Observation] = []

    def __iter__(self) -> Iterator[Observation]:
        return iter(self._sorted)

    def __len__(self) -> int:
        return len(self._sorted)

    @property
    def newest_s(self) -> float:
        """The instant of the newest frame."""
        return self._sorted[-1].instant_s

    @property
    def newest_knot(self) -> int:
        """The knot at or before ``newest_s``."""
        return self._sorted[-1].knot

    def add(self, observation: Observation) -> None:
        insort(self._sorted, observation)

    def forget_before(self, instant_s: float) -> None:
        """Drop the frames before ``instant_s``."""
        self._sorted = [o for o in self._sorted if o.instant_s >= instant_s]

    def forget_camera(self, camera: str) -> None:
        """Drop the frames of a camera."""
        self._sorted = [o for o in self._sorted if o.camera != camera]

    def usual_share(self, camera: str) -> float:
        """Median share of the foreground in a camera's frames; 1 where there is none."""
        shares = [o.share for o in self._sorted if o.camera == camera]
        return float(np.median(shares)) if shares else 1.0

    def of_knots(self, first: int, last: int) -> list[Observation]:
        """The frames from knot ``first`` to knot ``last``, both included."""
        return [o for o in self._sorted if first <= o.knot <= last]


def bumped_by(camera: FixedCamera) -> str:
    """A description of how a camera was bumped."""
    assert camera.bumped is not None
    turn = camera.reported_pose[:3, :3].T @ camera.bumped[:3, :3]
    return (
        f"was bumped: all of its picture is turned by {degrees_of(turn):.1f} degrees from where its frames say that it "
        "stands; this is corrected, but a new calibration is better"
    )


def _same_pose(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    return bool((np.abs(a - b) <= SAME_POSE).all())


def pixel_weights(
    foreground: NDArray[np.bool_], depth_m: NDArray[np.float32] | None, distance_m: float, given: NDArray | None
) -> NDArray[np.float32]:
    """Weight of each pixel: full near the foreground, less elsewhere, none where the static field occludes the moving
    set.

    foreground: bool (H, W). depth_m: float32 (H, W), depth of the static field; None: unknown.
    distance_m: distance of the moving set. given: float32 (H, W), ``View.weight``, or None.
    """
    square = np.ones((tuned.NEAR_FOREGROUND_PX, tuned.NEAR_FOREGROUND_PX), np.uint8)
    near = cv2.dilate(foreground.astype(np.uint8), square)
    weight = np.where(near > 0, np.float32(1.0), np.float32(tuned.BACKGROUND_WEIGHT))
    if depth_m is not None:
        weight[~foreground & (depth_m > 0.0) & (depth_m < distance_m - tuned.OCCLUDED_M)] = 0.0
    return weight if given is None else weight * given


def cameras_of(views: Sequence[View]) -> list[str]:
    """The cameras of ``views``, in the order of their first appearance."""
    return list(dict.fromkeys(view.camera for view in views))


def newest_of_each(views: Sequence[View]) -> list[View]:
    """The newest view of each camera, in the order of the cameras' first appearance."""
    newest: dict[str, View] = {}
    for view in views:
        if view.camera not in newest or view.generated_ns > newest[view.camera].generated_ns:
            newest[view.camera] = view
    return list(newest.values())
