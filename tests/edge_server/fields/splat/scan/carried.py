"""A walk with a carried camera, as a live edge gives its frames, and what is shown of it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from edge_server.experiments.scenes.multiview_still import score_views
from edge_server.fidelity.scorer import Scorer
from edge_server.fields import Budget, View
from edge_server.fields.splat.scan import settings as tuned
from edge_server.fields.splat.scan.carried_field import CarriedField
from edge_server.fields.splat.settings import SplatSettings
from tests.edge_server.fields.splat.scan.walk import walk

HELD = 8  # one in so many frames is held out
BAD_FROM = 40  # frame of a walk, four seconds after its begin
# Training amplifies rounding, and processors round differently: a single training says little where much is lost.
SEEDS = (0, 1, 2)


def slow(*case: Any) -> Any:
    """A case that differs from a quick one in length, or in what it is combined with."""
    return pytest.param(*case, marks=pytest.mark.slow)


def carried_field(threads: int = 2, gaussians: int = 3000, seed: int = 0) -> CarriedField:
    options = {"gaussians": gaussians, "start": 500, "seed_cells": 32, "contracted": False, "seed": seed}
    return CarriedField(SplatSettings(scan=True, refine=True, carried=True, threads=threads, **options))


def played(views: list[View], field: CarriedField | None = None, steps: int = tuned.STEPS_A_KEYFRAME) -> CarriedField:
    """The field after an update with each frame that is not held out, all of one camera."""
    field = field or carried_field()
    for k, view in enumerate(views):
        if k % HELD:
            field.fit([replace(view, camera="hand")], Budget(steps=steps))
    return field


def held_out(views: list[View]) -> list[View]:
    return [replace(view, camera="kept") for view in views[::HELD]]


def scored_db(field: CarriedField, views: list[View]) -> tuple[float, float]:
    """PSNR of held-out frames, as given and refined."""
    score, _ = score_views(field, held_out(views), Scorer())
    assert score.psnr_refined_db is not None
    return score.psnr_db, score.psnr_refined_db


def leaping(view: View) -> View:
    pose = view.camera_to_world.copy()
    pose[:3, 3] += pose[:3, 0]
    return replace(view, camera_to_world=pose)


def covered_view(view: View) -> View:
    depth = None if view.depth is None else np.full_like(view.depth, 0.05)
    return replace(view, image=np.full_like(view.image, 40), depth=depth)


def by_seconds(views: list[View], scored: list[View], field: CarriedField, begin: int = 0) -> list[float]:
    """Plays the frames from ``begin`` on; after each second from the second on the mean PSNR of the held-out frames so
    far of ``scored``."""
    found = []
    for end in range(begin + 10, len(views) + 1, 10):
        for k in range(end - 10, end):
            if k % HELD:
                field.fit([replace(views[k], camera="hand")], Budget(steps=tuned.STEPS_A_KEYFRAME))
        if end >= 20:
            found.append(scored_db(field, scored[:end])[1])
    return found


@cache
def begun(depth: bool, seed: int) -> tuple[dict[str, np.ndarray], tuple[float, ...]]:
    """State and scores of the four seconds with which all walks begin that become bad later."""
    views, field = walk(depth=depth)[:BAD_FROM], carried_field(seed=seed)
    found_db = by_seconds(views, views, field)
    return field.state(), tuple(found_db)


def resumed_field(depth: bool, seed: int = 0) -> CarriedField:
    field = carried_field(seed=seed)
    field.load_state(begun(depth, seed)[0])
    return field


def gone_on(views: list[View], scored: list[View], seed: int = 0) -> tuple[CarriedField, list[float]]:
    """The field after frames of which the first four seconds are those of ``walk``, and its scores."""
    depth = views[0].depth is not None
    field = resumed_field(depth, seed)
    return field, [*begun(depth, seed)[1], *by_seconds(views, scored, field, BAD_FROM)]


@cache
def undisturbed(depth: bool, seed: int = 0) -> tuple[float, ...]:
    return tuple(gone_on(walk(depth=depth), walk(depth=depth), seed)[1])
