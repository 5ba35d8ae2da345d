"""The captures of a scenario's carried camera as views of a fit."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import yaml

from camera_node.sources.datasets.records import DatasetError
from edge_server.experiments.common.arguments import OptionError
from edge_server.experiments.scenes.multiview_still import open_still
from tests.edge_server.experiments.sets import write_photos

FRAMES = 20
CAMERAS = {"ids": ["hand", "kept"], "held_out": ["kept"], "held_out_every": 4}


def _scenario(folder, cameras=None, **source):
    file = folder / "mine.yaml"
    file.write_text(yaml.safe_dump({"cameras": cameras or CAMERAS, "source": source}))
    return file


def _video(folder, poses=range(FRAMES), **more):
    """A film of 10 frames a second whose frame k is 16 + 10 k bright, at k meters."""
    writer = cv2.VideoWriter(str(folder / "film.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (64, 48))
    for k in range(FRAMES):
        writer.write(np.full((48, 64, 3), 16 + 10 * k, np.uint8))
    writer.release()
    (folder / "poses.txt").write_text("".join(f"{k / 10} {k} 0 0 0 0 0 1\n" for k in poses))
    trajectory = {"files": {"hand": "poses.txt"}, "max_gap_ms": 20}
    keys = {"data": "film.mp4", "horizontal_fov_deg": 60, "trajectory": trajectory, **more}
    return _scenario(folder, kind="video", **keys)


def test_a_video_with_its_trajectory_is_a_scan_with_times(tmp_path):
    found = open_still(_video(tmp_path))
    assert found.carried and found.timed and not found.notes and found.name == "mine"
    assert [v.camera for v in found.held_out] == [f"hand/{k:04d}" for k in range(0, FRAMES, 4)]
    for view in (*found.training, *found.held_out):
        k = int(view.camera.removeprefix("hand/"))
        assert view.generated_ns == k * 100_000_000 and view.camera_to_world[0, 3] == k
        assert view.image.mean() == pytest.approx(16 + 10 * k, abs=4.9)
    (tmp_path / "film.yaml").write_text((tmp_path / "mine.yaml").read_text())
    assert len(open_still(tmp_path / "film.yaml", "0").held_out) == 0


def test_photos_have_no_times_and_bring_no_depth_unless_they_have_some(tmp_path):
    write_photos(tmp_path, 9)
    found = open_still(_scenario(tmp_path, kind="transforms", data="transforms_train.json"))
    assert found.carried and not found.timed and len(found.held_out) == 3
    assert all(view.depth is None for view in found.training)


@pytest.mark.stability
def test_what_cannot_be_used_is_said_and_costs_nothing_else(tmp_path):
    file = _video(tmp_path, range(5, FRAMES))
    found = open_still(file, "0")
    assert [round(view.camera_to_world[0, 3]) for view in found.training] == list(range(5, FRAMES))
    assert "5 captures cannot be read whole, first hand/0000: the nearest pose" in found.notes[0]
    with pytest.raises(OptionError, match="says its scale"):
        open_still(file, scale=2.0)
    (tmp_path / "poses.txt").write_text("100 0 0 0 0 0 0 1\n")
    with pytest.raises(DatasetError, match="none of its captures can be used"):
        open_still(file)
    with pytest.raises(DatasetError, match=r"film.mp4: its lens and poses are not known: .* --like video"):
        open_still(tmp_path / "film.mp4")
    with pytest.raises(DatasetError, match="one training camera"):
        open_still(_scenario(tmp_path, kind="world", scene="room"))
    with pytest.raises(DatasetError, match=r"mine\.yaml"):
        open_still(_scenario(tmp_path, kind="video", data="none.mp4"))
