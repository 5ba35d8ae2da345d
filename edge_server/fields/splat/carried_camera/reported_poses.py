"""Where a carried camera is when the poses that it reports do not fit its pictures: found from where it was."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.cameras.pose_corrections import Leap, PoseCorrection, PoseCorrections
from edge_server.fields.common.field_state import from_json, to_json
from edge_server.fields.splat.carried_camera import carried_camera_constants as tuned
from edge_server.fields.splat.carried_camera.pose_alignment import Gray, Rendered, align, align_from, gray
from freshfield.geometry import se3, se3_inverse, so3_exp, so3_log

Array = NDArray[np.float64]

UNITS = {"millimeters": 1000.0, "centimeters": 100.0, "inches": 39.37, "feet": 3.281, "kilometers": 0.001}


class Reports(msgspec.Struct, forbid_unknown_fields=True):
    """What is known of the poses that one camera reports.

    doubts: keyframes in a row that were not where reported motion led.
    fits: keyframes in a row, of a camera astray, that fit near where it reports them.
    missed: frames in a row, of a camera astray, that were not found.
    replaced: keyframes that were located by their pictures.
    unturned: see ``compare_turns``.
    at_m: position of the newest view, (3,).
    suggested: a leap that may be. tried: how many views fit to it.
    left_out: frames that show something else than is to be seen from there; left_out_in_a_row of the newest.
    """

    doubts: int = 0
    fits: int = 0
    missed: int = 0
    replaced: int = 0
    unturned: int = 0
    at_m: Array | None = None
    suggested: Leap | None = None
    tried: int = 0
    left_out: int = 0
    left_out_in_a_row: int = 0

    @property
    def astray(self) -> bool:
        """Whether they are not believed."""
        return self.doubts >= tuned.DOUBTS

    @property
    def have_no_rotation(self) -> bool:
        """Whether the camera turns while the rotation that it reports stays, as far as is known without depth."""
        return self.unturned >= tuned.UNTURNED

    @property
    def doubted(self) -> bool:
        """Whether the next view has to be looked for."""
        return self.astray or self.suggested is not None

    def trust(self) -> None:
        """Believe them."""
        self.doubts = self.fits = 0

    def fit_again(self, fits: bool) -> bool:
        """Note whether a view of a camera astray fits near where it is reported. Returns whether so many in a row did
        that reported poses are believed again."""
        self.fits = self.fits + 1 if fits else 0
        if self.fits < tuned.DOUBTS:
            return False
        self.trust()
        return True

    def begun_anew(self) -> Reports:
        """What is known of them in a field that begins anew: what its pictures showed by themselves."""
        return Reports(unturned=self.unturned, left_out=self.left_out, left_out_in_a_row=self.left_out_in_a_row)

    def compare_turns(self, contradicted: bool) -> None:
        """Note whether a picture contradicts that its camera has not turned."""
        self.unturned = min(max(self.unturned + (1 if contradicted else -1), 0), 2 * tuned.UNTURNED)


class OwnMotion:
    """Which cameras' reported poses do not fit their pictures, and where their views are taken to be instead.

    poses: of all keyframes, where located views are noted.
    """

    def __init__(self, poses: PoseCorrections) -> None:
        self._poses = poses
        self.cameras: dict[str, Reports] = {}

    def of(self, camera: str) -> Reports:
        """What is known of a camera's reports, to be changed."""
        return self.cameras.setdefault(camera, Reports())

    def before(self, view: View, camera: str) -> list[PoseCorrection]:
        """Corrections of the newest keyframes of a view's camera that were taken before it, in the order of time."""
        newest = self._poses.newest(camera, tuned.JUDGED)
        return [each for each in newest if each.at_ns < view.generated_ns]

    def leaps(self, view: View, camera: str) -> bool:
        """Whether a view is reported farther from the one before than a camera can have moved. A tracker that loses
        its place leaps once; in another unit each view leaps. A quick turn is none."""
        here, known = view.camera_to_world[:3, 3], self.of(camera)
        before, known.at_m = here if known.at_m is None else known.at_m, here
        return bool(np.linalg.norm(here - before) > tuned.FARTHEST * self._poses.most_m)

    def suggest_leap(self, view: View, camera: str, begun: Array, found: Array) -> bool:
        """Note that poses of a camera may have leapt before a view: it was found elsewhere, soon after the one before,
        and farther away than a correction goes. Returns whether so.

        Where pictures fit both here and there, a gap's own motion looks like a leap: ``begun`` is believed where it is
        nearer than ``found`` to where the last motion leads.

        begun: (4, 4), the view's pose with the correction of the one before it, which goes on. found: (4, 4), where its
        picture was taken.
        """
        before = self.before(view, camera)
        recent = before and view.generated_ns - before[-1].at_ns < 1e9 * tuned.LONGEST_LEAP_S
        if not recent or self._poses.within(begun, found, 1.0):
            return False
        led = moved_on(view, before)
        if led is not None and self._poses.apart(led, begun) < self._poses.apart(led, found):
            return False
        reported, back = self._as_reported(view, camera), found @ se3_inverse(begun) @ self._back(camera)
        back = se3(so3_exp(so3_log(back[:3, :3])), back[:3, 3])  # else errors of rounding grow from leap to leap
        if self._poses.within(reported, found, 1.0):
            back = np.eye(4)  # an earlier leap has ended
        shift_m = float(np.linalg.norm((back @ reported - reported)[:3, 3]))
        known = self.of(camera)
        known.suggested, known.tried = Leap(before[-1].at_ns, view.generated_ns, back, shift_m), 0
        return True

    def after_leap(self, view: View, camera: str) -> View | None:
        """A view where it is if poses of its camera have leapt as is suggested; None: nothing is."""
        leap = self.of(camera).suggested
        if leap is None:
            return None
        return replace(view, camera_to_world=leap.back @ self._as_reported(view, camera))

    def try_leap(self, camera: str, as_reported: bool, fits: bool) -> bool:
        """Note whether a view fits as reported, or to the leap that is suggested; one that fits neither says nothing of
        it. Returns whether so many fit to the leap that it is believed."""
        known = self.of(camera)
        leap = known.suggested
        if leap is None or not (as_reported or fits):
            return False
        known.tried += 1
        if fits and known.tried < tuned.LEAPT:
            return False
        known.suggested = None
        if fits:
            self._poses.leaps[camera] = (*self._poses.leaps.get(camera, ()), leap)[-tuned.KEPT_CORRECTIONS :]
            known.trust()
        return fits

    def _back(self, camera: str) -> Array:
        leaps = self._poses.leaps.get(camera)
        return leaps[-1].back if leaps else np.eye(4)

    def _as_reported(self, view: View, camera: str) -> Array:
        return se3_inverse(self._back(camera)) @ view.camera_to_world

    def located(self, view: View, camera: str, pose: Array, scale: float) -> View:
        """The view at a pose (4, 4) that its picture was found at, and no longer at the reported one."""
        known = self.of(camera)
        known.missed, known.replaced, known.doubts, known.suggested = 0, known.replaced + 1, tuned.DOUBTS, None
        before = self.before(view, camera)
        if len(before) == 1 and before[0].reported is None:
            before[0].reported, before[0].scale = before[0].given, scale  # for frames before the first keyframe
        return self._poses.place(view, pose, scale)

    def lost(self, view: View, camera: str, measured: bool) -> View | None:
        """A view that was not found: None where it is to be left out; at the second in a row the view where the one
        before was taken. Without depth nothing can be found: it has moved as reported.

        measured: whether a view not long before has depth.
        """
        before = self.before(view, camera)
        if before and not measured:
            scale = shift_scale(before)
            return self.located(view, camera, before[-1].moved(view.camera_to_world, scale), scale)
        known = self.of(camera)
        known.missed += 1
        return self.located(view, camera, before[-1].pose, 0.0) if known.missed > tuned.LOST and before else None

    def troubles(self) -> list[str]:
        """What is wrong with the cameras' reported poses, for people."""
        replaced = [
            f"{camera}: {known.replaced} reported poses do not fit its pictures and were replaced by what these show"
            + misfit(self._poses.newest(camera, tuned.JUDGED))
            for camera, known in self.cameras.items()
            if known.replaced
        ]
        leapt = [
            f"{camera}: its poses leapt by {leaps[-1].words}: they are taken back by as much"
            for camera, leaps in self._poses.leaps.items()
            if not np.array_equal(leaps[-1].back, np.eye(4))
        ]
        unturned = [
            f"{camera}: reported poses have no rotation, but its pictures turn: look at how they are exported and read"
            for camera, known in self.cameras.items()
            if known.have_no_rotation
        ]
        return [*replaced, *leapt, *unturned]

    def meta(self) -> dict[str, Any]:
        """What a state keeps, ready for JSON."""
        return {"cameras": to_json(self.cameras), "leaps": to_json(self._poses.leaps)}

    def load(self, meta: dict[str, Any]) -> None:
        """Restore what ``meta`` returned."""
        self.cameras = from_json(meta["cameras"], dict[str, Reports])
        self._poses.leaps = from_json(meta["leaps"], dict[str, tuple[Leap, ...]])


