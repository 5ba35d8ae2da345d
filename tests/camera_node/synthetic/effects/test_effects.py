"""Every effect keeps the contract; its errors are as large as asked for, and each camera's own."""

import pkgutil
import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from camera_node.synthetic import effects as fx
from camera_node.synthetic.effects import EffectParameters
from camera_node.synthetic.effects.clock_drift import ClockDrift
from camera_node.synthetic.effects.depth_sensor import DepthSensor, StereoDepth
from camera_node.synthetic.effects.exposure_drift import ExposureDrift
from camera_node.synthetic.effects.pose_noise import PoseNoise
from camera_node.synthetic.effects.sensor_noise import SensorNoise
from freshfield.geometry import Pinhole, Pose, look_at
from freshfield_up import check_plugin

STREAM = """
import sys, tracemalloc
from pathlib import Path
import numpy as np
from camera_node.synthetic import effects as fx, make_scene
from camera_node.synthetic.source import WorldSource

listed, folder = {listed!r}, Path({folder!r})
streams = []
scene = make_scene("tile", dict(width=16, height=16, supersample=1))
tracemalloc.start(4)
calls = 0
def count(frame, event, argument):
    global calls
    calls += event == "call" and Path(frame.f_code.co_filename).parent.name == "effects" \\
        and not frame.f_code.co_filename.endswith("__init__.py")
effects = fx.load_effects(listed, lambda n: streams.append(n) or np.random.default_rng(0))
camera = WorldSource("cam01", scene, "cam01", 15, effects=effects, folder=folder)
sys.setprofile(count)
for k in range(12):
    camera.depth(k, camera.read(camera.content(k)))
    effects.node_ns(k)
sys.setprofile(None)
held = tracemalloc.take_snapshot().filter_traces(
    [tracemalloc.Filter(True, "*synthetic/effects/[a-z]*", all_frames=True)]).statistics("filename")
assert listed or "camera_node.synthetic.depth" not in sys.modules
modules = sorted(m.rsplit(".", 1)[1] for m in sys.modules if m.startswith("camera_node.synthetic.effects."))
print(modules, streams, calls > 0, sum(s.size for s in held) > 0)
"""


def test_what_is_listed_is_all_that_is_imported_called_and_allocated(tmp_path):
    used = "['depth_sensor'] ['depth_sensor'] True True\n"
    for listed, printed in (({}, "[] [] False False\n"), ({"depth_sensor": {}}, used)):
        code = STREAM.format(listed=listed, folder=str(tmp_path))
        out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert (out.returncode, out.stdout) == (0, printed), out.stderr


def test_every_file_is_registered_and_keeps_its_contract():
    assert sorted(fx.NAMES) == sorted(m.name for m in pkgutil.iter_modules(fx.__path__))
    for name in fx.NAMES:
        assert not [outcome for outcome in check_plugin.effect(name).outcomes() if outcome[1]]


TODAY_NS = 1_790_000_000_123_456_789
POSE = Pose.from_matrix(look_at([1.0, -2.0, 1.5], [0.3, 0.2, 0.4]))


def start(parameters: EffectParameters, seed: int = 0):
    return parameters.start(np.random.default_rng(seed))


def test_a_clock_is_off_by_offset_and_drift_to_the_nanosecond():
    clock = start(ClockDrift(offset_ms=12.5, drift_ppm=50.0))
    assert clock.node_ns(TODAY_NS) == TODAY_NS + 12_500_000
    later = TODAY_NS + 3600 * 10**9
    assert clock.node_ns(np.int64(later)) == later + 12_500_000 + 180_000_000  # 50 ppm of an hour is 180 ms


def test_cameras_differ_by_the_spread_that_is_asked_for():
    clocks = [start(ClockDrift(offset_spread_ms=4.0, drift_spread_ppm=20.0), k) for k in range(2000)]
    exposures = [start(ExposureDrift(offset_spread_stops=0.4), k) for k in range(2000)]
    for values, spread in (
        ([1e-6 * c.offset_ns for c in clocks], 4.0),
        ([1e-3 * c.drift_ppb for c in clocks], 20.0),
        ([e.offset_stops for e in exposures], 0.4),
    ):
        assert np.std(values) == pytest.approx(spread, rel=0.06) and abs(np.mean(values)) < 0.1 * spread
    assert np.histogram([e.phase for e in exposures], 10, (0, 1))[0] == pytest.approx(200, abs=60)


