"""Sources as the node uses them: opened from a scenario, asked for ticks."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from camera_node.capture import build_cameras, prepare
from camera_node.settings import source_config
from camera_node.sources.datasets.records import DatasetError
from camera_node.sources.registry import open_sources
from freshfield import payload
from freshfield.scenario import ScenarioError, parse
from tests.camera_node.sources.datasets.photos import opencv_pose, photo_scenario, picture, write_photos
from tests.conftest import data_dir


def opened(scenario, cameras=None, data: Path | None = None):
    return open_sources(scenario, source_config(scenario), cameras or scenario.cameras, data)


def rgb(shot, codec="png"):
    if isinstance(shot.image, bytes):
        return payload.decode(shot.image, codec, shot.intrinsics.width, shot.intrinsics.height)
    return shot.image


def test_photos_are_streamed_as_moving_cameras(tmp_path):
    sources = opened(photo_scenario(write_photos(tmp_path, 24), cameras=3, fps=5))
    held_out, first = sources["cam00"], sources["cam01"]
    assert first.fps == 5 and held_out.contents == 3 and first.contents == 11
    for tick, index in ((0, 0), (1, 8), (2, 16), (3, 8), (4, 0)):
        shot = held_out.read(held_out.content(tick))
        np.testing.assert_array_equal(rgb(shot), picture(index)[..., ::-1])
        np.testing.assert_allclose(shot.pose.matrix(), opencv_pose(index), atol=1e-9)
    np.testing.assert_array_equal(rgb(first.read(first.content(1))), picture(3)[..., ::-1])


def test_a_recording_is_assigned_by_name(tmp_path):
    data = write_photos(tmp_path, 6, cameras=3)
    source = opened(photo_scenario(data, 3, fps=20), ["cam02"])["cam02"]
    # Recorded at 10 a second, captured at 20: every frame is seen twice.
    assert [source.content(k) for k in range(0, 8)] == [0, 1, 1, 2, 2, 3, 3, 4]
    np.testing.assert_array_equal(rgb(source.read(1)), picture(13)[..., ::-1])
    other = opened(photo_scenario(data, 3, assignment={"cam00": "cam02", "cam02": "cam00"}), ["cam00"])
    np.testing.assert_array_equal(rgb(other["cam00"].read(1)), picture(13)[..., ::-1])


@pytest.mark.parametrize(
    ("fps", "time_unit_s"), [(-1, 1.0), (0, 1.0), (1e-300, 1.0), (1e9, 1.0), (None, 1e308), (None, 1e-320)]
)
def test_an_impossible_rate_of_a_recording_is_named(fps, time_unit_s, tmp_path):
    data = write_photos(tmp_path, 3, cameras=2, **({} if fps is None else {"fps": fps}))
    written = json.loads(data.read_text())
    for frame in written["frames"]:
        frame["time"] *= time_unit_s
    data.write_text(json.dumps(written))
    with pytest.raises(DatasetError, match=r"transforms\.json: recorded .* expected 0\.01 to 1000"):
        opened(photo_scenario(data, 2))


def test_wrong_assignments_are_named(tmp_path):
    data = write_photos(tmp_path, 6, cameras=3)
    with pytest.raises(ScenarioError, match=r"no camera 'cam03'.*cam00, cam01, cam02"):
        opened(photo_scenario(data, 4))
    with pytest.raises(ScenarioError, match=r"assignment\.cam09"):
        opened(photo_scenario(data, 3, assignment={"cam09": "cam00"}))
    with pytest.raises(ScenarioError, match="more than one camera shows cam00"):
        opened(photo_scenario(data, 3, assignment={"cam01": "cam00"}))


def test_a_jpeg_of_the_right_size_is_sent_as_it_lies(tmp_path):
    folder = data_dir("blender_kitchen")
    scenario = photo_scenario(folder / "transforms.json", 2, codec="jpeg", fps=30)
    source = opened(scenario, ["cam01"])["cam01"]
    assert source.read(5).image == (folder / "images/cam01/0005.jpg").read_bytes()
    shrunk = opened(photo_scenario(folder / "transforms.json", 2, codec="jpeg", scale=2), ["cam01"])["cam01"]
    assert not isinstance(shrunk.read(5).image, bytes) and shrunk.intrinsics.width == 96


def world_scenario(**source):
    section = {"kind": "world", "scene": "room", "width": 24, "height": 16, "fps": 10, **source}
    return parse({"cameras": {"count": 3, "held_out": ["cam00"]}, "source": section}, Path("world.yaml"))


def test_noise_makes_every_tick_its_own_and_spares_the_truth(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    recorded = photo_scenario(
        write_photos(tmp_path / "data", 24), 3, effects={"sensor_noise": {"read_noise_counts": 4.0}}
    )
    for scenario in (recorded, world_scenario(codec="png", effects={"sensor_noise": None})):
        truth, noisy = build_cameras(scenario, source_config(scenario), ["cam00", "cam01"])
        assert truth.source.contents is not None and noisy.source.contents is None
        prepare([truth, noisy], lambda: False)
        assert truth.cached(3) is not None and noisy.cached(3) is None
        one, again, later = noisy.capture(3), noisy.capture(3), noisy.capture(3 + 10**6 * 7920)
        assert one.payload == again.payload  # the noise belongs to the tick
        assert one.payload != later.payload
