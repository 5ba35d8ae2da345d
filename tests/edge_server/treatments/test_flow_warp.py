"""Warped forward, a stale image is nearer to the present; pixels that did not move stay the same."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.treatments.change_detection import compare, dilated
from edge_server.treatments.flow_warp import FlowWarp
from tests.edge_server.treatments.pictures import HEIGHT, MS, WIDTH, picture, seen, view

GAP_MS = 60.0


def warped(age_ms: float, **other):
    """One view warped to ``age_ms`` after its capture."""
    before, now = seen(0.0, **other), seen(GAP_MS, **other)
    (after,) = FlowWarp().treat([now], {"cam01": before}, round((GAP_MS + age_ms) * MS))
    return now, after


def error(a, b, where) -> float:
    return float(((a.astype(float) - b)[where] ** 2).mean())


@pytest.mark.parametrize("age_ms", [30.0, 60.0, 120.0])
def test_a_moving_patch_is_shown_where_it_will_be(age_ms):
    now, after = warped(age_ms)
    truth = picture(GAP_MS + age_ms)
    moved = np.abs(truth.astype(int) - now.image).max(axis=2) > 8
    assert moved.mean() > 0.02
    stale, fresh = error(now.image, truth, moved), error(after.image, truth, moved)
    assert fresh < stale / 3, (stale, fresh)
    assert after.carried_to_ns == after.shows_ns == round((GAP_MS + age_ms) * MS)
    assert after.generated_ns == now.generated_ns, "ages are reported by capture"


def test_still_pixels_keep_their_value_bit_for_bit_and_their_weight():
    now, after = warped(60.0)
    away = np.ones((HEIGHT, WIDTH), bool)
    away[25:71, 20:85] = False  # the patch, its way and what is uncertain around them
    assert np.array_equal(after.image[away], now.image[away]) and (after.weight[away] == 1.0).all()
    assert not np.array_equal(after.image, now.image)


def test_the_older_of_two_views_counts_less_where_it_was_warped():
    young = seen(GAP_MS + 100.0, "cam02")
    before = {"cam01": seen(0.0), "cam02": seen(100.0, "cam02")}
    old, fresh = FlowWarp().treat([seen(GAP_MS), young], before, round((GAP_MS + 110.0) * MS))
    made = FlowWarp()
    assert np.unique(fresh.weight) == pytest.approx([made.uncovered, 1.0])
    assert np.unique(old.weight) == pytest.approx(
        [made.uncovered * made.least_weight, made.least_weight, 1.0], abs=1e-6
    )


@pytest.mark.parametrize("noise", [1.0, 4.0, 8.0])
def test_noise_alone_is_not_taken_for_motion(noise):
    now, after = warped(120.0, px_per_ms=0.0, noise=noise)
    assert after.image is now.image and after.weight is None
    assert after.carried_to_ns == round((GAP_MS + 120.0) * MS), "it shows the present as it is"


def test_a_patch_is_followed_through_noise():
    now, after = warped(60.0, noise=4.0)
    truth = picture(GAP_MS + 60.0)
    moved = np.abs(truth.astype(int) - picture(GAP_MS)).max(axis=2) > 20
    assert error(after.image, truth, moved) < error(now.image, truth, moved) / 3


def test_no_farther_than_max_ms():
    _now, near = warped(300.0)
    _, far = warped(3_600_000.0)
    assert far.carried_to_ns - far.generated_ns == round(FlowWarp().max_ms * MS)
    assert np.array_equal(near.image, far.image)


def test_transparency_is_warped_along():
    def rgba(t_ms: float):
        image = picture(t_ms)
        alpha = np.full((HEIGHT, WIDTH, 1), 40, np.uint8)
        left = round(30 + 0.08 * t_ms)
        alpha[35:61, left : left + 30] = 250
        return view(np.concatenate([image, alpha], axis=2), t_ms)

    now = rgba(GAP_MS)
    (after,) = FlowWarp().treat([now], {"cam01": rgba(0.0)}, round(2 * GAP_MS * MS))
    truth = rgba(2 * GAP_MS).image
    stale, fresh = (np.abs(x[..., 3].astype(int) - truth[..., 3]).mean() for x in (now.image, after.image))
    assert fresh < stale / 2


def test_changes_are_found_where_the_patch_was_and_is():
    changes = compare(seen(0.0), seen(GAP_MS))
    assert changes.gap_ms == GAP_MS
    where = np.zeros((HEIGHT, WIDTH), bool)
    where[34:62, 28:67] = True
    assert not (changes.changed & ~dilated(where, 2)).any()
    assert changes.changed[where].mean() > 0.7
