"""Only what is listed is imported, made or computed."""

from __future__ import annotations

import pkgutil
import subprocess
import sys

import numpy as np
import pytest

from camera_node.synthetic import effects as fx
from camera_node.synthetic import make_scene
from camera_node.synthetic.source import WorldSource
from freshfield.geometry import Pose
from freshfield.settings import ScenarioError
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


def stream(listed: dict, folder: str) -> str:
    code = STREAM.format(listed=listed, folder=folder)
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert out.returncode == 0, out.stderr
    return out.stdout.strip()


def test_nothing_listed_is_nothing_imported_called_or_allocated(tmp_path):
    assert stream({}, str(tmp_path)) == "[] [] False False"


def test_what_is_listed_is_all_that_is_imported(tmp_path):
    """The other way round, so that the test above cannot pass by measuring nothing."""
    for name in ("sensor_noise", "depth_sensor"):
        assert stream({name: {}}, str(tmp_path)) == f"['{name}'] ['{name}'] True True"


def test_every_file_is_registered_and_keeps_its_contract():
    on_disk = sorted(m.name for m in pkgutil.iter_modules(fx.__path__))
    assert sorted(fx.NAMES) == on_disk
    for name in fx.NAMES:
        cls = fx.effect_class(name)
        assert issubclass(cls, fx.EffectParameters) and cls().in_truth is False
        assert not [outcome for outcome in check_plugin.effect(name).outcomes() if outcome[1]]


def test_the_held_out_camera_shows_the_truth_unless_in_truth():
    listed = {"sensor_noise": {}, "exposure_drift": {"in_truth": True}, "clock_drift": None}
    asked: list[str] = []

    def rng_for(name: str) -> np.random.Generator:
        asked.append(name)
        return np.random.default_rng(0)

    held_out = fx.load_effects(listed, rng_for, held_out=True)
    assert asked == ["exposure_drift"]
    assert len(held_out.image) == 1 and not held_out.clock
    assert fx.load_effects({"sensor_noise": {}}, rng_for, held_out=True) is fx.NO_EFFECTS
    assert fx.load_effects({"clock_drift": {"cameras": ["cam02"]}}, rng_for, camera="cam01") is fx.NO_EFFECTS
    training = fx.load_effects(listed, rng_for)
    assert len(training.image) == 2 and len(training.clock) == 1


@pytest.mark.parametrize(
    ("listed", "message"),
    [
        ({"smoke": {}}, "effect 'smoke' is not known; there are: bump, clock_drift, depth_sensor, exposure_drift, "),
        ({"sensor_noise": {"sigma": 1}}, "effect sensor_noise.sigma: unknown key; expected one of read_noise"),
        ({"exposure_drift": {"period_s": 0}}, "period_s: expected .*0.01 to 1000000"),
        ({"pose_noise": {"correlation_s": 1e-9}}, "correlation_s must be 0 or at least 0.001"),
        ({"sensor_noise": {"in_truth": "no"}}, "sensor_noise.in_truth"),
    ],
)
def test_an_invalid_effect_is_refused_in_one_line(listed, message):
    with pytest.raises(ScenarioError, match=message) as error:
        fx.load_effects(listed, lambda name: np.random.default_rng(0))
    assert "\n" not in str(error.value)


# Parameters with which an effect changes nothing.
NEUTRAL: dict[str, dict] = {
    "bump": {"yaw_deg": 0.0},
    "clock_drift": {},
    "depth_sensor": {},
    "exposure_drift": {"amplitude_stops": 0.0, "offset_spread_stops": 0.0},
    "pose_delay": {"delay_ms": 0.0},
    "pose_noise": {"translation_mm": 0.0, "rotation_deg": 0.0},
    "sensor_noise": {"read_noise_counts": 0.0, "full_well_electrons": 0.0},
}


@pytest.mark.parametrize("name", sorted(NEUTRAL))
def test_an_effect_of_no_strength_changes_nothing(name):
    effects = fx.load_effects({name: NEUTRAL[name]}, lambda _: np.random.default_rng(3))
    scene = make_scene("room", {"width": 24, "height": 16, "supersample": 1, "count": 2})
    plain, matrix = scene.render("cam01", 0.4), scene.cameras["cam01"][1]
    assert np.array_equal(effects.apply(plain, 6, 0.4), plain)
    assert np.array_equal(effects.placed(matrix, 0.4), matrix) and effects.pose_instant_s(0.4) == 0.4
    assert np.allclose(effects.reported_pose(Pose.from_matrix(matrix), 6, 0.4).matrix(), matrix, atol=1e-12)
    assert effects.node_ns(2 * 10**18 + 1) == 2 * 10**18 + 1


