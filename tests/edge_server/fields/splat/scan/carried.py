"""A walk with a carried camera, as a live edge gives its frames, and what is shown of it."""

from __future__ import annotations

from collections.abc import Iterable
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