def test_exposure_is_a_sine_in_stops_and_a_stop_doubles_as_far_as_white():
    drift = start(ExposureDrift(amplitude_stops=1.0, period_s=8.0, offset_spread_stops=0.0))
    peak_s = (0.25 - drift.phase) % 1.0 * 8.0
    image = np.array([[[0, 1, 60], [100, 127, 128], [200, 254, 255]]], np.uint8)
    for t_s, stops in ((peak_s, 1.0), (peak_s + 8e7, 1.0), (peak_s + 1.0, 0.5**0.5), (peak_s + 4.0, -1.0)):
        assert drift.stops(t_s) == pytest.approx(stops, abs=1e-6)
    assert drift.apply(image, 0, peak_s).ravel().tolist() == [0, 2, 120, 200, 254, 255, 255, 255, 255]
    trough = drift.apply(image, 0, peak_s + 4.0).ravel().tolist()
    assert trough == [0, 0, 30, 50, 64, 64, 100, 127, 128]  # halves round to the nearest even count
    assert (drift.apply(np.full((1, 1, 4), 100, np.uint8), 0, peak_s)[..., 3:] == 100).all(), "transparency is no color"


@pytest.mark.parametrize("level", [20, 220])
def test_sensor_noise_has_the_stated_variance_and_is_white(level):
    noise = start(SensorNoise(read_noise_counts=2.0, full_well_electrons=2000.0))
    a, b = (noise.apply(np.full((256, 256, 3), level, np.uint8), k).astype(float) - level for k in (0, 1))
    assert a.mean() == pytest.approx(0.0, abs=0.05)
    # Rounding to whole counts adds 1/12.
    assert a.var() == pytest.approx(4.0 + level * 255 / 2000 + 1 / 12, rel=0.02)
    for x, y in ((a, b), (a[..., 0], a[..., 1]), (a[1:], a[:-1]), (a[:, 1:], a[:, :-1])):
        assert abs(np.corrcoef(x.ravel(), y.ravel())[0, 1]) < 0.01
    for end in (0, 255):
        out = start(SensorNoise(read_noise_counts=50.0)).apply(np.full((64, 64, 3), end, np.uint8), 0)
        assert out.dtype == np.uint8 and (out == end).mean() > 0.4  # clipped, not wrapped around
    assert (noise.apply(np.full((9, 9, 4), 99, np.uint8), 0)[..., 3:] == 99).all(), "transparency is no color"


def errors(poses: list[Pose]) -> np.ndarray:
    """Translations in mm and rotation vectors in degrees, in camera axes (N, 6)."""
    true = POSE.matrix()
    moved = np.array([p.translation_m for p in poses]) - true[:3, 3]
    turned = Rotation.from_matrix([true[:3, :3].T @ p.matrix()[:3, :3] for p in poses]).as_rotvec()
    return np.hstack([1e3 * moved, np.rad2deg(turned)])


def test_pose_noise_is_as_large_as_asked_for_and_white():
    noise = start(PoseNoise(translation_mm=8.0, rotation_deg=0.5))
    found = errors([noise.reported(POSE, k, 0.0) for k in range(3000)])
    assert found.std(axis=0) == pytest.approx([8.0] * 3 + [0.5] * 3, rel=0.04)
    assert np.abs(found.mean(axis=0) / found.std(axis=0)).max() < 0.06
    # One frame's error says nothing about the next one's, nor one axis about another.
    assert np.abs(np.corrcoef(found.T) - np.eye(6)).max() < 0.06
    assert max(abs(np.corrcoef(e[1:], e[:-1])[0, 1]) for e in found.T) < 0.06


def test_correlated_pose_noise_is_as_large_and_smooth():
    noise = start(PoseNoise(translation_mm=8.0, rotation_deg=0.5, correlation_s=2.0))
    found = errors([noise.reported(POSE, 0, 1.2 * k) for k in range(3300)])
    assert found.std(axis=0) == pytest.approx([8.0] * 3 + [0.5] * 3, rel=0.06)
    far = [np.corrcoef(axis[5:], axis[:-5])[0, 1] for axis in found.T]
    assert np.abs(far).max() < 0.06, "after three times that time nothing is left"
    near = errors([noise.reported(POSE, 0, 0.1 * k) for k in range(1000)]) / ([8.0] * 3 + [0.5] * 3)
    assert np.abs(np.diff(near, axis=0)).max() < 0.6, "in a twentieth of the time"
    assert noise.reported(POSE, 5, 3.7) == noise.reported(POSE, 9, 3.7) != noise.reported(POSE, 5, 3.8)


