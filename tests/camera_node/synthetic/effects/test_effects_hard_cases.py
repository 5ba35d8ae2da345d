"""Hard cases of effects: the ends of every parameter's range, extreme images, instants and frame numbers."""

from __future__ import annotations

import math
import typing

import numpy as np
import pytest

from camera_node.synthetic import effects as fx
from camera_node.synthetic import make_scene
from camera_node.synthetic.source import WorldSource
from freshfield.geometry import Pose

pytestmark = pytest.mark.stability

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
    "lens_distortion": [{"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}, {"k1": 10.0}, {"k1": -1e-9}],
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


@pytest.mark.parametrize(("name", "parameters"), CASES, ids=str)
@pytest.mark.filterwarnings("error")
def test_the_ends_of_the_ranges_give_sound_frames_in_every_scene(name, parameters):
    made = load(name, parameters)
    for scene_name in ("room", "tile", "tower"):
        given = {k: v for k, v in SCENE.items() if scene_name != "tile" or k != "speed_m_per_s"}
        scene = make_scene(scene_name, given)
        if parameters == {"k1": 10.0}:
            with pytest.raises(fx.EffectError, match="cannot be undone"):
                made.extend(scene)
            continue
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


@pytest.mark.parametrize("level", [0, 255])
@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 7, 3), (7, 1, 4), (64, 3, 4)])
@pytest.mark.filterwarnings("error")
def test_image_effects_take_any_image(level, shape):
    for name in ("exposure_drift", "sensor_noise"):
        for parameters in EXTREMES.get(name, [{}]):
            out = load(name, parameters).apply(np.full(shape, level, np.uint8), 2**62, 1e12)
            assert out.shape == shape and out.dtype == np.uint8


def numbers() -> list[tuple[str, str]]:
    """Every number among the parameters of every effect."""
    found = []
    for name in fx.NAMES:
        hints = typing.get_type_hints(fx.effect_class(name))
        found += [(name, key) for key, kind in hints.items() if kind in (int, float)]
    return found


@pytest.mark.parametrize(("name", "parameter"), numbers())
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300, -1e300, "much", None, [1.0], True])
def test_no_number_may_be_nonsense(name, parameter, value):
    """Refused in one line that names the effect and the parameter."""
    with pytest.raises(fx.EffectError, match=name) as error:
        load(name, {parameter: value})
    assert "\n" not in str(error.value) and parameter in str(error.value)
