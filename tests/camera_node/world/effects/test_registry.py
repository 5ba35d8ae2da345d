"""Only what is listed is imported, made or computed."""

from __future__ import annotations

import dataclasses
import importlib
import pkgutil
import subprocess
import sys

import numpy as np
import pytest

from camera_node.world import effects as fx
from camera_node.world import make_scene

STREAM = """
import sys, tracemalloc
from pathlib import Path
import numpy as np
from camera_node.world import effects as fx, make_scene
from camera_node.world.cache import FrameCache

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
cache = FrameCache(scene, "cam01", 15, effects=effects, folder=folder)
sys.setprofile(count)
for k in range(12):
    cache.read(cache.content(k))
    effects.node_ns(k)
sys.setprofile(None)
held = tracemalloc.take_snapshot().filter_traces(
    [tracemalloc.Filter(True, "*world/effects/[a-z]*", all_frames=True)]).statistics("filename")
modules = sorted(m.rsplit(".", 1)[1] for m in sys.modules if m.startswith("camera_node.world.effects."))
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
    expected = "['sensor_noise'] ['sensor_noise'] True True"
    assert stream({"sensor_noise": {}}, str(tmp_path)) == expected


def test_nothing_listed_passes_everything_through_untouched():
    effects = fx.load_effects({}, lambda name: pytest.fail("no stream is asked for"))
    scene, image = make_scene("tile", {"width": 8, "height": 8}), np.zeros((8, 8, 3), np.uint8)
    assert effects is fx.NO_EFFECTS
    assert effects.extend(scene) is scene
    assert effects.apply(image, 3) is image
    assert effects.exposed(scene.render) == scene.render
    assert effects.node_ns(12345) == 12345


def test_every_file_is_registered_and_follows_the_protocol():
    on_disk = sorted(m.name for m in pkgutil.iter_modules(fx.__path__))
    assert sorted(fx.NAMES) == on_disk
    methods = {"world": "extend", "exposure": "expose", "image": "apply", "clock": "node_ns"}
    for name in fx.NAMES:
        cls = getattr(importlib.import_module(f"camera_node.world.effects.{name}"), fx._CLASSES[name])
        assert callable(getattr(cls, methods[cls.kind]))
        parameters = cls.Parameters()
        assert dataclasses.is_dataclass(parameters) and parameters.in_truth is False


def test_the_held_out_camera_shows_the_truth_unless_told_otherwise():
    listed = {"sensor_noise": {}, "occluder": {"in_truth": True}, "clock_drift": None}
    asked: list[str] = []

    def rng_for(name: str) -> np.random.Generator:
        asked.append(name)
        return np.random.default_rng(0)

    held_out = fx.load_effects(listed, rng_for, held_out=True)
    assert asked == ["occluder"]
    assert len(held_out.world) == 1 and not held_out.image and not held_out.clock
    assert fx.load_effects({"sensor_noise": {}}, rng_for, held_out=True) is fx.NO_EFFECTS
    training = fx.load_effects(listed, rng_for)
    assert len(training.world) == len(training.image) == len(training.clock) == 1


@pytest.mark.parametrize(
    ("listed", "message"),
    [
        (
            {"fog": {}},
            "unknown effect 'fog'; valid effects: clock_drift, motion_blur, occluder, sensor_noise",
        ),
        (
            {"sensor_noise": {"sigma": 1}},
            "effect sensor_noise.sigma: unknown key; expected one of read_noise",
        ),
        ({"motion_blur": {"exposure_ms": 0}}, "effect motion_blur: exposure_ms must be within"),
        ({"motion_blur": {"samples": 2.5}}, "whole number"),
        ({"occluder": {"period_s": "6 s"}}, "expected a number"),
        ({"clock_drift": {"drift_ppm": 1e9}}, "at most 100000 ppm"),
        ({"sensor_noise": {"read_noise_counts": -1}}, "cannot be negative"),
    ],
)
def test_an_effect_that_cannot_be_is_refused_in_one_line(listed, message):
    with pytest.raises(fx.EffectError, match=message) as error:
        fx.load_effects(listed, lambda name: np.random.default_rng(0))
    assert "\n" not in str(error.value)


def test_a_stream_of_its_own_for_each_effect():
    """What one effect draws does not depend on which others are listed."""

    def rng_for(name: str) -> np.random.Generator:
        return np.random.default_rng([1, *name.encode()])

    image = np.full((8, 8, 3), 128, np.uint8)
    alone = fx.load_effects({"sensor_noise": {}}, rng_for)
    among = fx.load_effects({"clock_drift": {}, "motion_blur": {}, "sensor_noise": {}}, rng_for)
    assert np.array_equal(alone.apply(image, 0), among.apply(image, 0))
