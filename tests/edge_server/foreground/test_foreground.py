from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edge_server.config import read_config
from edge_server.experiments.virtual.from_scenario import build_deployment
from edge_server.experiments.virtual.virtual_deployment import RunSettings
from edge_server.foreground import ForegroundConfig, ForegroundError, read_foreground
from edge_server.foreground.foreground import make_foreground
from freshfield.scenario import ScenarioError, load, parse
from tests.conftest import data_dir
from tests.edge_server.foreground.pictures import (
    box_of,
    disc,
    iou,
    save_endless_loop,
    save_memory_bomb,
    save_orange_detector,
    save_segmenter,
)
from tests.work import MOST_MS, work_ms


def needs_onnx() -> None:
    for module in ("onnx", "onnxruntime"):
        pytest.importorskip(module, reason="needs ONNX Runtime: pip install -e '.[embed]'")


def test_grabcut_finds_what_the_box_alone_does_not():
    picture, truth = disc()
    found = {}
    for segment in ("box", "grabcut"):
        cut = make_foreground(ForegroundConfig(box=box_of(truth), segment=segment))
        rgba, _ = cut.apply("cam00", picture)
        found[segment] = iou(rgba[..., 3] == 255, truth)
        assert cut.counts.masked == 1
        kept = rgba[..., 3] == 255
        assert np.array_equal(rgba[kept][:, :3], picture[kept])
        assert not rgba[rgba[..., 3] == 0].any(), "what is transparent has no color either"
    assert found["grabcut"] > 0.95 > found["box"]


def test_the_same_picture_gives_the_same_mask_whatever_came_before():
    picture, truth = disc(seed=3)
    other, _ = disc(seed=4, centre=(40, 40))
    config = ForegroundConfig(box=box_of(truth))
    first = make_foreground(config).apply("cam00", picture)[0]
    second = make_foreground(config)
    second.apply("cam00", other)
    assert np.array_equal(second.apply("cam00", picture)[0], first)


def test_a_smaller_side_still_gives_a_mask_of_the_pictures_size():
    picture, truth = disc(384, 512, (200, 280), 90)
    cut = make_foreground(ForegroundConfig(box=box_of(truth, 10), side=64))
    rgba, _ = cut.apply("cam00", picture)
    assert rgba.shape == (384, 512, 4)
    assert iou(rgba[..., 3] == 255, truth) > 0.9


def test_boxes_of_cameras():
    picture, truth = disc()
    cut = make_foreground(ForegroundConfig(boxes={"cam00": box_of(truth)}))
    assert cut.apply("cam00", picture)[0].shape[2] == 4
    assert cut.apply("cam01", picture)[0] is picture
    assert cut.counts.not_detected == 1


def test_what_is_cut_out_within_the_box_supervises_as_much_as_it_is_trusted():
    picture, truth = disc()
    left, top, right, bottom = box_of(truth)
    for doubt in (0.0, 0.4):
        rgba, weight = make_foreground(ForegroundConfig(box=(left, top, right, bottom), doubt=doubt)).apply(
            "cam00", picture
        )
        assert weight.dtype == np.float32 and (weight[rgba[..., 3] > 0] == 1.0).all()
        inside = np.zeros(truth.shape, bool)
        inside[round(top * 96) : round(bottom * 96), round(left * 128) : round(right * 128)] = True
        assert (weight[~inside] == 1.0).all(), "outside of the box nothing is doubted"
        assert (weight[inside & (rgba[..., 3] == 0)] == np.float32(doubt)).all()
    assert make_foreground(ForegroundConfig(box=box_of(truth), doubt=1.0)).apply("cam00", picture)[1] is None


def test_the_loop_fits_to_cut_views(tmp_path):
    """From the scenario to what the field is given, in virtual time."""
    data = {
        "name": "cut",
        "seed": 3,
        "cameras": {"count": 3, "held_out": ["cam00"]},
        "source": {"kind": "world", "scene": "tile", "width": 32, "height": 32, "fps": 5},
        "channel": {"preset": "ch5"},
        "edge": {"field": "splat", "foreground": {"box": [0.25, 0.25, 0.75, 0.75], "segment": "box"}},
    }
    deployment = build_deployment(parse(data, tmp_path / "cut.yaml"), RunSettings(steps=1, score_every_ms=None))
    deployment.run(0.8)
    decoder = deployment.updates.decoder
    assert deployment.publications and decoder.foreground.counts.masked >= 2
    newest = deployment.updates.buffer.newest().values()
    for view in decoder.views(newest):
        assert view.image.shape == (32, 32, 4)
        assert view.image[8:24, 8:24, 3].all() and view.image[..., 3].sum() == 255 * 16 * 16


