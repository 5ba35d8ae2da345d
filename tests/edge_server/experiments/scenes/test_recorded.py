"""Recorded sets and captures of carried cameras as views: which instant, who is held out, errors for people."""

import json
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml

from camera_node.sources.datasets.records import DatasetError
from camera_node.sources.datasets.transforms import load_dataset
from edge_server.experiments.common.arguments import OptionError
from edge_server.experiments.scenes import captures
from edge_server.experiments.scenes.multiview_still import open_still, score_views
from edge_server.experiments.scenes.recorded import load_recorded
from edge_server.fidelity.scorer import Scorer
from edge_server.fields import View
from freshfield.geometry import Pinhole
from tests.conftest import case_dir
from tests.edge_server.experiments.sets import write_photos, write_recording
from tests.support import refused


@pytest.mark.parametrize(
    ("holdout", "numbers"), [("4", (0, 4, 8)), ("001, ./images/003", (1, 3)), ("0", ()), ("001", (1,))]
)
def test_every_kth_view_or_named_ones_or_none_are_held_out(tmp_path, holdout, numbers):
    write_photos(tmp_path, 9)
    found = load_recorded(tmp_path, holdout)
    assert [v.camera for v in found.held_out] == [f"images/{n:03d}" for n in numbers]
    assert len(found.training) == 9 - len(numbers) and found.file.name == "transforms_train.json"
    for none, message in (("nobody", "no image or camera 'nobody'"), ("1", "none is left to train on")):
        refused(DatasetError, message, load_recorded, tmp_path, none)


def test_the_datas_own_test_images_are_held_out_and_never_trained_on(tmp_path):
    file = write_photos(tmp_path, 9)
    data = json.loads(file.read_text())
    own = [frame["file_path"] for frame in data["frames"][1:3]]
    file.write_text(json.dumps({**data, "test_filenames": own}))
    names = [f"images/{k:03d}" for k in (1, 2)]
    for holdout in (None, "split"):
        found = load_recorded(tmp_path, holdout)
        assert [v.camera for v in found.held_out] == names and len(found.training) == 7
    for holdout, kept in (("4", 4), ("0", 7), ("images/005", 6)):
        assert len(load_recorded(tmp_path, holdout).training) == kept


