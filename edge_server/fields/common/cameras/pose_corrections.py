"""Small corrections of camera poses, found by how pictures differ from what a field renders."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.cameras import camera_refinement_constants as tuned
from edge_server.fields.common.field_state import from_json, to_json
from edge_server.fields.field_constants import SAME_POSE
from freshfield.geometry import se3, se3_inverse, so3_exp, so3_log

Array = NDArray[np.float64]


class PoseCorrection(msgspec.Struct, array_like=True):
    """given: (4, 4), the pose it belongs to: a camera with another pose starts anew.
    rotation, shift_m: (3,), a rotation vector in radians and meters, world axes.
    at_ns: when the view was taken. steps: how many ``descend`` has made for it. track: see ``PoseCorrections``.
    reported: (4, 4), the pose that the camera reported, where its picture was found elsewhere: at ``given``.
    scale: factor on reported shifts that makes them lead here from the view before; 0: none does."""

    given: Array
    rotation: Array = msgspec.field(default_factory=lambda: np.zeros(3))
    shift_m: Array = msgspec.field(default_factory=lambda: np.zeros(3))
    at_ns: int = 0
    steps: int = 0
    track: str = ""
    reported: Array | None = None
    scale: float = 0.0

    def moved(self, reported: Array, scale: float) -> Array:
        """The pose (4, 4) of a camera that reported ``reported``, if it moved from here as it reported. scale: as
        above."""
        move = se3_inverse(self.given if self.reported is None else self.reported) @ reported
        move[:3, 3] *= scale
        return self.pose @ move

    @property
    def pose(self) -> Array:
        """The corrected pose (4, 4)."""
        return _corrected(self.given, self.rotation, self.shift_m)


class Leap(NamedTuple):
    """From one view on all poses that a camera reports are off by the same motion: its tracker has found itself anew.

    before_ns, from_ns: when the last view before it and the first one after it were taken. back: (4, 4), leads a pose
    reported since to where it would have been reported. shift_m: by how much it shifted that first view.
    """

    before_ns: int
    from_ns: int
    back: Array
    shift_m: float

    @property
    def words(self) -> str:
        turned_deg = np.rad2deg(np.linalg.norm(so3_log(self.back[:3, :3])))
        return f"{self.shift_m:.1f} m and {turned_deg:.0f} degrees"


class PoseCorrections:
    """Bounded corrections of camera poses.

    A correction rotates a camera about its own center by exp(rotation) and shifts it. ``correct`` finds it with any
    representation that renders pixels, ``descend`` from a gradient.

    A track is one camera that moves: its views, whose corrections vary slowly in time. Views that nobody assigned to
    one are of the track "".

    most_m, most_deg: largest shift in meters and largest rotation in degrees.
    full_steps: steps of a view in ``descend`` after which they get shorter, as 1 / steps (Robbins and Monro 1951).
    """

    def __init__(self, most_m: float, most_deg: float, full_steps: float = np.inf) -> None:
        self.most_m, self.most_rad, self.full_steps = most_m, np.deg2rad(most_deg), full_steps
        self.known: dict[str, PoseCorrection] = {}
        self.leaps: dict[str, tuple[Leap, ...]] = {}  # of each track, in the order of time
        self._sorted: dict[str, list[str]] = {}  # names by track, in the order of time; empty: not known
        self._ranks: dict[str, int] = {}

    def copied(self) -> PoseCorrections:
        """A copy that later steps do not change."""
        other = PoseCorrections(self.most_m, 0.0)
        other.most_rad, other.known = self.most_rad, {name: copy(c) for name, c in self.known.items()}
        other.leaps = dict(self.leaps)
        return other

    def taken_back(self, view: View, track: str) -> View:
        """A view at the pose that its camera would have reported without leaps. One taken between the views by which a
        leap was found may be from before or after it: it lies where it is nearer to its neighbors in time."""
        leaps = self.leaps.get(track, ())
        if not leaps or view.generated_ns <= leaps[0].before_ns:
            return view
        backs, before = [np.eye(4), *(leap.back for leap in leaps)], 0
        while before < len(leaps) and leaps[before].from_ns <= view.generated_ns:
            before += 1
        poses = [backs[before] @ view.camera_to_world]
        if before < len(leaps) and leaps[before].before_ns < view.generated_ns:
            poses.append(backs[before + 1] @ view.camera_to_world)
        near = [self.known[name].given for name in self.neighbors_in_time(view, track)]
        apart = [sum(np.abs(pose - each).sum() for each in near) for pose in poses]
        return replace(view, camera_to_world=poses[int(np.argmin(apart))])

    def begin(self, view: View, track: str) -> None:
        """Assign a view to a track, with the correction of the one before it there, if any."""
        near = self.neighbors_in_time(view, track)
        near = {name: share for name, share in near.items() if self.known[name].reported is None}
        pose = self.pose_between(view, {name: share / sum(near.values()) for name, share in near.items()})
        given = np.asarray(view.camera_to_world, dtype=np.float64)
        self.known[view.camera] = PoseCorrection(given, at_ns=view.generated_ns, track=track)
        self._sorted = {}
        self.set_pose(view, pose)

    def set_pose(self, view: View, pose: Array) -> None:
        """Correct a view to a pose (4, 4), as far as corrections may go."""
        known = self._of(view)
        known.rotation = _at_most(so3_log(pose[:3, :3] @ known.given[:3, :3].T), self.most_rad)
        known.shift_m = _at_most(pose[:3, 3] - known.given[:3, 3], self.most_m)

    def within(self, given: Array, pose: Array, share: float) -> bool:
        """Whether a correction from ``given`` to ``pose``, (4, 4), takes at most a share of what is allowed."""
        return self.apart(given, pose) <= share

    def apart(self, one: Array, other: Array) -> float:
        """How far apart two poses (4, 4) are, in largest corrections: of a shift and of a turn, the larger one."""
        turned = np.linalg.norm(so3_log(other[:3, :3] @ one[:3, :3].T))
        shifted = np.linalg.norm(other[:3, 3] - one[:3, 3])
        return float(max(turned / self.most_rad, shifted / self.most_m))

    def place(self, view: View, pose: Array, scale: float) -> View:
        """The view at another pose (4, 4) than the reported one. scale: see ``PoseCorrection``."""
        known = copy(self._of(view))
        pose = se3(so3_exp(so3_log(pose[:3, :3])), pose[:3, 3])  # else errors of rounding grow from view to view
        known.reported, known.given, known.scale = known.given, pose, scale
        known.rotation, known.shift_m = np.zeros(3), np.zeros(3)
        self.known[view.camera] = known
        return replace(view, camera_to_world=pose)

    def forget(self, camera: str) -> None:
        """Forget a view's correction."""
        del self.known[camera]
        self._ranks.pop(camera, None)
        self._sorted = {}

    def newest(self, track: str, count: int) -> list[PoseCorrection]:
        """The corrections of a track's newest views, at most ``count``, in the order of time."""
        return [self.known[name] for name in self._order(track)[-count:]]

    def tracks(self) -> list[str]:
        """The tracks that have views, in the order in which they came."""
        return list(dict.fromkeys(c.track for c in self.known.values()))

    def pose(self, view: View) -> Array:
        """The corrected camera_to_world (4, 4) of a view."""
        return self._of(view).pose

    def learned_pose(self, view: View) -> Array | None:
        """As ``pose``; None where nothing was learned of this view, and nothing changes."""
        known = self.known.get(view.camera)
        if known is None or not np.allclose(known.given, view.camera_to_world, atol=SAME_POSE):
            return None
        return known.pose

    def pose_between(self, view: View, neighbors: dict[str, float]) -> Array:
        """The pose (4, 4) of a view from which nothing is learned, by the corrections of others.

        neighbors: the others and their weights, see ``neighbors_in_time``; none: the pose as given.
        """
        given = np.asarray(view.camera_to_world, dtype=np.float64)
        near = [self.known[name] for name in neighbors]
        if any(each.reported is not None for each in near):
            as_reported = all(each.scale for each in near)
            poses = [each.moved(given, each.scale) if as_reported else each.pose for each in near]
            return _between(poses, list(neighbors.values()))
        rotation, shift_m = np.zeros(3), np.zeros(3)
        for name, share in neighbors.items():
            other = self.known[name]
            # In the camera's axes: what a wrong calibration adds turns with the camera.
            rotation += share * (given[:3, :3] @ (other.given[:3, :3].T @ other.rotation))
            shift_m += share * (given[:3, :3] @ (other.given[:3, :3].T @ other.shift_m))
        return _corrected(given, rotation, shift_m)

    def _of(self, view: View) -> PoseCorrection:
        given = np.asarray(view.camera_to_world, dtype=np.float64)
        known = self.known.get(view.camera)
        if known is None or not np.allclose(known.given, given, atol=SAME_POSE):
            known = self.known[view.camera] = PoseCorrection(given, at_ns=view.generated_ns)
            self._sorted = {}
        return known

    def correct(
        self,
        view: View,
        render: Callable[[Array, Array], NDArray[np.float32]],
        pixel_m: float,
        rng: np.random.Generator,
        background: NDArray[np.float32],
    ) -> None:
        """One Gauss-Newton step for one camera, with finite differences of the rendered colors by small motions of
        the camera. The mean correction of all cameras is kept at 0: the scene stays where it is.

        view: the camera's view. render: (pose (4, 4), image points (N, 2)) -> colors (N, 3).
        pixel_m: width of a pixel at the scene, the scale of all parameters.
        rng: chooses the pixels. background: float32 (3,), behind transparent pixels.
        """
        known, camera = self._of(view), view.intrinsics
        column = rng.integers(0, camera.width, tuned.PIXELS)
        row = rng.integers(0, camera.height, tuned.PIXELS)
        points = np.stack([column + 0.5, row + 0.5], axis=-1)
        seen = view.image[row, column] / 255.0
        if seen.shape[1] == 4:
            seen = seen[:, :3] * seen[:, 3:] + background * (1.0 - seen[:, 3:])
        scale = np.array([1.0 / camera.fx] * 3 + [pixel_m] * 3)
        base = self.pose(view)
        here = render(base, points).astype(np.float64)
        slopes = np.empty((6, *here.shape))
        for k in range(6):
            moved, by = base.copy(), 0.5 * scale[k]
            axis = np.eye(3)[k % 3] * by
            if k < 3:
                moved[:3, :3] = so3_exp(axis) @ base[:3, :3]
            else:
                moved[:3, 3] += axis
            slopes[k] = (render(moved, points) - here) / 0.5  # per pixel's worth of motion
        error = here - seen
        robust = 1.0 / (1.0 + (np.square(error).sum(axis=1, keepdims=True) / tuned.OUTLIER**2))
        if view.weight is not None:
            robust *= view.weight[row, column, None]
        # Sums by einsum without BLAS: its order of summation depends on the number of threads.
        total = np.concatenate([known.rotation, known.shift_m]) / scale
        hessian = np.einsum("inc,jnc,nk->ij", slopes, slopes, robust, optimize=False) / tuned.PIXELS
        gradient = np.einsum("inc,nc,nk->i", slopes, error, robust, optimize=False) / tuned.PIXELS
        # The prior follows the bounds: without it, rotations and shifts, which look alike from afar, would be
        # confused.
        bounds = np.array([self.most_rad] * 3 + [self.most_m] * 3) / scale
        prior = tuned.PRIOR / np.square(np.maximum(bounds, 1e-3))
        step = -tuned.STEP_SHARE * np.linalg.solve(hessian + np.diag(prior), gradient + prior * total)
        if not np.isfinite(step).all():
            return
        step = np.clip(step, -tuned.LONGEST, tuned.LONGEST) * scale
        known.rotation, known.shift_m = known.rotation + step[:3], known.shift_m + step[3:]
        everyone = list(self.known.values())
        mean_rotation = np.mean([c.rotation for c in everyone], axis=0)
        mean_shift = np.mean([c.shift_m for c in everyone], axis=0)
        for c in everyone:
            c.rotation = _at_most(c.rotation - mean_rotation, self.most_rad)
            c.shift_m = _at_most(c.shift_m - mean_shift, self.most_m)

    def descend(self, view: View, gradient: Array, normal: Array, pixel_m: float) -> None:
        """A Gauss-Newton step for one camera, with the slopes of its image in place of the rendering's (inverse
        compositional, Baker and Matthews 2004): they are known beforehand, and do not vanish while the rendering is
        blurred. Steps get short by themselves where poses are exact. Nothing changes where the gradient is not finite.

        gradient: (6,), of a sum of squared errors by the camera's shift per meter and its rotation per radian, world
            axes.
        normal: (6, 6), see ``normal_matrix``.
        pixel_m: shift that moves what the camera sees by a pixel.
        """
        if not np.isfinite(gradient).all():
            return
        known = self._of(view)
        axes = known.given[:3, :3]  # a correction is too small to matter here
        local = np.concatenate([axes.T @ gradient[:3], axes.T @ gradient[3:]])
        damped = normal + np.diag(tuned.DAMPING * view.image[..., :3].size / np.square(tuned.USUAL))
        farthest = tuned.FARTHEST * np.array([pixel_m] * 3 + [1.0 / view.intrinsics.fx] * 3)
        step = np.clip(-0.5 * np.linalg.solve(damped, local), -farthest, farthest)
        step /= max(known.steps / self.full_steps, 1.0)
        known.steps += 1
        for name, share in self._around(view.camera).items():
            other = self.known[name]
            axes = other.given[:3, :3]
            other.shift_m = _at_most(other.shift_m + share * (axes @ step[:3]), self.most_m)
            other.rotation = _at_most(other.rotation + share * (axes @ step[3:]), self.most_rad)

    def _around(self, camera: str) -> dict[str, float]:
        """A view, those taken shortly before and after, and how much of its step they make too: the less, the more
        steps they have made for themselves. Without times that tell views apart, the view alone."""
        track = self.known[camera].track
        ordered = self._order(track)
        if self.known[ordered[0]].at_ns == self.known[ordered[-1]].at_ns:
            return {camera: 1.0}
        rank = self._ranks[camera]
        near = range(max(rank - tuned.REACH, 0), min(rank + tuned.REACH + 1, len(ordered)))
        steps = {k: self.known[ordered[k]].steps for k in near}
        return {ordered[k]: tuned.SPREAD ** abs(k - rank) / (1 + steps[k]) if k != rank else 1.0 for k in near}

    def _order(self, track: str) -> list[str]:
        """The names of a track's views in the order of time."""
        if track not in self._sorted:
            names = [name for name, c in self.known.items() if c.track == track]
            self._sorted[track] = names = sorted(names, key=lambda name: (self.known[name].at_ns, name))
            self._ranks.update((name, k) for k, name in enumerate(names))
        return self._sorted[track]

    def take_back(self, share: float) -> None:
        """Take back a share of the cameras' mean shift: they and the scene may wander together."""
        mean = np.mean([c.shift_m for c in self.known.values()] or [np.zeros(3)], axis=0)
        for c in self.known.values():
            c.shift_m = c.shift_m - share * mean

    def meta(self) -> dict[str, Any]:
        """What a state keeps, ready for JSON."""
        known: dict[str, Any] = to_json(self.known)
        return known

    def load(self, meta: dict[str, Any]) -> None:
        """Restore what ``meta`` returned."""
        self.known, self._sorted = from_json(meta, dict[str, PoseCorrection]), {}

    def neighbors_in_time(self, view: View, track: str = "") -> dict[str, float]:
        """The views of a track taken last before and first after ``view``, and how much each counts, the nearer one
        more. Empty where times do not tell views apart, unless there is but one."""
        times = [(self.known[name].at_ns, name) for name in self._order(track) if name != view.camera]
        if not times or (len(times) > 1 and times[0][0] == times[-1][0]):
            return {}
        before = [each for each in times if each[0] <= view.generated_ns][-1:]
        after = [each for each in times if each[0] > view.generated_ns][:1]
        if not before or not after:
            return {(before or after)[0][1]: 1.0}
        (first_ns, first), (last_ns, last) = before[0], after[0]
        share = (view.generated_ns - first_ns) / (last_ns - first_ns)
        return {first: 1.0 - share, last: share}


