"""What becomes a plate, and what is foreground: a body that passes, stays, or hides in a change of light."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from edge_server.fields.common.threads.thread_pool import CallerPool
from edge_server.fields.splat.layers.plates import FinePlate, Plate, plain_share
from tests.edge_server.fields.scenes import ring

SIZE = 48
WALL = cv2.resize(np.random.default_rng(0).integers(60, 180, (12, 12, 3), np.uint8), (SIZE, SIZE))
BODY = slice(16, 32)


def _frame(at: int | None = None) -> np.ndarray:
    """The wall, with a body at column ``at``."""
    image = WALL.copy()
    if at is not None:
        image[BODY, at : at + 10] = (250, 30, 30)
    return image


def _seen(frames: int = 12) -> Plate:
    plate = Plate(SIZE, SIZE, CallerPool())
    for _ in range(frames):
        assert not plate.take(_frame()).any()
    return plate


def _opaque_at(left: int, right: int) -> NDArray[np.float32]:
    """The opacity of a moving set that shows the body between two columns."""
    opacity = np.zeros((SIZE, SIZE), np.float32)
    opacity[BODY, left:right] = 1.0
    return opacity


def test_a_body_that_stays_becomes_the_plate_unless_it_is_held() -> None:
    for held in (False, True):
        plate = _seen()
        for _ in range(20):
            image = _frame(20)
            foreground = plate.take(image)
            if held:
                plate.exclude_explained(image, image / np.float32(255.0), _opaque_at(20, 30))
        assert foreground[BODY, 20:30].all() == held
        expected = WALL[20:28, 22:28] if held else np.full((8, 6, 3), (250, 30, 30))
        np.testing.assert_allclose(plate.picture[20:28, 22:28], expected, atol=1.0)


@pytest.mark.parametrize("by_itself", [False, True])
def test_a_plate_by_itself_asks_no_field_what_is_background(by_itself: bool) -> None:
    """Fields learned from plates that are not certain would confirm what is wrong with these."""
    plate = _seen()
    for k in range(20):
        image = _frame(20)  # a body that stays
        image[:, 40:] = (40, 220)[k % 2]  # a curtain that never holds still
        plate.fill_unknown(image / np.float32(255.0))
        plate.exclude_explained(image, image / np.float32(255.0), _opaque_at(20, 30))
        plate.take(image, by_itself=by_itself)
    body, curtain = plate.picture[20:28, 22:28], plate.arrays.means[:2, 20:28, 45:, 0]
    np.testing.assert_allclose(body, np.full((8, 6, 3), (250, 30, 30)) if by_itself else WALL[20:28, 22:28], atol=1.0)
    assert (np.isclose(curtain, 40, atol=1) | np.isclose(curtain, 220, atol=1)).any() != by_itself


def test_what_is_unknown_is_compared_with_the_static_field() -> None:
    plate = Plate(SIZE, SIZE, CallerPool())
    for k in range(20):  # a curtain that never holds still
        image = _frame()
        image[:, 30:] = (40, 220)[k % 2]
        plate.take(image)
    assert not plate.known[5:-5, 36:-5].any() and plate.known[:, :26].all()
    plate.fill_unknown(WALL / np.float32(255.0))
    np.testing.assert_allclose(plate.picture[5:-5, 36:-5], WALL[5:-5, 36:-5], atol=0.1)
    assert not plate.take(_frame()).any()
    assert plate.take(_frame(34))[BODY, 35:43].all()


def test_a_fine_plate_is_at_the_common_exposure_and_leaves_out_what_moves() -> None:
    """The mean of frames divided by their exposures: with twice the light, half the color."""
    whole = ring(2, size=2 * SIZE)[0]
    fine, away = FinePlate(whole), np.zeros((SIZE, SIZE), bool)
    away[:8] = True

    def take(color: int, gain: float) -> None:
        fine.take(np.full(whole.image.shape, color, np.uint8), away, np.full(3, gain, np.float32))

    for color, gain in ((100, 1.0), (160, 2.0), (80, 1.0)):
        assert not fine.known.any()  # of less than three frames
        take(color, gain)
    assert fine.known[20:].all() and not fine.known[:16].any() and fine.count == 3
    np.testing.assert_allclose(fine.color[20:], (100 + 80 + 80) / 3, rtol=1e-5)
    assert not fine.color[:16].any()
    for _ in range(40):
        take(100, 1.0)
    before = fine.color[20:].copy()
    take(180, 1.0)  # counts for a sixteenth
    np.testing.assert_allclose(fine.color[20:], before + (180 - before) / 16, rtol=1e-5)


def test_plain_is_what_changes_by_less_than_two_steps_within_nine_pixels() -> None:
    rng = np.random.default_rng(1)
    grained = rng.normal(128.0, 3.0, (60, 80, 3)).astype(np.float32)
    faint = rng.normal(128.0, 1.0, (60, 80, 3)).astype(np.float32)
    half = np.hstack([grained[:, :40], faint[:, :40]])  # plain where at most three of nine columns are grained
    assert plain_share([grained]) == 0.0 and plain_share([faint]) == 1.0
    assert plain_share([half]) == pytest.approx(39 / 80, abs=0.02)
    assert plain_share([half, faint]) == pytest.approx((39 / 80 + 1.0) / 2, abs=0.01)
    one = faint.copy()
    one[..., 2] = grained[..., 2]
    assert plain_share([one]) < 0.01  # one channel tells places apart


def test_a_plate_takes_images_that_are_views_of_others_and_loads_no_state_of_other_images() -> None:
    image = np.random.default_rng(0).integers(0, 256, (SIZE, SIZE, 3), np.uint8)
    one, other = Plate(SIZE, SIZE, CallerPool()), Plate(SIZE, SIZE, CallerPool())
    for _ in range(4):
        one.take(image[::-1, :, ::-1])
        other.take(image[::-1, :, ::-1].copy())
    state = one.state()
    for name, array in other.state().items():
        np.testing.assert_array_equal(state[name], array)
    for name in ("weight", "total", "run", "deviation", "_held", "_frames"):
        with pytest.raises(ValueError, match=f"lacks '{name}'"):
            Plate(SIZE, SIZE, CallerPool()).load_state(state | {name: state[name][..., :-1, :]})