def test_transparency_that_a_picture_has_stays():
    picture, truth = disc()
    rgba = np.dstack([picture, np.full(picture.shape[:2], 255, np.uint8)])
    rgba[:50, :, 3] = 100
    out, weight = make_foreground(ForegroundConfig(box=box_of(truth), segment="box")).apply("cam00", rgba)
    assert weight is None
    assert set(np.unique(out[..., 3])) == {0, 100, 255}


@pytest.mark.parametrize("transposed", [False, True])
def test_a_yolo_head_is_decoded_through_the_letterbox(tmp_path, transposed):
    needs_onnx()
    from edge_server.foreground.detector import Detector

    model = save_orange_detector(tmp_path / "orange.onnx", transposed=transposed)
    picture, _ = disc(96, 128, (48, 72), 14)
    found = Detector(str(model)).detect(picture, 0.25)
    assert [d.kind for d in found] == ["orange"], "overlapping ones are suppressed"
    # At half the size: a box of 40 is one of 80, and a cell is 16 pixels.
    x0, y0, x1, y1 = found[0].box
    assert (x1 - x0, y1 - y0) == pytest.approx((80.0, 80.0))
    assert abs((x0 + x1) / 2 - 72) <= 16 and abs((y0 + y1) / 2 - 48) <= 16


def test_detector_and_grabcut_together(tmp_path):
    needs_onnx()
    detector = save_orange_detector(tmp_path / "orange.onnx")
    picture, truth = disc(96, 128, (48, 72), 14)
    cut = make_foreground(ForegroundConfig(detector=str(detector), kinds=["orange"], margin=0.2))
    assert iou(cut.apply("cam00", picture)[0][..., 3] == 255, truth) > 0.85
    blue = np.full_like(picture, (40, 70, 160))
    assert cut.apply("cam00", blue)[0] is blue
    assert vars(cut.counts) == {
        "masked": 1,
        "not_detected": 1,
        "empty_box": 0,
        "empty_mask": 0,
        "full_mask": 0,
        "failed": 0,
    }
    assert cut.status()["ms_per_image"] > 0


@pytest.mark.parametrize("transposed", [False, True])
def test_the_masks_of_a_segmentation_model_are_taken_through_the_letterbox(tmp_path, transposed):
    needs_onnx()
    model = save_orange_detector(tmp_path / "orange-seg.onnx", transposed=transposed, masks=True)
    picture, truth = disc(96, 128, (48, 72), 14)
    for segment in (None, "detector"):
        cut = make_foreground(ForegroundConfig(detector=str(model), kinds=["orange"], segment=segment))
        mask = cut.apply("cam00", picture)[0][..., 3] == 255
        assert iou(mask, truth) > 0.8, "at an eighth of the picture's size"
    with_grabcut = make_foreground(ForegroundConfig(detector=str(model), segment="grabcut"))
    assert (with_grabcut.apply("cam00", picture)[0][..., 3] == 255).any()
    # A second object of the same color beside the box is not part of it.
    picture[:, :20] = picture[48, 72]
    mask = cut.apply("cam00", picture)[0][..., 3] == 255
    assert not (mask[:, :20].any() and mask[:, 60:].any())


def test_masks_that_a_detector_does_not_give_are_refused(tmp_path):
    needs_onnx()
    model = save_orange_detector(tmp_path / "orange.onnx")
    for section in ({"detector": str(model)}, {"box": (0.0, 0.0, 1.0, 1.0)}):
        with pytest.raises(ForegroundError, match=r"gives no masks; name a YOLO segmentation model"):
            make_foreground(ForegroundConfig(**section, segment="detector"))


