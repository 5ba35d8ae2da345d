"""Each error of the depth sensor has the size, the place and the sign that its parameter says."""

from __future__ import annotations

import numpy as np
import pytest

from camera_node.synthetic.effects.depth_sensor import DepthSensor, StereoDepth
from freshfield.geometry import Pinhole

ERRORS = ("noise_px", "fixed_noise_px", "step_px", "scale_spread_percent", "nearest_m", "silhouette_holes", "flying")
EXACT = dict.fromkeys((*ERRORS, "dark_holes", "bright_holes"), 0.0) | {"farthest_m": 65.535, "shadow": False}
LENS = Pinhole.from_fov(160, 120, 60.0)
GRAY = np.full((120, 160, 3), 128, np.uint8)
K = 425.0 * 0.05  # disparity = K / depth
WALL = np.full((120, 160), 2.0, np.float32)


def sensor(seed: int = 0, **parameters) -> StereoDepth:
    return DepthSensor(**{**EXACT, **parameters}).start(np.random.default_rng(seed))


def counts(made: StereoDepth, depth=WALL, index: int = 0, image=GRAY) -> np.ndarray:
    measured = made.measure(depth, image, LENS, index)
    assert measured.counts.dtype == np.uint16 and measured.meters_per_count == 0.001
    assert measured.intrinsics is None and measured.to_camera is None, "registered to the image"
    return measured.counts


def disparity_error(made: StereoDepth, frames: int, depth_m: float = 2.0) -> np.ndarray:
    shown = np.stack([counts(made, np.full_like(WALL, depth_m), k) for k in range(frames)])
    assert (shown > 0).all()
    return K / (shown * 1e-3) - K / depth_m


def test_without_errors_it_is_exact_depth_in_millimeters_within_its_range_and_scale():
    depth = np.random.default_rng(1).uniform(0.001, 65.0, WALL.shape).astype(np.float32)
    depth[5] = 0.0
    assert np.abs(counts(sensor(), depth) - depth * 1e3).max() < 0.51
    seen = counts(sensor(nearest_m=0.3, farthest_m=8.0), depth) > 0
    assert np.array_equal(seen, (depth >= 0.3) & (depth <= 8.0))
    cameras = [sensor(k, scale_spread_percent=0.5) for k in range(400)]
    assert np.std([c.scale for c in cameras]) == pytest.approx(0.005, rel=0.12)
    assert (np.abs(counts(cameras[3], WALL) - 2000.0 * cameras[3].scale) <= 0.5).all()


def test_noise_has_the_stated_deviation_and_reach():
    new = disparity_error(sensor(noise_px=0.08), 40)
    assert new.std() == pytest.approx(0.08, rel=0.04)
    assert abs(np.corrcoef(new[:-1].ravel(), new[1:].ravel())[0, 1]) < 0.05, "new in each frame"
    fixed = disparity_error(sensor(fixed_noise_px=0.06), 2, 1.0)
    assert np.array_equal(fixed[0], fixed[1]) and fixed[0].std() == pytest.approx(0.06, rel=0.1)
    # White noise smoothed by sigma has the autocorrelation exp(-x^2 / (4 sigma^2)).
    sigma = 2.3 * LENS.fx / 425.0
    for x in (1, 2):
        near = np.corrcoef(new[:, :, x:].ravel(), new[:, :, :-x].ravel())[0, 1]
        assert near == pytest.approx(np.exp(-(x**2) / (4.0 * sigma**2)), abs=0.05)
    assert disparity_error(sensor(noise_px=0.08, smoothing_px=0.0), 10).std() == pytest.approx(0.08, rel=0.04)


def test_steps_of_disparity():
    ramp = np.linspace(1.0, 8.0, WALL.size, dtype=np.float32).reshape(WALL.shape)
    steps = K / (counts(sensor(step_px=1 / 32), ramp) * 1e-3) * 32.0
    # At 1 m a millimeter is .02 px, which is .7 of a step; from 3 m on the steps stand out.
    far = ramp > 3.0
    assert np.abs(steps - np.rint(steps))[far].max() < 0.05
    found = np.unique(np.rint(steps[far]))
    assert len(found) == pytest.approx(32.0 * (K / 3.0 - K / 8.0), abs=2)


