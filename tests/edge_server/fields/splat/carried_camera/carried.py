"""A camera walks around a small scene, with depth and errors that vary slowly, and is given to a field as live."""

from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_server.experiments.scenes.multiview_still import score_views
from edge_server.fidelity.scorer import Scorer
from edge_server.fields import Budget, View
from edge_server.fields.splat.carried_camera import carried_camera_constants as tuned
from edge_server.fields.splat.carried_camera.carried_field import CarriedField
from edge_server.fields.splat.settings import SplatSettings
from freshfield.geometry import Pinhole, look_at, so3_exp, world_rays
from tests.edge_server.fields.scenes import seen

LENS = Pinhole.from_fov(48, 40, 55.0)


@cache
def walk(count: int = 80, depth: bool = True) -> list[View]:
    """Frames of an arc around the scene, 10 a second."""
    views, blank = [], np.zeros((LENS.height, LENS.width), np.float32)
    for k in range(count):
        angle = 1.8 * np.pi * k / count
        pose = look_at(2.2 * np.array([np.cos(angle), np.sin(angle), 0.5]), (0.0, 0.0, 0.3))
        image = np.zeros((LENS.height, LENS.width, 3), np.uint8)
        view = View(f"{k:03d}", image, pose, LENS, k * 100_000_000, depth=blank if depth else None)
        views.append(at(pose, view))
    return views


def at(pose: NDArray[np.float64], view: View) -> View:
    """The view from ``pose`` instead, with depth if it has some."""
    image, away_m = seen(LENS, pose)
    measured = np.where(np.isfinite(away_m), away_m * world_rays(LENS, np.eye(4))[1][..., 2], 0.0)
    depth = None if view.depth is None else measured.astype(np.float32)
    return replace(view, image=image, camera_to_world=pose, depth=depth)


def spoiled(views: list[View], deg: float = 1.0, shift_m: float = 0.02, gain: float = 0.25) -> list[View]:
    """With errors of poses and exposures that vary slowly along the way."""
    out = []
    for k, view in enumerate(views):
        phase, pose = 0.25 * k, view.camera_to_world.copy()
        pose[:3, :3] = pose[:3, :3] @ so3_exp(np.deg2rad(deg) * np.array([np.sin(phase), np.cos(phase), 0.3]))
        pose[:3, 3] += shift_m * np.array([np.cos(phase), 0.2, np.sin(phase)])
        image = np.clip(view.image * (1.0 + gain * np.sin(0.4 * k)), 0, 255).astype(np.uint8)
        out.append(replace(view, camera_to_world=pose, image=image))
    return out


WALK = walk()


HELD = 8  # one in so many frames is held out
BAD_FROM = 40  # frame of a walk, four seconds after its begin
# Training amplifies rounding, and processors round differently: a single training says little where much is lost.
SEEDS = (0, 1, 2)


def slow(*case: Any) -> Any:
    """A case that differs from a quick one in length, or in what it is combined with."""
    return pytest.param(*case, marks=pytest.mark.slow)


def carried_field(threads: int = 2, seed: int = 0) -> CarriedField:
    options = {"gaussians": 3000, "start": 500, "seed_cells": 32, "contracted": False, "seed": seed}
    return CarriedField(SplatSettings(scan=True, refine=True, carried=True, threads=threads, **options))


def given(field: CarriedField, views: Iterable[View]) -> CarriedField:
    """The field after an update with each of the frames, all of one camera."""
    for view in views:
        field.fit([replace(view, camera="hand")], Budget(steps=tuned.STEPS_A_KEYFRAME))
    return field


def played(views: list[View], field: CarriedField | None = None) -> CarriedField:
    """The field after the frames that are not held out."""
    return given(field or carried_field(), (view for k, view in enumerate(views) if k % HELD))


def resumed_from(state: dict[str, np.ndarray], seed: int = 0) -> CarriedField:
    field = carried_field(seed=seed)
    field.load_state(state)
    return field


def scored_db(field: CarriedField, views: list[View]) -> tuple[float, float]:
    """PSNR of held-out frames, as given and refined."""
    score, _ = score_views(field, [replace(view, camera="kept") for view in views[::HELD]], Scorer())
    assert score.psnr_refined_db is not None and np.isfinite(field.cloud.params).all()
    return score.psnr_db, score.psnr_refined_db


def by_seconds(views: list[View], scored: list[View], field: CarriedField, begin: int = 0) -> list[float]:
    """Plays the frames from ``begin`` on; after each second from the second on the mean PSNR of the held-out frames so
    far of ``scored``."""
    found = []
    for end in range(begin + 10, len(views) + 1, 10):
        given(field, (views[k] for k in range(end - 10, end) if k % HELD))
        if end >= 20:
            found.append(scored_db(field, scored[:end])[1])
    return found


@cache
def begun(depth: bool, seed: int = 0) -> tuple[dict[str, np.ndarray], tuple[float, ...]]:
    """State and scores of the four seconds with which all walks begin that become bad later."""
    views, field = walk(depth=depth)[:BAD_FROM], carried_field(seed=seed)
    found_db = by_seconds(views, views, field)
    return field.state(), tuple(found_db)


def gone_on(views: list[View], scored: list[View], seed: int = 0) -> tuple[CarriedField, list[float]]:
    """The field after frames of which the first four seconds are those of ``walk``, and its scores."""
    state, begun_db = begun(views[0].depth is not None, seed)
    field = resumed_from(state, seed)
    return field, [*begun_db, *by_seconds(views, scored, field, BAD_FROM)]


@cache
def undisturbed(depth: bool, seed: int = 0) -> tuple[float, ...]:
    return tuple(gone_on(walk(depth=depth), walk(depth=depth), seed)[1])
