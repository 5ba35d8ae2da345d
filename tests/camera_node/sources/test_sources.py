"""Sources as the node uses them: opened from a scenario, asked for ticks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from camera_node.capture import build_cameras, prepare
from camera_node.settings import source_config
from camera_node.sources.datasets.records import DatasetError
from camera_node.sources.registry import open_sources
from freshfield.scenario import ScenarioError, parse
from tests.camera_node.sources.datasets.photos import edited, opencv_pose, photo_scenario, picture, write_photos
from tests.support import small_world


def opened(scenario, cameras=None, data: Path | None = None):
    return open_sources(scenario, source_config(scenario), cameras or scenario.cameras, data)


def test_photos_are_streamed_as_moving_cameras(tmp_path):
    sources = opened(photo_scenario(write_photos(tmp_path, 24), cameras=3, fps=5))
    held_out, first = sources["cam00"], sources["cam01"]
    assert first.fps == 5 and held_out.contents == 3 and first.contents == 11
    for tick, index in ((0, 0), (1, 8), (2, 16), (3, 8), (4, 0)):
        shot = held_out.read(held_out.content(tick))
        np.testing.assert_array_equal(shot.image, picture(index)[..., ::-1])
        np.testing.assert_allclose(shot.pose.matrix(), opencv_pose(index), atol=1e-9)
    np.testing.assert_array_equal(first.read(first.content(1)).image, picture(3)[..., ::-1])


def test_a_recording_is_assigned_by_name(tmp_path):
    data = write_photos(tmp_path, 6, cameras=3)
    source = opened(photo_scenario(data, 3, fps=20), ["cam02"])["cam02"]
    # Recorded at 10 a second, captured at 20: every frame is seen twice.
    assert [source.content(k) for k in range(0, 8)] == [0, 1, 1, 2, 2, 3, 3, 4]
    np.testing.assert_array_equal(source.read(1).image, picture(13)[..., ::-1])
    other = opened(photo_scenario(data, 3, assignment={"cam00": "cam02", "cam02": "cam00"}), ["cam00"])
    np.testing.assert_array_equal(other["cam00"].read(1).image, picture(13)[..., ::-1])
    for count, assignment, message in (
        (4, {}, r"no camera 'cam03'.*cam00, cam01, cam02"),
        (3, {"cam09": "cam00"}, r"assignment\.cam09"),
        (3, {"cam01": "cam00"}, "more than one camera shows cam00"),
    ):
        with pytest.raises(ScenarioError, match=message):
            opened(photo_scenario(data, count, assignment=assignment))


@pytest.mark.parametrize(("fps", "time_unit_s"), [(0, 1.0), (1e9, 1.0), (None, 1e308), (None, 1e-320)])
def test_an_impossible_rate_of_a_recording_is_named(fps, time_unit_s, tmp_path):
    data = edited(
        write_photos(tmp_path, 3, cameras=2),
        lambda d: [frame.update(time=frame["time"] * time_unit_s) for frame in d["frames"]],
        fps=fps,
    )
    with pytest.raises(DatasetError, match=r"transforms\.json: recorded .* expected 0\.01 to 1000"):
        opened(photo_scenario(data, 2))


def test_a_jpeg_of_the_right_size_is_sent_as_it_lies(tmp_path):
    data = write_photos(tmp_path, 8, suffix=".jpg")
    source = opened(photo_scenario(data, 2, codec="jpeg"), ["cam01"])["cam01"]
    assert source.read(4).image == (tmp_path / "images/005.jpg").read_bytes()
    shrunk = opened(photo_scenario(data, 2, codec="jpeg", scale=2), ["cam01"])["cam01"]
    assert not isinstance(shrunk.read(4).image, bytes) and shrunk.intrinsics.width == 16


def test_noise_makes_every_tick_its_own_and_spares_the_truth(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    noise = {"sensor_noise": {"read_noise_counts": 4.0}}
    recorded = photo_scenario(write_photos(tmp_path / "data", 24), 3, effects=noise)
    world = small_world(codec="png", effects=noise)
    cameras = {"count": 3, "held_out": ["cam00"]}
    for scenario in (recorded, parse({"cameras": cameras, "source": world}, Path("world.yaml"))):
        truth, noisy = build_cameras(scenario, source_config(scenario), ["cam00", "cam01"])
        prepare([truth, noisy], lambda: False)
        assert truth.cached(3) is not None and noisy.cached(3) is None
        one, again, later = noisy.capture(3), noisy.capture(3), noisy.capture(3 + 10**6 * 7920)
        assert one.payload == again.payload != later.payload, "the noise belongs to the tick"