def box(near_m: float = 1.0, far_m: float = 4.0) -> np.ndarray:
    """A box in front of a wall, in the columns 60 to 99."""
    depth = np.full_like(WALL, far_m)
    depth[:, 60:100] = near_m
    return depth


def test_the_second_imager_s_shadow_is_left_of_what_is_near():
    hole = counts(sensor(shadow=True), box()) == 0
    columns = np.flatnonzero(hole.any(axis=0))
    width_px = LENS.fx * 0.05 * (1.0 / 1.0 - 1.0 / 4.0)  # difference of disparities, in pixels of the image
    assert columns.max() == 59 and len(columns) == pytest.approx(width_px, abs=1.0)
    assert hole[:, columns].all()
    # Seen from both imagers: a plane that is not across the axis.
    slanted = 1.0 / (0.2 + 0.004 * np.arange(160, dtype=np.float32))
    for row in (slanted, slanted[::-1]):
        assert (counts(sensor(shadow=True), np.tile(row, (120, 1))) > 0).all()


def test_silhouettes_have_holes_and_flying_pixels():
    at = np.isin(np.arange(160), (59, 60, 99, 100))  # the pixels beside a jump, on both sides
    shown = np.stack([counts(sensor(silhouette_holes=0.3), box(), k) for k in range(20)])
    assert (shown[:, :, ~at] > 0).all()
    assert (shown[:, :, at] == 0).mean() == pytest.approx(0.3, abs=0.02)
    flown = np.stack([counts(sensor(flying=0.5), box(), k) for k in range(20)])
    assert np.array_equal(flown[:, :, ~at], np.broadcast_to(np.rint(box() * 1e3), flown.shape)[:, :, ~at])
    moved = flown[:, :, at] != np.rint(box() * 1e3)[:, at]
    assert moved.mean() == pytest.approx(0.5, abs=0.02)
    assert flown.min() >= 1000 and flown.max() <= 4000
    share = (1.0 / (flown[:, :, at][moved] * 1e-3) - 0.25) / 0.75  # of inverse depth, from the wall to the box
    assert share.mean() == pytest.approx(0.5, abs=0.03) and share.std() == pytest.approx(12**-0.5, abs=0.03)
    # A plane has no silhouette, however slanted.
    slanted = np.tile(1.0 / (0.13 + 0.02 * np.arange(160, dtype=np.float32)), (120, 1))
    assert np.array_equal(counts(sensor(silhouette_holes=1.0), slanted)[:, 1:-1], counts(sensor(), slanted)[:, 1:-1])


def test_dark_and_overexposed_pixels_stay_unmeasured():
    image = GRAY.copy()
    image[:40], image[40:80] = 24, 251
    made = sensor(dark_holes=0.7, bright_holes=0.5)
    first, later = (counts(made, image=image, index=k) == 0 for k in (0, 9))
    assert np.array_equal(first, later), "no median over time fills them"
    assert first[:40].mean() == pytest.approx(0.7, abs=0.02)
    assert first[40:80].mean() == pytest.approx(0.5, abs=0.02)
    assert not first[80:].any()


@pytest.mark.stability
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (48, 5)])
def test_any_size_and_any_depth_give_counts(shape):
    rng = np.random.default_rng(2)
    image = rng.integers(0, 256, (*shape, 3), dtype=np.uint8)
    for depth in (0.0, 1e-30, 1e-3, 0.3, 8.0, 65.5, 1e4, 1e30):
        for parameters in ({}, EXACT, {"smoothing_px": 10.0, "noise_px": 100.0, "fixed_noise_px": 100.0}):
            made = DepthSensor(**parameters).start(np.random.default_rng(0))
            found = made.measure(np.full(shape, depth, np.float32), image, LENS, 2**62).counts
            assert found.shape == shape
            assert depth > 0.0 or not found.any(), "nothing there, nothing measured"