def test_the_shipped_detector_runs():
    needs_onnx()
    from edge_server.foreground.detector import Detector

    detector = Detector("default")
    assert set(detector.kinds.values()) == {"person", "cart", "ball", "drum"}
    assert detector.detect(disc()[0], 0.9) is not None


def test_a_real_yolo_finds_the_people_of_a_real_video():
    needs_onnx()
    model = data_dir("yolo") / "yolo11n_int8_320.onnx"
    import cv2

    from edge_server.foreground.detector import Detector

    video = sorted(data_dir("pose2sim_single_person").rglob("*.mp4"))[0]
    capture = cv2.VideoCapture(str(video))
    ok, frame = capture.read()
    capture.release()
    assert ok
    found = Detector(str(model)).detect(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB), 0.4)
    assert "person" in [d.kind for d in found]


@pytest.mark.parametrize(
    "section, part",
    [
        ({}, "expected either detector or box"),
        ({"detector": "default", "box": [0, 0, 1, 1]}, "expected either detector or box"),
        ({"box": [0, 0, 2, 1]}, "within 0 to 1"),
        ({"box": [0, 0, 1]}, "expected a list of 4 values"),
        ({"box": [0, 0, 1, 1], "side": 3}, "side: expected 16 to 4096"),
        ({"box": [0, 0, 1, 1], "segment": "u2net.onnx"}, "segment: expected detector or grabcut or box"),
        ({"box": [0, 0, 1, 1], "color": 1}, "color"),
    ],
)
def test_wrong_sections_are_refused_in_one_line(section, part):
    with pytest.raises(ScenarioError, match=part) as caught:
        read_foreground(section, Path("scene.yaml"))
    assert "scene.yaml: edge.foreground" in str(caught.value) and "\n" not in str(caught.value)


def test_a_model_that_loops_for_ever_is_refused(tmp_path):
    needs_onnx()
    model = save_endless_loop(tmp_path / "loop.onnx")

    def refuse():
        with pytest.raises(ForegroundError, match=r"loop\.onnx: holds Loop, which no network"):
            make_foreground(ForegroundConfig(detector=str(model)))

    assert work_ms(refuse) < MOST_MS


@pytest.mark.parametrize("kind", ["Expand", "Tile", "ConstantOfShape", "Range", "Conv"])
def test_a_model_that_takes_terabytes_is_refused(tmp_path, kind):
    """Neither while it is loaded, where constants would be computed, nor in its first run. ONNX Runtime holds
    Tile to 4 GB in words of its own."""
    needs_onnx()
    model = save_memory_bomb(tmp_path / "bomb.onnx", kind)
    config = ForegroundConfig(detector=str(model))

    def refuse():
        with pytest.raises(ForegroundError, match=r"bomb\.onnx: ONNX Runtime .* (may take|more than) 4"):
            make_foreground(config)

    assert work_ms(refuse) < MOST_MS


def test_wrong_models_are_refused_in_one_line(tmp_path):
    needs_onnx()
    (tmp_path / "text.onnx").write_text("no model")
    segmenter = save_segmenter(tmp_path / "segment.onnx")
    detector = save_orange_detector(tmp_path / "orange.onnx")
    for config, part in (
        (ForegroundConfig(detector=str(tmp_path / "none.onnx")), "none.onnx: cannot be read"),
        (ForegroundConfig(detector=str(tmp_path / "text.onnx")), "text.onnx: not an ONNX file"),
        (ForegroundConfig(detector=str(segmenter)), "not the boxes and scores"),
        (ForegroundConfig(detector=str(detector), kinds=["dog"]), "knows no dog; it knows apple"),
    ):
        with pytest.raises(ForegroundError, match=part) as caught:
            make_foreground(config)
        assert "\n" not in str(caught.value)


def test_a_scenario_turns_it_on(tmp_path):
    scenario = load("tile")
    assert read_config(scenario).foreground is None
    section = "edge:\n  foreground: {box: [0, 0, 1, 1], segment: box}\n"
    text = scenario.path.read_text().replace("edge:\n", section)
    (tmp_path / "cut.yaml").write_text(text)
    assert read_config(load(str(tmp_path / "cut.yaml"))).foreground.segment == "box"