def search(
    view: View,
    kept: Rendered,
    before: Sequence[PoseCorrection],
    guesses: Sequence[Array],
    poses: PoseCorrections,
    rendered: Callable[[Array], Rendered],
    goes_on: float = 0.0,
) -> tuple[Array, float] | None:
    """Where a view was taken, (4, 4), by an earlier view and then the field, and ``followed_scale``; None: not found.

    kept: the earlier view, with its depth. before: see ``guessed_poses``. guesses: (4, 4) each, to begin with.
    poses: says how far apart poses may be. rendered: renders the field from a pose. goes_on: see ``align_from``.
    """
    frame = gray(view.image)
    if frame.std() < tuned.FLAT * kept.gray.std():
        return None  # an exposure could be found by which it agrees
    found = align_from(kept, frame, guesses, goes_on)
    least = tuned.LEAST_OVERLAP * float((kept.depth > 0).mean())
    if found.overlap < least or found.agreeing < tuned.LOCATED:
        return None
    if not poses.within(kept.pose, found.pose, tuned.FARTHEST):
        return None
    scale = followed_scale(kept, frame, view.camera_to_world, before, found.agreeing)
    refined = align(rendered(found.pose), frame, found.pose, prior=tuned.GUESSED_ERROR)
    return (refined.pose if refined.fits and poses.within(found.pose, refined.pose, 1.0) else found.pose), scale