def test_the_bias_of_poses_is_a_cameras_own_and_for_good():
    bias = PoseNoise(translation_mm=0.0, rotation_deg=0.0, translation_bias_mm=12.0, rotation_bias_deg=0.8)
    cameras = [start(bias, k) for k in range(2000)]
    assert not cameras[0].varies
    assert cameras[5].reported(POSE, 0, 0.0) == cameras[5].reported(POSE, 900, 60.0)
    found = errors([c.reported(POSE, 0, 0.0) for c in cameras])
    assert found.std(axis=0) == pytest.approx([12.0] * 3 + [0.8] * 3, rel=0.05)


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


def test_without_errors_it_is_exact_depth_in_millimeters_within_its_range_and_scale():
    depth = np.random.default_rng(1).uniform(0.001, 65.0, WALL.shape).astype(np.float32)
    depth[5] = 0.0
    assert np.abs(counts(sensor(), depth) - depth * 1e3).max() < 0.51
    seen = counts(sensor(nearest_m=0.3, farthest_m=8.0), depth) > 0
    assert np.array_equal(seen, (depth >= 0.3) & (depth <= 8.0))
    cameras = [sensor(k, scale_spread_percent=0.5) for k in range(400)]
    assert np.std([c.scale for c in cameras]) == pytest.approx(0.005, rel=0.12)
    assert (np.abs(counts(cameras[3], WALL) - 2000.0 * cameras[3].scale) <= 0.5).all()


def test_noise_has_the_stated_deviation_and_reach_and_steps_are_of_disparity():
    def error(frames: int, **parameters) -> np.ndarray:
        made = sensor(**parameters)
        return K / (np.stack([counts(made, index=k) for k in range(frames)]) * 1e-3) - K / 2.0

    new, fixed = error(40, noise_px=0.08), error(2, fixed_noise_px=0.06)
    assert new.std() == pytest.approx(0.08, rel=0.04)
    assert abs(np.corrcoef(new[:-1].ravel(), new[1:].ravel())[0, 1]) < 0.05, "new in each frame"
    assert np.array_equal(fixed[0], fixed[1]) and fixed[0].std() == pytest.approx(0.06, rel=0.1)
    # White noise smoothed by sigma has the autocorrelation exp(-x^2 / (4 sigma^2)).
    near = np.corrcoef(new[:, :, 1:].ravel(), new[:, :, :-1].ravel())[0, 1]
    assert near == pytest.approx(np.exp(-1 / (4.0 * (2.3 * LENS.fx / 425.0) ** 2)), abs=0.05)
    assert error(10, noise_px=0.08, smoothing_px=0.0).std() == pytest.approx(0.08, rel=0.04)
    ramp = np.linspace(3.0, 8.0, WALL.size, dtype=np.float32).reshape(WALL.shape)  # nearer, steps are millimeters
    steps = K / (counts(sensor(step_px=1 / 32), ramp) * 1e-3) * 32.0
    assert np.abs(steps - np.rint(steps)).max() < 0.05
    assert len(np.unique(np.rint(steps))) == pytest.approx(32.0 * (K / 3.0 - K / 8.0), abs=2)


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
    image = np.random.default_rng(2).integers(0, 256, (*shape, 3), dtype=np.uint8)
    for depth in (0.0, 1e-30, 1e-3, 0.3, 8.0, 65.5, 1e4, 1e30):
        for parameters in ({}, EXACT, {"smoothing_px": 10.0, "noise_px": 100.0, "fixed_noise_px": 100.0}):
            made = DepthSensor(**parameters).start(np.random.default_rng(0))
            found = made.measure(np.full(shape, depth, np.float32), image, LENS, 2**62).counts
            assert found.shape == shape
            assert depth > 0.0 or not found.any(), "nothing there, nothing measured"
