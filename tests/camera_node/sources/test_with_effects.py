"""Effects from a scenario to the wire: what a frame shows, and what it claims."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from camera_node.capture import Camera, build_cameras
from camera_node.settings import source_config
from camera_node.synthetic.effects import NAMES
from freshfield import payload
from freshfield.geometry import Pose
from freshfield.scenario import ScenarioError, parse
from tests.camera_node.sources.datasets.photos import opencv_pose, photo_scenario, picture, write_photos
from tests.support import small_world


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def cameras(effects: dict[str, Any], count: int = 3, scene: str = "tower", seed: int = 5) -> dict[str, Camera]:
    source = small_world(scene=scene, width=24, height=16, fps=10, codec="zstd", effects=effects)
    top = {"seed": seed, "cameras": {"count": count, "held_out": ["cam00"]}, "source": source}
    scenario = parse(top, Path("world.yaml"))
    return {c.name: c for c in build_cameras(scenario, source_config(scenario), scenario.cameras)}


@pytest.mark.parametrize("name", sorted(set(NAMES) - {"clock_drift", "depth_sensor", "pose_delay"}))
def test_an_effect_reaches_the_frames_but_not_the_truth(name):
    """Deterministic by the seed, whoever else is there; in_truth reaches the held-out camera, too."""
    plain, affected, truth = cameras({}), cameras({name: {}}), cameras({name: {"in_truth": True}})
    fewer = cameras({name: {}}, count=2)

    def frames(camera: Camera) -> list[tuple[bytes, Pose]]:
        shots = [camera.capture(tick) for tick in (0, 7, 123_456)]
        return [(s.payload, s.pose) for s in shots]

    assert frames(affected["cam00"]) == frames(plain["cam00"])
    assert frames(affected["cam01"]) != frames(plain["cam01"])
    assert frames(truth["cam00"]) != frames(plain["cam00"])
    assert frames(truth["cam01"]) == frames(affected["cam01"]) == frames(fewer["cam01"])


def test_a_depth_sensor_measures_with_every_camera_but_the_held_out_one_and_changes_no_image():
    plain, found, fewer = cameras({}), cameras({"depth_sensor": {}}), cameras({"depth_sensor": {}}, count=2)

    def depth(camera: Camera) -> np.ndarray | None:
        measured = camera.source.depth(3, camera.source.read(3))
        return None if measured is None else measured.counts

    assert depth(plain["cam01"]) is None and depth(found["cam00"]) is None
    first = depth(found["cam01"])
    assert first is not None and first.shape == (16, 24) and first.any()
    assert np.array_equal(first, depth(fewer["cam01"])) and not np.array_equal(first, depth(found["cam02"]))
    found["cam01"].source.release()
    assert np.array_equal(first, depth(found["cam01"]))
    assert found["cam01"].capture(3) == plain["cam01"].capture(3)
    assert found["cam01"].source.key() == plain["cam01"].source.key(), "rendered frames are found again"


def test_a_bumped_camera_shows_another_view_from_then_on_and_reports_its_old_pose():
    bump = {"at_s": 1.0, "pitch_deg": 1.0, "cameras": ["cam01"]}
    found, plain = cameras({"bump": bump, "depth_sensor": {}}), cameras({"depth_sensor": {}})

    def made(camera: Camera, tick: int) -> tuple[Any, ...]:
        shot = camera.source.read(tick)
        return shot.image, camera.source.depth(tick, shot).counts.tobytes(), shot.pose

    turned, stood = made(found["cam01"], 10), made(plain["cam01"], 10)
    assert turned[0] != stood[0] and turned[1] != stood[1] and turned[2] == stood[2]
    assert made(found["cam02"], 10) == made(plain["cam02"], 10)
    again = plain["cam01"].source.contents
    assert made(found["cam01"], again + 9)[0] != made(plain["cam01"], 9)[0], "it stays turned"
    assert made(found["cam01"], 9) == made(plain["cam01"], 9), "in any order"


def test_a_wrong_pose_is_claimed_of_the_right_image():
    found = cameras({"pose_noise": {"translation_mm": 20.0, "rotation_deg": 1.0}})["cam01"]
    plain = cameras({})["cam01"]
    again = plain.source.contents
    assert found.source.contents is None and again is not None
    shots = [found.capture(k) for k in (3, 3 + again)]
    assert shots[0].payload == shots[1].payload == plain.capture(3).payload
    assert len({shots[0].pose, shots[1].pose, plain.capture(3).pose}) == 3
    bias = {"translation_mm": 0.0, "rotation_deg": 0.0, "translation_bias_mm": 20.0}
    wrong = cameras({"pose_noise": bias})["cam01"]
    assert wrong.source.contents == again, "a wrong calibration costs nothing more"
    assert wrong.capture(1).pose == wrong.capture(99).pose != plain.capture(1).pose


def test_recordings_stand_where_they_stood_and_are_sent_as_they_lie_with_a_wrong_pose(tmp_path):
    data = write_photos(tmp_path, 24)
    for name in ("bump", "pose_delay"):
        scenario = photo_scenario(data, 3, effects={name: None})
        with pytest.raises(ScenarioError, match="kinds delay and mount need source kind world"):
            build_cameras(scenario, source_config(scenario), scenario.cameras)
    scenario = photo_scenario(data, cameras=3, fps=5, effects={"pose_noise": {}})
    truth, wrong = build_cameras(scenario, source_config(scenario), ["cam00", "cam01"])
    shot = wrong.capture(1)
    np.testing.assert_array_equal(payload.decode(shot.payload, "png", 32, 24), picture(3)[..., ::-1])
    assert not np.allclose(shot.pose.matrix(), opencv_pose(3), atol=1e-6)
    assert np.allclose(shot.pose.matrix(), opencv_pose(3), atol=0.3)
    np.testing.assert_allclose(truth.capture(1).pose.matrix(), opencv_pose(8), atol=1e-9)
