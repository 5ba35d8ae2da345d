"""Where a carried camera may be when the poses that it reports do not fit its pictures: guesses from where it was."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.cameras.pose_corrections import PoseCorrection, PoseCorrections
from edge_server.fields.splat.scan import settings as tuned
from edge_server.fields.splat.scan.tracking import Gray, Rendered, align, align_from, gray
from freshfield.geometry import se3, se3_inverse, so3_exp, so3_log

Array = NDArray[np.float64]

UNITS = {"millimeters": 1000.0, "centimeters": 100.0, "inches": 39.37, "feet": 3.281, "kilometers": 0.001}


def search(
    view: View,
    kept: Rendered,
    before: Sequence[PoseCorrection],
    poses: PoseCorrections,
    rendered: Callable[[Array], Rendered],
) -> tuple[Array, float] | None:
    """Where a view was taken, (4, 4), by an earlier view and then the field, and ``followed_scale``; None: not found.

    kept: the earlier view, with its depth. before: see ``guessed_poses``. poses: says how far apart poses may be.
    rendered: renders the field from a pose.
    """
    frame = gray(view.image)
    if frame.std() < tuned.FLAT * kept.gray.std():
        return None  # an exposure could be found by which it agrees
    found = align_from(kept, frame, guessed_poses(view, before))
    least = tuned.LEAST_OVERLAP * float((kept.depth > 0).mean())
    if found.overlap < least or found.agreeing < tuned.LOCATED:
        return None
    if not poses.within(kept.pose, found.pose, tuned.FARTHEST):
        return None
    scale = followed_scale(kept, frame, view.camera_to_world, before, found.agreeing)
    refined = align(rendered(found.pose), frame, found.pose, prior=tuned.GUESSED_ERROR)
    fits = refined.overlap >= tuned.LEAST_OVERLAP and refined.agreeing >= tuned.LOCATED
    return (refined.pose if fits and poses.within(found.pose, refined.pose, 1.0) else found.pose), scale


def guessed_poses(view: View, before: Sequence[PoseCorrection]) -> list[Array]:
    """Poses (4, 4) where a view may have been taken: as the one before it, moved on as before, moved or turned as its
    reported pose says.

    before: corrections of earlier views of its camera, at least one, in the order of time.
    """
    last = before[-1]
    scales = (1.0, shift_scale(before), 0.0)
    poses = [*(replace(last, scale=scale).moved(view.camera_to_world) for scale in scales), last.pose]
    if len(before) > 1 and last.at_ns > before[-2].at_ns:
        share = min((view.generated_ns - last.at_ns) / (last.at_ns - before[-2].at_ns), tuned.FASTEST)
        own = se3_inverse(before[-2].pose) @ last.pose
        poses.append(last.pose @ se3(so3_exp(share * so3_log(own[:3, :3])), share * own[:3, 3]))
    return poses


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
        pose = replace(before[-1], scale=scale).moved(reported)
        if align(kept, frame, pose, pose, ((1, 1),)).agreeing >= best - tuned.FOLLOWED:
            return scale
    return 0.0


def misfit(known: Sequence[PoseCorrection]) -> str:
    """What is wrong with the reported poses of a camera that is located by its pictures, in words; empty if not known.

    known: corrections of its newest views, in the order of time.
    """
    if sum(each.reported is not None for each in known) < tuned.ASTRAY_FOR:
        return ""
    reported = np.array([_reported(each) for each in known])
    if np.abs(reported[:, :3, :3] - reported[0, :3, :3]).max() < tuned.SAME_TURN:
        return ": reported poses have no rotation"
    scale = 1.0 / max(shift_scale(known), 1e-12)
    if 1.0 / tuned.OTHER_UNIT < scale < tuned.OTHER_UNIT:
        return ""
    named = next((name for name, size in UNITS.items() if abs(np.log(scale / size)) < tuned.UNIT_LOG), "another unit")
    return f": reported positions are some {scale:.3g} times as far apart, as in {named} instead of meters"


def _reported(known: PoseCorrection) -> Array:
    return known.given if known.reported is None else known.reported
