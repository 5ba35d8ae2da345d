"""Only what is listed is imported, made or computed; every effect keeps the contract."""

from __future__ import annotations

import pkgutil

import numpy as np
import pytest

from camera_node.synthetic import effects as fx
from camera_node.synthetic import make_scene
from camera_node.synthetic.source import WorldSource
from freshfield.settings import ScenarioError
from freshfield_up import check_plugin


def test_every_file_is_registered_and_keeps_its_contract_and_others_are_refused():
    assert sorted(fx.NAMES) == sorted(m.name for m in pkgutil.iter_modules(fx.__path__))
    for name in fx.NAMES:
        assert not [outcome for outcome in check_plugin.effect(name).outcomes() if outcome[1]]
    for listed, message in (
        ({"smoke": {}}, "effect 'smoke' is not known; there are: bump, clock_drift, depth_sensor, exposure_drift, "),
        ({"pose_noise": {"correlation_s": 1e-9}}, "correlation_s must be 0 or at least 0.001"),
    ):
        with pytest.raises(ScenarioError, match=message):
            fx.load_effects(listed, lambda name: np.random.default_rng(0))


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
        ("sensor_noise", {"read_noise_counts": 0.0, "full_well_electrons": 0.0}),
        ("pose_noise", {"translation_mm": 1e5, "rotation_deg": 180.0, "correlation_s": 1e-3}),
        ("pose_noise", {"translation_mm": 1e-300, "rotation_deg": 1e-300, "correlation_s": 1e6}),
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
    pose = fx.Pose((1.0, 0.0, 0.0, 0.0), (1.0, 2.0, 3.0))
    assert all(np.isfinite(made.reported_pose(pose, k, k / 15).matrix()).all() for k in (0, 4, 10**12))