def test_an_instant_of_cameras_of_different_rates_is_one_of_time(tmp_path):
    file = write_recording(tmp_path)
    data = json.loads(file.read_text())
    late = [frame for frame in data["frames"] if frame["camera"] == "cam01"]
    data["frames"].remove(late[0])  # cam01 began a frame later: that one is the first
    file.write_text(json.dumps(data))
    instants = sorted({frame["time"] for frame in data["frames"]})
    shown = load_recorded(tmp_path, "0")
    assert shown.instant == "frame 0 of 2"
    (view,) = [v for v in shown.training if v.camera == "cam01"]
    records = [r for r in load_dataset(file) if r.camera == "cam01" and r.time_s == pytest.approx(instants[1])]
    assert np.array_equal(view.image, records[0].read())
    case = load_recorded(case_dir("04-fit-videos-of-different-rates"), "cam02", frame=15)
    greens = {v.camera: float(v.image[:, -v.image.shape[1] // 3 :, 1].mean()) for v in (*case.training, *case.held_out)}
    assert case.instant == "frame 15 of 20"
    assert {c: round((g - 10) / 8) for c, g in greens.items()} == {"cam01": 30, "cam02": 15, "cam03": 15}


@pytest.mark.parametrize("masked", [0.0, 0.9])
def test_masked_pixels_are_not_scored(masked):
    truth = np.full((64, 32, 3), 100, np.uint8)
    rendering = np.full((64, 32, 3), 110 / 255, np.float32)
    rendering[32:] = masked
    weight = np.ones((64, 32), np.float32)
    weight[32:] = 0.5
    whole = View("a", truth, np.eye(4), Pinhole(32, 64, 30.0, 30.0, 16.0, 32.0))

    class Renders:
        def render(self, *_):
            return SimpleNamespace(color=rendering)

    score, _ = score_views(Renders(), [replace(whole, weight=weight)], Scorer())
    part = Scorer().score("a", rendering[:32], 0, truth[:32], 0)
    assert score.psnr_db == score.psnr_still_db == pytest.approx(20 * np.log10(255 / 10), abs=0.01)
    assert score.ssim == pytest.approx(part.ssim, abs=1e-9)


def test_images_of_which_masks_leave_nothing_are_said_and_not_used(tmp_path):
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros((32, 32), np.uint8))
    write_photos(tmp_path, 4, 32, more=lambda k: {"mask_path": "black.png"} if k >= 2 else {})
    found = load_recorded(tmp_path, "3")
    assert (len(found.training), len(found.held_out)) == (1, 1)
    assert found.notes[-1].startswith("masks leave nothing of 2 images, first ")
    write_photos(tmp_path, 4, 32, more=lambda k: {"mask_path": "black.png"})
    refused(DatasetError, "masks leave nothing of the training images", load_recorded, tmp_path, "2")


@pytest.mark.stability
def test_damaged_depth_costs_only_the_depth_of_its_view(tmp_path):
    write_photos(tmp_path, 4, 32, more=lambda k: {"depth_file_path": f"{k}.png"})
    for k in range(4):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.full((32, 32), 2000, np.uint16))
    assert not load_recorded(tmp_path, "0").notes
    (tmp_path / "1.png").write_bytes((tmp_path / "1.png").read_bytes()[:40])
    cv2.imwrite(str(tmp_path / "2.png"), np.full((32, 32), 3, np.uint16))  # 3 mm: another unit
    found = load_recorded(tmp_path, "0")
    assert [view.depth is None for view in found.training] == [False, True, True, False]
    assert found.training[0].depth == pytest.approx(np.full((32, 32), 2.0))
    (note,) = found.notes
    assert note.startswith("the depth of 2 images cannot be used, first images/001: ") and "1.png" in note


FRAMES = 20


def _scenario(folder, **source):
    file = folder / "mine.yaml"
    cameras = {"ids": ["hand", "kept"], "held_out": ["kept"], "held_out_every": 4}
    file.write_text(yaml.safe_dump({"cameras": cameras, "source": source}))
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


@pytest.mark.stability
def test_what_cannot_be_used_is_said_and_costs_nothing_else(tmp_path):
    file = _video(tmp_path, range(5, FRAMES))
    found = open_still(file, "0")
    assert [round(view.camera_to_world[0, 3]) for view in found.training] == list(range(5, FRAMES))
    assert "5 captures cannot be read whole, first hand/0000: the nearest pose" in found.notes[0]
    refused(OptionError, "says its scale", open_still, file, scale=2.0)
    (tmp_path / "poses.txt").write_text("100 0 0 0 0 0 0 1\n")
    refused(DatasetError, "files.hand: no frame is within max_gap_ms of a pose: give .* start_s", open_still, file)
    with pytest.raises(DatasetError, match=r"film.mp4: its lens and poses are not known: .* --like video"):
        open_still(tmp_path / "film.mp4")
    refused(DatasetError, "one training camera", open_still, _scenario(tmp_path, kind="world", scene="room"))
    refused(DatasetError, r"mine\.yaml", open_still, _scenario(tmp_path, kind="video", data="none.mp4"))


def test_a_rate_above_the_recordings_gives_each_image_once(monkeypatch):
    shot = SimpleNamespace(pose=SimpleNamespace(matrix=lambda: np.eye(4)), intrinsics=Pinhole.from_fov(8, 6, 60.0))
    source = SimpleNamespace(camera="hand", fps=60.0, repeats_after=12, read=lambda content: shot, release=list)
    source.content = lambda tick: (tick // 2) % 5
    monkeypatch.setattr(captures, "pixels", lambda shot, codec: np.zeros((6, 8, 3), np.uint8))
    found, wrong = captures._views(source, SimpleNamespace(codec="jpeg", depth_every=None))
    assert list(found) == [f"hand/{k:04d}" for k in range(5)] and not wrong  # then it begins again
