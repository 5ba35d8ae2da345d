"""Only what is listed is imported, made or computed; every effect keeps the contract."""

from __future__ import annotations

import pkgutil
import subprocess
import sys

import numpy as np
import pytest

from camera_node.synthetic import effects as fx
from camera_node.synthetic import make_scene
from camera_node.synthetic.source import WorldSource
from freshfield.settings import ScenarioError
from freshfield_up import check_plugin

STREAM = """
import sys
import numpy as np
from camera_node.synthetic import effects as fx, make_scene
from camera_node.synthetic.source import WorldSource

streams = []
effects = fx.load_effects({listed!r}, lambda n: streams.append(n) or np.random.default_rng(0))
scene = make_scene("tile", dict(width=16, height=16, supersample=1))
camera = WorldSource("cam01", scene, "cam01", 15, effects=effects)
camera.depth(0, camera.read(camera.content(0)))
effects.node_ns(0)
modules = sorted(m.rsplit(".", 1)[1] for m in sys.modules if m.startswith("camera_node.synthetic.effects."))
print(modules, streams, "camera_node.synthetic.depth" in sys.modules)
"""


@pytest.mark.parametrize(
    ("listed", "expected"), [({}, "[] [] False"), ({"depth_sensor": {}}, "['depth_sensor'] ['depth_sensor'] True")]
)
def test_what_is_listed_is_all_that_is_imported_and_made(listed, expected):
    out = subprocess.run([sys.executable, "-c", STREAM.format(listed=listed)], capture_output=True, text=True)
    assert out.stdout.strip() == expected, out.stderr


def test_every_file_is_registered_and_keeps_its_contract():
    assert sorted(fx.NAMES) == sorted(m.name for m in pkgutil.iter_modules(fx.__path__))
    for name in fx.NAMES:
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
    assert fx.load_effects({"clock_drift": {"cameras": ["cam02"]}}, rng_for, camera="cam01") is fx.NO_EFFECTS
    training = fx.load_effects(listed, rng_for)
    assert len(training.image) == 2 and len(training.clock) == 1


@pytest.mark.parametrize(
    ("listed", "message"),
    [
        ({"smoke": {}}, "effect 'smoke' is not known; there are: bump, clock_drift, depth_sensor, exposure_drift, "),
        ({"sensor_noise": {"sigma": 1}}, "effect sensor_noise.sigma: unknown key; expected one of read_noise"),
        ({"pose_noise": {"correlation_s": 1e-9}}, "correlation_s must be 0 or at least 0.001"),
    ],
)
def test_an_invalid_effect_is_refused_in_one_line(listed, message):
    with pytest.raises(ScenarioError, match=message) as error:
        fx.load_effects(listed, lambda name: np.random.default_rng(0))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["depth_sensor", "exposure_drift", "pose_noise", "sensor_noise"])
def test_frames_repeat_in_any_order(name):
    """A frame depends on the camera's random stream and the frame's number alone."""
    scene = make_scene("room", {"width": 24, "height": 16, "supersample": 1, "count": 2})

    def frames(seed: int, numbers: tuple[int, ...]) -> list:
        made = fx.load_effects({name: {}}, lambda _: np.random.default_rng(seed))
        camera = WorldSource("eye", scene, "cam01", 15, effects=made, codec="zstd")
        found = []
        for k in numbers:
            shot = camera.read(k)
            depth = camera.depth(k, shot)
            assert (depth is not None) == (name == "depth_sensor")
            found.append((bytes(shot.image), shot.pose, None if depth is None else depth.counts.tobytes()))
        return found

    first = frames(0, (0, 1, 2**40))
    assert len(set(first)) == 3 and frames(0, (2**40, 1, 0)) == first[::-1]
    assert frames(1, (0,)) != first[:1]


@pytest.mark.stability
@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("exposure_drift", {"amplitude_stops": 8.0, "offset_spread_stops": 8.0, "period_s": 0.01}),
        ("exposure_drift", {"amplitude_stops": 0.0, "offset_spread_stops": 0.0, "period_s": 1e6}),
        ("sensor_noise", {"read_noise_counts": 0.0, "full_well_electrons": 0.0}),
        ("pose_noise", {"translation_mm": 1e5, "rotation_deg": 180.0, "correlation_s": 1e-3}),
        ("pose_noise", {"translation_mm": 1e-300, "rotation_deg": 1e-300, "correlation_s": 1e6}),
        ("pose_noise", {"translation_bias_mm": 1e5, "rotation_bias_deg": 180.0}),
    ],
    ids=str,
)
@pytest.mark.filterwarnings("error")
def test_the_ends_of_the_ranges_give_sound_frames_of_any_size(name, parameters):
    made = fx.load_effects({name: parameters}, lambda _: np.random.default_rng(4))
    for shape in ((1, 1, 3), (1, 7, 3), (64, 3, 3)):
        for level in (0, 255):
            out = made.apply(np.full(shape, level, np.uint8), 2**62, 1e12)
            assert out.shape == shape and out.dtype == np.uint8
    pose = fx.Pose.from_matrix(make_scene("tile", {"count": 1}).cameras["cam00"][1])
    assert all(np.isfinite(made.reported_pose(pose, k, k / 15).matrix()).all() for k in (0, 4, 10**12))
