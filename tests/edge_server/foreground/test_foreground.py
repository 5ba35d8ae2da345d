"""Cutting an object out with a YOLO segmentation model, and what passes whole because it cannot be cut."""

import logging
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.support import refused

pytest.importorskip("onnxruntime", reason="needs ONNX Runtime: pip install -e '.[embed]'")
pytest.importorskip("onnx", reason="needs ONNX Runtime: pip install -e '.[embed]'")

from onnx import helper

from camera_node.synthetic.scene import make_scene
from edge_server.embed import EmbeddingError
from edge_server.experiments.virtual.from_scenario import build_deployment
from edge_server.experiments.virtual.run_settings import RunSettings
from edge_server.foreground.detector import Detection, decode
from edge_server.foreground.foreground import Foreground, make_foreground
from edge_server.foreground.settings import ForegroundConfig
from freshfield.geometry import Pinhole, on_sphere
from freshfield.scenario import parse
from tests.conftest import case_dir
from tests.edge_server.embed.graphs import save
from tests.support import small_world

NOISE = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)


def cut(*detections: Detection, **config) -> Foreground:
    """With a detector that always gives the same detections."""
    detector = SimpleNamespace(detect=lambda image, confidence: list(detections))
    return Foreground(ForegroundConfig("model.onnx", **config), detector)


def found(box, mask=None, kind="tile", score=0.9) -> Detection:
    def broken():
        raise EmbeddingError("broken")

    return Detection(box, score, kind, broken if mask is None else lambda: mask)


def test_what_the_mask_shows_within_the_box_and_its_margin_stays():
    mask = np.ones((40, 60), np.bool_)
    mask[:, 30] = False
    alpha = np.full((40, 60), 255, np.uint8)
    alpha[:20] = 100
    foreground = cut(found((20.0, 10.0, 40.0, 30.0), mask), margin=0.1)
    rgba = foreground.apply("cam00", np.dstack([NOISE, alpha]))
    kept = np.zeros((40, 60), np.bool_)
    kept[8:32, 18:42] = True  # a tenth of 20 pixels on each side
    kept[:, 30] = False
    assert np.array_equal(rgba[..., 3], np.where(kept, alpha, 0)), "transparency that an image has stays"
    assert np.array_equal(rgba[kept][:, :3], NOISE[kept])
    assert not rgba[~kept].any(), "what is transparent has no color either"
    assert np.array_equal(foreground.apply("cam00", NOISE)[..., 3], np.where(kept, 255, 0))


def test_the_surest_detection_of_a_kind_asked_for_counts():
    left, right = np.zeros((40, 60), np.bool_), np.zeros((40, 60), np.bool_)
    left[:, :10], right[:, 50:] = True, True
    whole = (0.0, 0.0, 60.0, 40.0)
    both = found(whole, left, "dog"), found(whole, right, "cat")
    assert np.array_equal(cut(*both).apply("c", NOISE)[..., 3] > 0, left)
    assert np.array_equal(cut(*both, kinds=["cat"]).apply("c", NOISE)[..., 3] > 0, right)
    assert cut(*both, kinds=["owl"]).apply("c", NOISE) is NOISE


ALL, NONE = np.ones((40, 60), np.bool_), np.zeros((40, 60), np.bool_)


@pytest.mark.stability
@pytest.mark.parametrize(
    "detections, counted",
    [
        ([], "not_detected"),
        ([found((-30.0, -30.0, 0.0, 0.0), ALL)], "not_detected"),
        ([found((0.0, 0.0, 30.0, 30.0), NONE)], "not_detected"),
        ([found((-5.0, -5.0, 65.0, 45.0), ALL)], "full_mask"),
        ([found((0.0, 0.0, 30.0, 30.0))], "failed"),
    ],
)
def test_what_cannot_be_cut_passes_whole_and_is_counted_and_said_once(detections, counted, caplog):
    foreground = cut(*detections, margin=0.0)
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            assert foreground.apply("cam00", NOISE) is NOISE
    assert +foreground.counts == {counted: 2}
    assert len(caplog.records) == 1 and "cam00" in caplog.text
    assert foreground.status()[counted] == 2 and foreground.status()["ms_per_image"] > 0


def columns(*rows, cells=64):
    """A head's output with these rows first, the others silent: (1, cells, columns)."""
    table = np.zeros((1, cells, len(rows[0])))
    table[0, : len(rows)] = rows
    return table


def head(*rows):
    """Its transpose: (1, 4 + 2 kinds + 1 mask weight, 64 cells)."""
    return columns(*rows).transpose(0, 2, 1)