def guessed_poses(view: View, before: Sequence[PoseCorrection]) -> list[Array]:
    """Poses (4, 4) where a view may have been taken: moved or turned as its reported pose says, as the one before it,
    moved on as before; this one comes last.

    before: corrections of earlier views of its camera, at least one, in the order of time.
    """
    last = before[-1]
    scales = (1.0, shift_scale(before), 0.0)
    poses = [*(last.moved(view.camera_to_world, scale) for scale in scales), last.pose]
    led = moved_on(view, before, tuned.FASTEST)
    return poses if led is None else [*poses, led]


def moved_on(view: View, before: Sequence[PoseCorrection], most: float = np.inf) -> Array | None:
    """Where a view was taken, (4, 4), if its camera moved on as before, at most so many times as far; None: its motion
    is not known. before: see ``guessed_poses``."""
    if len(before) < 2 or before[-1].at_ns <= before[-2].at_ns:
        return None
    last, one = before[-1], before[-2]
    share = min((view.generated_ns - last.at_ns) / (last.at_ns - one.at_ns), most)
    own = se3_inverse(one.pose) @ last.pose
    return last.pose @ se3(so3_exp(share * so3_log(own[:3, :3])), share * own[:3, 3])


def shift_scale(known: Sequence[PoseCorrection]) -> float:
    """The factor by which reported shifts from view to view become those of the pictures (median); 1 where there are
    too few. known: in the order of time."""
    reported, own = (
        np.linalg.norm(np.diff([pose[:3, 3] for pose in poses], axis=0).reshape(-1, 3), axis=1)
        for poses in ([_reported(each) for each in known], [each.pose for each in known])
    )
    told = reported > 0.0
    return float(np.median(own[told] / reported[told])) if told.sum() >= tuned.ASTRAY_FOR else 1.0


def followed_scale(
    kept: Rendered, frame: Gray, reported: Array, before: Sequence[PoseCorrection], best: float
) -> float:
    """The scale of reported shifts with which reported motion leads from the view before to where a frame fits it
    almost as well as anywhere: 1 if it does as it is, 0 if it does with none.

    kept: the view before. frame: (H, W) in [0, 1]. reported: the frame's pose, (4, 4). before: see ``guessed_poses``.
    best: the largest share of pixels that look as expected, see ``Alignment``.
    """
    for scale in (1.0, shift_scale(before)):
        pose = before[-1].moved(reported, scale)
        if align(kept, frame, pose, pose, ((1, 1),)).agreeing >= best - tuned.FOLLOWED:
            return scale
    return 0.0


def misfit(known: Sequence[PoseCorrection]) -> str:
    """What is wrong with the reported poses of a camera that is located by its pictures, in words; empty if not known.

    known: corrections of its newest views, in the order of time.
    """
    if sum(each.reported is not None for each in known) < tuned.ASTRAY_FOR:
        return ""
    turned, turns = (
        np.ptp([pose[:3, :3] for pose in poses], axis=0).max()
        for poses in ([_reported(each) for each in known], [each.pose for each in known])
    )
    if turned < tuned.SAME_TURN and turns > tuned.TURNED:
        return ": reported poses have no rotation"
    scale = 1.0 / max(shift_scale(known), 1e-12)
    if 1.0 / tuned.OTHER_UNIT < scale < tuned.OTHER_UNIT:
        return ""
    named = next((f", as in {name}" for name, size in UNITS.items() if abs(np.log(scale / size)) < tuned.UNIT_LOG), "")
    about = f"{float(f'{scale:.2g}'):g}"
    return f": reported positions are some {about} times as far apart as meters are{named}"


def _reported(known: PoseCorrection) -> Array:
    return known.given if known.reported is None else known.reported
