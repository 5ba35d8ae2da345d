"""Four cameras that measure depth, in hard cases: nothing diverges, and half a second after the first fresh views what
moves is shown as well as before."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_server.fields import Budget, View
from tests.edge_server.fields.scenes import seen
from tests.edge_server.fields.small import same_state
from tests.edge_server.fields.splat.layers.test_hard_cases import (
    AGAIN_S,
    AWAY,
    BACK_DB,
    BACK_S,
    FRAME_S,
    HELD,
    NETWORK_S,
    RADIUS_M,
    SCORED_S,
    STEPS,
    Case,
    Stage,
)

pytestmark = pytest.mark.stability


def _depth_of(view: View, balls: tuple[tuple[float, float, float], ...]) -> NDArray[np.float32]:
    """True depth along the optical axis, 0 for the sky."""
    lens, pose = view.intrinsics, view.camera_to_world
    away_m = np.min([seen(lens, pose, np.array(ball), RADIUS_M)[1] for ball in balls or (AWAY,)], axis=0)
    return np.where(np.isfinite(away_m), away_m * lens.rays()[..., 2], 0.0).astype(np.float32)


def _arrives(k: int, t: float) -> float | None:
    """Four of the six cameras."""
    return t + NETWORK_S if k < 4 else None


def _first_alone(k: int, t: float) -> float | None:
    return _arrives(k, t) if k == 0 or t >= 1.0 else None


@dataclass(frozen=True)
class DepthCase(Case):
    """measured: what a camera measures instead of a view's true depth, from the event on."""

    arrives: Callable[[int, float], float | None] = _arrives
    measured: Callable[[Case, View, float], NDArray[np.float32]] = lambda case, view, t: _depth_of(
        view, case.balls_at(t)
    )


class DepthStage(Stage):
    """A stage whose cameras measure depth."""

    def _capture(self, k: int, t: float) -> None:
        before, case = len(self.flying), self.case
        assert isinstance(case, DepthCase)
        super()._capture(k, t)
        if k >= 4:
            del self.flying[before:]
        for n in range(before, len(self.flying)):
            arrives_s, _, view = self.flying[n]
            if view.depth is None:
                depth = case.measured(case, view, t) if t >= 0.0 else _depth_of(view, case.balls_at(t))
                self.flying[n] = arrives_s, k, replace(view, depth=depth)


def _holes(case: Case, view: View, t: float) -> NDArray[np.float32]:
    """Nothing is measured of what moves."""
    depth = _depth_of(view, case.balls_at(t))
    return np.where(depth == _depth_of(view, ()), depth, 0.0).astype(np.float32)


def _lags(case: Case, view: View, t: float) -> NDArray[np.float32]:
    return _depth_of(view, case.balls_at(t - 0.1))


def _noise(case: Case, view: View, t: float) -> NDArray[np.float32]:
    """Depth of nothing that is there, and some that is none."""
    rng = np.random.default_rng(round(t * 1e6))
    values = np.array([np.nan, np.inf, -1.0, 0.0, 1e-30, 0.5, 2.0, 1e30], np.float32)
    return rng.choice(values, view.image.shape[:2])


def _behind_a_wall(k: int, view: View, t: float) -> View:
    """A wall before the first camera fills its image for a second."""
    if k > 0 or t >= 1.0:
        return view
    shape = view.image.shape
    return replace(view, image=np.full(shape, 90, np.uint8), depth=np.full(shape[:2], 0.4, np.float32))


CASES = {
    "holes on what moves": DepthCase(measured=_holes),
    "depth lags by 100 ms": DepthCase(measured=_lags),
    "depth is noise": DepthCase(measured=_noise),
    "a wall fills an image": DepthCase(sent=_behind_a_wall, fresh_s=AGAIN_S),
    "one camera alone": DepthCase(arrives=_first_alone, fresh_s=AGAIN_S),
}


@cache
def _begun() -> DepthStage:
    stage = DepthStage(DepthCase())
    stage.run(-SCORED_S, score=False)
    stage.run(0.0)
    return stage


# The same is held without depth.
LONG = ("a wall fills an image", "one camera alone")


@pytest.mark.parametrize("name", [pytest.param(c, marks=[pytest.mark.slow] * (c in LONG)) for c in CASES])
def test_what_moves_is_shown_as_well_as_before_half_a_second_after(name: str) -> None:
    case = CASES[name]
    stage = _begun().going_on_as(case)
    stage.run(case.fresh_s + BACK_S - FRAME_S, score=False)
    stage.run(case.fresh_s + BACK_S + SCORED_S)  # a whole round
    before_db, _ = stage.median_db(-SCORED_S, 0.0)
    after_db, empty_db = stage.median_db(case.fresh_s + BACK_S, case.fresh_s + BACK_S + SCORED_S)
    assert after_db > empty_db + 3.0
    assert after_db > before_db - BACK_DB


def test_a_state_goes_on_bit_for_bit_with_depth() -> None:
    one = _begun().going_on_as(DepthCase())
    other = one.going_on_as(DepthCase())
    assert any(o.body_m is not None for o in other.field.observations)
    for stage in (one, other):
        stage.run(4.0 * FRAME_S, score=False)
    same_state(one.field, other.field, settings=True)


def test_one_camera_alone_from_the_first_frame_on_shows_finite_images() -> None:
    stage, shown = DepthStage(DepthCase()), []
    for frame in range(60):
        stage._capture(0, frame * FRAME_S)
        stage.field.fit([stage.flying.pop()[2]], Budget(steps=STEPS))
        shown.append(stage.field.snapshot().render(HELD.camera_to_world, HELD.intrinsics).color)
    assert np.isfinite(shown).all() and (shown[-1] != shown[0]).any()
