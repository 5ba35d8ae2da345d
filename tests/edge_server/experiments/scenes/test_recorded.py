"""Recorded sets as views: which file, which instant, who is held out, and errors for people."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from camera_node.sources.datasets.records import DatasetError
from camera_node.sources.datasets.transforms import load_dataset
from edge_server.experiments.scenes.multiview_still import score_views
from edge_server.experiments.scenes.recorded import load_recorded
from edge_server.fidelity.scorer import Scorer
from edge_server.fields import View
from freshfield.geometry import Pinhole
from tests.conftest import case_dir
from tests.edge_server.experiments.sets import write_photos, write_recording


@pytest.mark.parametrize(("holdout", "numbers"), [("4", (0, 4, 8)), ("001, ./images/003", (1, 3)), ("0", ())])
def test_every_kth_view_or_named_ones_or_none_are_held_out(tmp_path, holdout, numbers):
    write_photos(tmp_path, 9)
    found = load_recorded(tmp_path, holdout)
    assert [v.camera for v in found.held_out] == [f"images/{n:03d}" for n in numbers]
    assert len(found.training) == 9 - len(numbers) and found.file.name == "transforms_train.json"


@pytest.mark.parametrize(
    ("holdout", "message"), [("nobody", "no image or camera 'nobody'"), ("1", "none is left to train on")]
)
def test_a_holdout_that_cannot_work_is_said(tmp_path, holdout, message):
    write_photos(tmp_path, 3)
    with pytest.raises(DatasetError, match=message):
        load_recorded(tmp_path, holdout)


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
    file = write_photos(tmp_path, 4, 32)
    data = json.loads(file.read_text())
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros((32, 32), np.uint8))
    for frame in data["frames"][2:]:
        frame["mask_path"] = "black.png"
    file.write_text(json.dumps(data))
    found = load_recorded(tmp_path, "3")
    assert (len(found.training), len(found.held_out)) == (1, 1)
    assert found.notes[-1].startswith("masks leave nothing of 2 images, first ")
    for frame in data["frames"]:
        frame["mask_path"] = "black.png"
    file.write_text(json.dumps(data))
    with pytest.raises(DatasetError, match="masks leave nothing of the training images"):
        load_recorded(tmp_path, "2")


@pytest.mark.stability
def test_damaged_depth_costs_only_the_depth_of_its_view(tmp_path):
    file = write_photos(tmp_path, 4, 32)
    data = json.loads(file.read_text())
    for k, frame in enumerate(data["frames"]):
        frame["depth_file_path"] = f"{k}.png"
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.full((32, 32), 2000, np.uint16))
    file.write_text(json.dumps(data))
    assert not load_recorded(tmp_path, "0").notes
    (tmp_path / "1.png").write_bytes((tmp_path / "1.png").read_bytes()[:40])
    cv2.imwrite(str(tmp_path / "2.png"), np.full((32, 32), 3, np.uint16))  # 3 mm: another unit
    found = load_recorded(tmp_path, "0")
    assert [view.depth is None for view in found.training] == [False, True, True, False]
    assert found.training[0].depth == pytest.approx(np.full((32, 32), 2.0))
    (note,) = found.notes
    assert note.startswith("the depth of 2 images cannot be used, first images/001: ") and "1.png" in note
