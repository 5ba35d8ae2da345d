"""Weights of views: pixels of weight 0 teach nothing, in every representation."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from edge_server.fields import Budget, View
from tests.edge_server.fields.scenes import mean_psnr, ring
from tests.edge_server.fields.small import every_field, healthy, reaches, tiny

VIEWS = ring(7, size=24)
pytestmark = pytest.mark.stability


def weighed(view: View, weight: float) -> View:
    return replace(view, weight=np.full(view.image.shape[:2], weight, np.float32))


def fitted(name: str, *sets: list[View], steps: int = 12) -> Any:
    # The color behind everything is found from whole pictures, not from what they teach.
    field = tiny(name, background="#808080")
    for views in sets:
        field.fit(views, Budget(steps=steps))
    return field


def shown(name: str, views: list[View], steps: int = 12) -> np.ndarray:
    return fitted(name, views, steps=steps).render(VIEWS[0].camera_to_world, VIEWS[0].intrinsics).color


@every_field
def test_a_view_of_no_weight_teaches_nothing_and_one_of_full_weight_all(name: str) -> None:
    rng = np.random.default_rng(0)
    noise = replace(VIEWS[3], image=rng.integers(0, 256, VIEWS[3].image.shape, dtype=np.uint8))
    silent = ([*VIEWS[:3], weighed(third, 0.0), *VIEWS[4:]] for third in (VIEWS[3], noise))
    np.testing.assert_array_equal(*(shown(name, views) for views in silent))
    np.testing.assert_array_equal(shown(name, VIEWS), shown(name, [weighed(view, 1.0) for view in VIEWS]))


@every_field
def test_views_of_no_weight_at_all_break_nothing(name: str) -> None:
    nothing = [weighed(view, 0.0) for view in VIEWS]
    healthy(fitted(name, nothing), VIEWS)
    field = fitted(name, VIEWS, nothing, [weighed(VIEWS[0], 0.0)], steps=40)
    healthy(field, VIEWS)
    field.fit(VIEWS, Budget(steps=120))
    reaches(name, "after no weights", mean_psnr(field, VIEWS))  # it goes on learning


@every_field
def test_of_two_that_disagree_the_heavier_one_is_believed(name: str) -> None:
    views = []
    for kind, color, weight in (("red", (230, 20, 20), 1.0), ("blue", (20, 20, 230), 0.05)):
        image = np.broadcast_to(np.array(color, np.uint8), (24, 24, 3)).copy()
        views += [weighed(replace(v, camera=f"{kind}{k}", image=image), weight) for k, v in enumerate(VIEWS)]
    color = shown(name, views, steps=150)
    assert color[..., 0].mean() > 2.0 * color[..., 2].mean()