@pytest.mark.parametrize("name", ["exposure_drift", "pose_noise", "sensor_noise"])
def test_frames_repeat_in_any_order_and_leave_what_they_are_given(name):
    """A frame depends on the camera's random stream and the frame's number alone."""
    image, pose = np.full((16, 24, 4), 100, np.uint8), Pose.from_matrix(np.eye(4))

    def frames(seed: int, numbers: tuple[int, ...]) -> list[tuple[bytes, Pose]]:
        made = fx.load_effects({name: {}}, lambda _: np.random.default_rng(seed))
        shown = [made.apply(image[..., :3] if name == "sensor_noise" else image, k, k / 15) for k in numbers]
        assert all((one[..., 3:] == 100).all() for one in shown), "transparency is no color"
        return [(one.tobytes(), made.reported_pose(pose, k, k / 15)) for one, k in zip(shown, numbers)]

    first = frames(0, (0, 1, 2**40))
    assert len(set(first)) == 3 and frames(0, (2**40, 1, 0)) == first[::-1]
    assert frames(1, (0,)) != first[:1] and (image == 100).all()


def test_each_effect_has_its_own_random_stream():
    """What one effect draws does not depend on which others are listed."""

    def rng_for(name: str) -> np.random.Generator:
        return np.random.default_rng([1, *name.encode()])

    image = np.full((8, 8, 3), 128, np.uint8)
    alone = fx.load_effects({"sensor_noise": {}}, rng_for)
    among = fx.load_effects({"clock_drift": {}, "pose_noise": {}, "sensor_noise": {}}, rng_for)
    assert np.array_equal(alone.apply(image, 0, 0.0), among.apply(image, 0, 0.0))


SCENE = {"width": 16, "height": 12, "supersample": 1, "speed_m_per_s": 8.0}
# The ends of the ranges that the docstrings and messages promise.
EXTREMES: dict[str, list[dict]] = {
    "exposure_drift": [
        {"amplitude_stops": 8.0, "offset_spread_stops": 8.0, "period_s": 0.01},
        {"amplitude_stops": 0.0, "offset_spread_stops": 0.0, "period_s": 1e6},
    ],
    "depth_sensor": [
        {"noise_px": 100.0, "fixed_noise_px": 100.0, "smoothing_px": 10.0, "step_px": 100.0, "farthest_m": 65.535},
        {"nearest_m": 1e3, "scale_spread_percent": 20.0, "silhouette_holes": 1.0, "flying": 1.0, "dark_holes": 1.0},
    ],
    "pose_noise": [
        {"translation_mm": 1e5, "rotation_deg": 180.0},
        {"translation_bias_mm": 1e5, "rotation_bias_deg": 180.0},
        {"translation_mm": 0.0, "rotation_deg": 0.0},
        {"translation_mm": 1e-300, "rotation_deg": 1e-300},
        {"translation_mm": 1e5, "rotation_deg": 180.0, "correlation_s": 1e-3},
        {"correlation_s": 1e6},
    ],
}
CASES = [(name, parameters) for name, some in EXTREMES.items() for parameters in some]


def load(name: str, parameters: dict) -> fx.Effects:
    return fx.load_effects({name: parameters}, lambda _: np.random.default_rng(4))


@pytest.mark.stability
@pytest.mark.parametrize(("name", "parameters"), CASES, ids=str)
@pytest.mark.filterwarnings("error")
def test_the_ends_of_the_ranges_give_sound_frames_in_every_scene(name, parameters):
    made = load(name, parameters)
    for scene_name in ("room", "tile", "tower"):
        given = {k: v for k, v in SCENE.items() if scene_name != "tile" or k != "speed_m_per_s"}
        scene = make_scene(scene_name, given)
        camera = WorldSource("eye", scene, "cam01", 15, effects=made, codec="zstd")
        pose = Pose.from_matrix(scene.cameras["cam01"][1])
        for k in (0, 4, 10**12):
            shot = camera.read(k)
            image = shot.image
            measured = camera.depth(k, shot)
            assert (measured is not None) == (name == "depth_sensor")
            if isinstance(image, np.ndarray):
                assert image.shape == (12, 16, 3) and image.dtype == np.uint8
            reported = made.reported_pose(pose, k, k / 15)
            assert np.isfinite(reported.matrix()).all()
        assert np.array_equal(camera.image(4), camera.image(4))


@pytest.mark.stability
@pytest.mark.parametrize("level", [0, 255])
@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 7, 3), (7, 1, 4), (64, 3, 4)])
@pytest.mark.filterwarnings("error")
def test_image_effects_take_any_image(level, shape):
    for name in ("exposure_drift", "sensor_noise"):
        for parameters in EXTREMES.get(name, [{}]):
            out = load(name, parameters).apply(np.full(shape, level, np.uint8), 2**62, 1e12)
            assert out.shape == shape and out.dtype == np.uint8