def test_a_head_is_decoded_to_corners_best_score_first():
    rows = head((10, 20, 4, 6, 0.3, 0.0, 7.0), (40, 40, 2, 2, 0.1, 0.8, -3.0))
    expected = [(39, 39, 41, 41, 0.8, 1, -3.0), (8, 17, 12, 23, 0.3, 0, 7.0)]
    assert decode(rows, 0.25, "test", 1) == [pytest.approx(row) for row in expected]
    assert decode(rows.transpose(0, 2, 1), 0.25, "test", 1) == decode(rows, 0.25, "test", 1)
    assert len(decode(rows, 0.5, "test", 1)) == 1
    # The same box twice is one object; the same box of another kind is another.
    twice = head((10, 20, 4, 6, 0.3, 0.0, 7.0), (10, 20, 4, 6, 0.4, 0.0, 8.0), (10, 20, 4, 6, 0.0, 0.5, 9.0))
    assert [row[6] for row in decode(twice, 0.25, "test", 1)] == [9.0, 8.0]


TILE = (8.0, 17.0, 12.0, 23.0)  # corners of a box around (10, 20)


@pytest.mark.parametrize(
    ("output", "kinds", "end_to_end", "kind"),
    [
        (head((10, 20, 4, 6, 0.0, 0.1, 0.9, 5.0)), 3, False, 2.0),
        (head((10, 20, 4, 6, 1.0, 0.1, 0.9, 5.0)), 2, None, 1.0),  # v5: objectness first
        (columns((*TILE, 0.9, 1.0, 5.0), cells=300), 80, None, 1.0),
        (columns((*TILE, 0.9, 1.0, 5.0), cells=300), 2, True, 1.0),
        (columns((*TILE, 0.9, 1.0, 5.0), cells=5), 0, None, 1.0),
    ],
)
def test_every_head_of_a_segmentation_model_is_told_and_decoded(output, kinds, end_to_end, kind):
    (row,) = decode(output, 0.5, "test", 1, kinds, end_to_end)
    assert row == pytest.approx((*TILE, 0.9, kind, 5.0))
    # What suppresses by itself is not suppressed again.
    twice = columns((*TILE, 0.9, 1.0, 5.0), (*TILE, 0.8, 1.0, 6.0), cells=300)
    assert [row[6] for row in decode(twice, 0.5, "test", 1, 80)] == [5.0, 6.0]


@pytest.mark.parametrize(
    ("output", "kinds", "message"),
    [
        (head((10, 20, 4, 6, 1.9, 0.0, 5.0)), 2, "scores lie in 0 to 1.9, not in 0 to 1"),
        (head((0.5, 0.5, 0.1, 0.1, 0.9, 0.0, 5.0)), 2, "boxes are not in pixels"),
        (head((10, 20, 4, 6, 0.9, 0.0, 5.0)), 5, "fits no head of 5 classes"),
        (columns((*TILE, 0.9, 1.5, 5.0), cells=300), 80, "fits no head of 80 classes"),
        (np.zeros((1, 300, 6)), 80, "not the boxes and scores of a YOLO segmentation head"),
    ],
)
def test_a_head_that_is_not_understood_is_refused_with_the_command_that_exports_one(output, kinds, message):
    with pytest.raises(EmbeddingError, match=rf"test: .*{message}.*yolo export model=yolo11n-seg.pt format=onnx"):
        decode(output, 0.5, "test", 2 if output.shape[2] == 6 else 1, kinds)
    for kind, coefficients in ((1.5, 1), (1.0, 0)):
        with pytest.raises(EmbeddingError, match="fits no head of 80 classes"):
            decode(columns((*TILE, 0.9, kind, 5.0), cells=300), 0.5, "test", coefficients, 80, end_to_end=True)


def test_models_without_masks_and_of_other_kinds_are_refused_by_what_they_are(monkeypatch):
    for name, task in (("pose", "pose"), ("v5", "detect"), ("e2e_nms", "detect")):
        with pytest.raises(EmbeddingError, match=rf"{name}.onnx: gives no masks: it is a model of the task {task}"):
            make_foreground(ForegroundConfig(str(case_dir("02-yolo-end-to-end-export") / f"{name}.onnx")))
    refused(EmbeddingError, "knows no dog; it knows tile", make_foreground, ForegroundConfig("tile", kinds=["dog"]))
    monkeypatch.setattr("edge_server.foreground.detector._kinds", lambda meta: {})
    refused(EmbeddingError, "names no classes", make_foreground, ForegroundConfig("tile", kinds=["tile"]))
    make_foreground(ForegroundConfig("tile", kinds=["0"]))


