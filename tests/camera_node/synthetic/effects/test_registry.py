"""Only what is listed is imported, made or computed."""

from __future__ import annotations

import pkgutil
import subprocess
import sys

import numpy as np
import pytest

from camera_node.synthetic import effects as fx
from camera_node.synthetic import make_scene
from freshfield.geometry import Pose

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


def test_nothing_listed_passes_everything_through_untouched():
    effects = fx.load_effects({}, lambda name: pytest.fail("no stream is needed"))
    scene, image = make_scene("tile", {"width": 8, "height": 8}), np.zeros((8, 8, 3), np.uint8)
    assert effects is fx.NO_EFFECTS
    assert effects.extend(scene) is scene
    assert effects.apply(image, 3, 0.2) is image
    view, pose = scene.renderer("cam00"), Pose.from_matrix(scene.cameras["cam00"][1])
    assert effects.with_exposure(view) is view
    assert effects.node_ns(12345) == 12345
    assert effects.reported_lens(view.camera) is view.camera
    assert effects.reported_pose(pose, 3, 0.2) is pose and not effects.pose_varies


def test_every_file_is_registered_and_follows_the_protocol():
    on_disk = sorted(m.name for m in pkgutil.iter_modules(fx.__path__))
    assert sorted(fx.NAMES) == on_disk
    methods = {"lens": "rendered", "exposure": "expose", "image": "apply", "clock": "node_ns", "pose": "reported"}
    methods |= {"depth": "measure", "delay": "instant_s"}
    for name in fx.NAMES:
        cls = fx.effect_class(name)
        assert callable(getattr(cls().start(np.random.default_rng(0)), methods[cls.kind]))
        assert issubclass(cls, fx.EffectParameters) and cls().in_truth is False


def test_the_held_out_camera_shows_the_truth_unless_in_truth():
    listed = {"sensor_noise": {}, "lens_distortion": {"in_truth": True}, "clock_drift": None}
    asked: list[str] = []

    def rng_for(name: str) -> np.random.Generator:
        asked.append(name)
        return np.random.default_rng(0)

    held_out = fx.load_effects(listed, rng_for, held_out=True)
    assert asked == ["lens_distortion"]
    assert len(held_out.lens) == 1 and not held_out.image and not held_out.clock
    assert fx.load_effects({"sensor_noise": {}}, rng_for, held_out=True) is fx.NO_EFFECTS
    training = fx.load_effects(listed, rng_for)
    assert len(training.lens) == len(training.image) == len(training.clock) == 1


@pytest.mark.parametrize(
    ("listed", "message"),
    [
        ({"smoke": {}}, "unknown effect 'smoke'; valid effects: clock_drift, depth_sensor, exposure_drift, "),
        ({"sensor_noise": {"sigma": 1}}, "effect sensor_noise.sigma: unknown key; expected one of read_noise"),
        ({"motion_blur": {"exposure_ms": 0}}, "exposure_ms: expected .*1e-06 to 1000"),
        ({"pose_noise": {"correlation_s": 1e-9}}, "correlation_s must be 0 or at least 0.001"),
        ({"lens_distortion": {"calibrated": "no"}}, "lens_distortion.calibrated"),
    ],
)
def test_an_invalid_effect_is_refused_in_one_line(listed, message):
    with pytest.raises(fx.EffectError, match=message) as error:
        fx.load_effects(listed, lambda name: np.random.default_rng(0))
    assert "\n" not in str(error.value)


# Parameters with which an effect changes nothing.
NEUTRAL: dict[str, dict] = {
    "clock_drift": {},
    "depth_sensor": {},
    "exposure_drift": {"amplitude_stops": 0.0, "offset_spread_stops": 0.0},
    "lens_distortion": {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0},
    "motion_blur": {"samples": 1},
    "pose_delay": {"delay_ms": 0.0},
    "pose_noise": {"translation_mm": 0.0, "rotation_deg": 0.0},
    "sensor_noise": {"read_noise_counts": 0.0, "full_well_electrons": 0.0},
}


@pytest.mark.parametrize("name", sorted(NEUTRAL))
def test_an_effect_of_no_strength_changes_nothing(name):
    effects = fx.load_effects({name: NEUTRAL[name]}, lambda _: np.random.default_rng(3))
    scene = make_scene("room", {"width": 24, "height": 16, "supersample": 1, "count": 2})
    plain = scene.render("cam01", 0.4)
    changed = effects.extend(scene)
    image = effects.apply(effects.with_exposure(changed.renderer("cam01")).image(0.4), 6, 0.4)
    assert np.array_equal(image, plain)
    camera, matrix = changed.cameras["cam01"]
    assert effects.reported_lens(camera) == scene.cameras["cam01"][0]
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
    among = fx.load_effects({"clock_drift": {}, "motion_blur": {}, "sensor_noise": {}}, rng_for)
    assert np.array_equal(alone.apply(image, 0, 0.0), among.apply(image, 0, 0.0))


def test_an_effect_leaves_the_original_scene_as_it_is():
    scene = make_scene("room", {"width": 32, "height": 32, "supersample": 1})
    cameras, before = scene.cameras, scene.render("cam01", 0.4)
    changed = fx.load_effects({"lens_distortion": {}}, lambda _: np.random.default_rng(0)).extend(scene)
    assert not np.array_equal(changed.render("cam01", 0.4), before)
    assert scene.cameras is cameras and np.array_equal(scene.render("cam01", 0.4), before)