def _corrected(given: Array, rotation: Array, shift_m: Array) -> Array:
    pose = given.copy()
    pose[:3, :3] = so3_exp(rotation) @ given[:3, :3]
    pose[:3, 3] += shift_m
    return pose


def _between(poses: Sequence[Array], shares: Sequence[float]) -> Array:
    """The pose (4, 4) between one or two, which count by their shares."""
    first, last, share = poses[0], poses[-1], shares[-1]
    turn = so3_exp(share * so3_log(first[:3, :3].T @ last[:3, :3]))
    return se3(first[:3, :3] @ turn, first[:3, 3] + share * (last[:3, 3] - first[:3, 3]))


def _at_most(vector: Array, most: float) -> Array:
    length = float(np.linalg.norm(vector))
    return vector if length <= most else vector * (most / length)


def normal_matrix(view: View, depth_m: NDArray[np.float32]) -> Array:
    """J^T J (6, 6), J the slopes of a view's image, all channels, by the camera's shift in meters and its rotation in
    radians, camera axes. Every fourth pixel in x and y stands for sixteen; the lens's distortion is left out.

    depth_m: of its pixels, (H, W), above 0, along the optical axis.
    """
    lens, image = view.intrinsics, view.image[..., :3].astype(np.float32) * np.float32(1.0 / 255.0)
    down, across = np.gradient(image, axis=(0, 1)) if min(image.shape[:2]) > 1 else (image * 0, image * 0)
    down, across = down[2::4, 2::4] * np.float32(lens.fy), across[2::4, 2::4] * np.float32(lens.fx)
    y, x = np.mgrid[2 : lens.height : 4, 2 : lens.width : 4].astype(np.float32)
    x, y = (x + np.float32(0.5 - lens.cx)) / np.float32(lens.fx), (y + np.float32(0.5 - lens.cy)) / np.float32(lens.fy)
    zero, near = np.zeros_like(x), 1.0 / depth_m[2::4, 2::4]
    flow_x = (-near, zero, x * near, x * y, -(1.0 + x * x), y)
    flow_y = (zero, -near, y * near, 1.0 + y * y, -x * y, -x)
    slopes = np.stack([(u[..., None] * across + v[..., None] * down).reshape(-1) for u, v in zip(flow_x, flow_y)])
    # Without BLAS: its order of summation depends on the number of threads.
    return 16.0 * np.einsum("in,jn->ij", slopes, slopes, optimize=False).astype(np.float64)