@pytest.mark.stability
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_model_that_gives_no_numbers_detects_nothing(value):
    good = (10.0, 20.0, 4.0, 6.0, 0.9, 0.1, 1.0)
    assert len(decode(head(good), 0.25, "test", 1)) == 1
    for column in range(7):
        assert decode(head([value if k == column else v for k, v in enumerate(good)]), 0.25, "test", 1) == []
    assert decode(head((10.0, 20.0, 0.0, 6.0, 0.9, 0.1, 1.0)), 0.25, "test", 1) == [], "a box without area"


def memory_bomb(path: Path, kind: str) -> Path:
    """A segmentation ONNX with one tensor of 400 TB. kind: Expand or Conv."""
    constants = {"shape": np.array([2**33, 3, 64, 64]), "weight": np.ones((1, 3, 1, 1), np.float32)}
    read = {"Expand": ["images", "shape"], "Conv": ["images", "weight"]}[kind]
    nodes = [
        helper.make_node(kind, read, ["large"], **({"pads": [5_000_000] * 4} if kind == "Conv" else {})),
        helper.make_node("Cast", ["large"], ["floats"], to=1),
        helper.make_node("ReduceMax", ["floats"], ["most"], keepdims=0),
        helper.make_node("Mul", ["images", "most"], ["lit"]),
        helper.make_node("Conv", ["lit", "weight"], ["map"]),
        helper.make_node("AveragePool", ["images"], ["masks"], kernel_shape=[4, 4], strides=[4, 4]),
    ]
    further = (("masks", [1, 3, 16, 16]),)
    return save(path, nodes, [1, 3, 64, 64], ("map", [1, 1, 64, 64]), constants, opset=13, further=further)


def test_a_model_that_loops_for_ever_is_refused(tmp_path):
    loop = [helper.make_node("Loop", ["rounds", "", "images"], ["map"], body=helper.make_graph([], "round", [], []))]
    path = save(tmp_path / "loop.onnx", loop, [1, 3, 8, 8], ("map", [1, 3, 8, 8]), {"rounds": np.array(2**62)})
    refused(EmbeddingError, r"loop\.onnx: holds Loop, which no network", make_foreground, ForegroundConfig(str(path)))


@pytest.mark.parametrize("kind", ["Expand", "Conv"])
def test_a_model_that_takes_terabytes_is_refused(tmp_path, kind):
    """Neither while it is loaded, where constants would be computed, nor in its first run."""
    config = ForegroundConfig(str(memory_bomb(tmp_path / "bomb.onnx", kind)))
    refused(EmbeddingError, r"bomb\.onnx: ONNX Runtime .* (may take|more than) 4", make_foreground, config)


def test_the_loop_fits_to_cut_views(tmp_path):
    """From the scenario to what the field is given, in virtual time."""
    source = small_world(scene="tile", width=96, height=96, fps=5)
    edge = {"field": "ngp", "foreground": {"detector": "tile"}}
    data = {"cameras": {"count": 3, "held_out": ["cam00"]}, "source": source, "edge": edge}
    deployment = build_deployment(parse(data, tmp_path / "cut.yaml"), RunSettings(steps=1, score_every_ms=None))
    deployment.run(0.8)
    decoder = deployment.updates.decoder
    assert deployment.publications and decoder.foreground.counts["masked"] >= 2
    for view in decoder.views(deployment.updates.buffer.newest().values()):
        assert view.image.shape == (96, 96, 4)
        assert 0.01 < (view.image[..., 3] > 0).mean() < 0.6


@pytest.mark.parametrize("bench", [False, True], ids=["cell", "scan"])
def test_the_tile_is_cut_out_as_a_hand_sees_it(bench):
    """Views that the shipped model was not trained on, letterboxed into its square."""
    lens, foreground, found = Pinhole.from_fov(160, 120, 75.0), make_foreground(ForegroundConfig("tile")), []
    scene = make_scene("tile", {"count": 1, "bench": bench})
    plain = [make_scene("tile", {"count": 1, "supersample": 1, "bench": b}) for b in (False, bench)]
    for azimuth, elevation in ((-165, 30), (-45, 52), (75, 52), (75, 75)):
        pose = on_sphere((0.0, 0.0, 0.03), 0.34, azimuth, elevation)
        alone, near = (each.view(lens, pose).distance() for each in plain)
        truth = np.isfinite(alone) & (alone <= near + 1e-9)
        rgba = foreground.apply("hand", scene.view(lens, pose).image(0.0))
        mask = rgba[..., 3] == 255
        found.append((mask & truth).sum() / (mask | truth).sum())
    assert np.mean(found) > (0.85 if bench else 0.94) and min(found) > (0.75 if bench else 0.9), found
