"""Recorded sets as views: which file, which instant, who is held out, and errors for people."""

from __future__ import annotations

import json

import numpy as np
import pytest

from camera_node.sources.datasets.records import DatasetError
from edge_server.experiments.scenes.recorded import load_recorded
from tests.conftest import data_dir
from tests.edge_server.experiments.sets import write_photos, write_recording


@pytest.mark.parametrize(("holdout", "numbers"), [("4", (0, 4, 8)), ("001, ./images/003", (1, 3)), ("0", ())])
def test_every_kth_view_or_named_ones_or_none_are_held_out(tmp_path, holdout, numbers):
    write_photos(tmp_path, 9)
    found = load_recorded(tmp_path, holdout)
    assert [v.camera for v in found.held_out] == [f"images/{n:03d}" for n in numbers]
    assert len(found.training) == 9 - len(numbers) and found.file.name == "transforms_train.json"


def test_a_moving_set_is_one_instant_of_each_camera(tmp_path):
    write_recording(tmp_path)
    first, last = (load_recorded(tmp_path, "cam00", frame=k) for k in (0, 2))
    assert [v.camera for v in first.held_out] == ["cam00"] and len(first.training) == 4
    assert last.instant == "frame 2 of 3"
    assert not np.array_equal(first.held_out[0].image, last.held_out[0].image)
    with pytest.raises(DatasetError, match="frames 0 to 2"):
        load_recorded(tmp_path, "cam00", frame=3)


def test_alpha_is_kept_and_scale_shrinks_image_and_lens_alike(tmp_path):
    write_photos(tmp_path, 3, size=32, alpha=True)
    view = load_recorded(tmp_path, "0", scale=2).training[0]
    assert view.image.shape == (16, 16, 4)
    assert (view.intrinsics.width, view.intrinsics.height) == (16, 16)


def test_of_several_files_the_first_whose_images_exist_is_read(tmp_path):
    path = write_photos(tmp_path, 3)
    missing = json.loads(path.read_text())
    for frame in missing["frames"]:
        frame["file_path"] += "-nowhere"
    (tmp_path / "transforms.json").write_text(json.dumps(missing))
    assert load_recorded(tmp_path, "0").file == path


@pytest.mark.parametrize(
    ("holdout", "message"), [("nobody", "no image or camera 'nobody'"), ("1", "none is left to train on")]
)
def test_a_holdout_that_cannot_work_is_said(tmp_path, holdout, message):
    write_photos(tmp_path, 3)
    with pytest.raises(DatasetError, match=message):
        load_recorded(tmp_path, holdout)


def test_missing_folder_and_empty_folder_are_said(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "transforms.json").write_text("{")
    for folder, said in (
        ("nowhere", "no such file or folder"),
        ("empty", r"expected transforms\.json"),
        (".", "cannot be read as JSON"),
    ):
        with pytest.raises(DatasetError, match=said):
            load_recorded(tmp_path / folder)


@pytest.mark.parametrize(
    ("name", "holdout", "scale", "training", "held_out"),
    [
        ("lego_synthetic", "8", 2, 87, 13),
        ("fox", "8", 4, 43, 7),
        ("blender_kitchen", "cam00", 1, 18, 1),
        ("pose2sim_single_person", "cam01", 4, 3, 1),
    ],
)
def test_real_sets(name, holdout, scale, training, held_out):
    found = load_recorded(data_dir(name), holdout, scale)
    assert (len(found.training), len(found.held_out)) == (training, held_out)
    for view in found.training:
        assert view.image.shape[:2] == (view.intrinsics.height, view.intrinsics.width)
