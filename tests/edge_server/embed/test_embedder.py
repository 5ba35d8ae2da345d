"""Any detector of the family becomes an embedder: cut at the backbone's end, fed, pooled, projected."""

from __future__ import annotations

import sys

import numpy as np
import pytest

pytest.importorskip("onnxruntime", reason="the extra embed is not installed")
pytest.importorskip("onnx", reason="the extra embed is not installed")

from edge_server.embed import MODELS, EmbeddingConfig, EmbeddingError, make_embedder
from edge_server.embed.backbone import load_backbone
from tests.conftest import data_dir
from tests.edge_server.embed.graphs import CHANNELS, detector, expected

RNG = np.random.default_rng(1)


def image(height: int, width: int) -> np.ndarray:
    return RNG.integers(0, 256, (height, width, 3), dtype=np.uint8)


def embedder(path, **options):
    return make_embedder(EmbeddingConfig(model=str(path), **{"dim": CHANNELS, **options}))


def test_the_backbones_end_is_what_the_neck_enlarges_and_the_head_is_not_run(tmp_path):
    made = embedder(detector(tmp_path / "d.onnx"))
    assert made.backbone.tap == "end" and made.backbone.channels == CHANNELS
    images = [image(32, 32) for _ in range(3)]
    ready = np.stack(images).transpose(0, 3, 1, 2) / 255.0
    assert made.pooled(images) == pytest.approx(expected(ready), abs=1e-5)


@pytest.mark.parametrize("batch", [None, 1, 4])
@pytest.mark.parametrize("count", [0, 1, 70])
def test_fixed_and_free_batches_give_one_result(tmp_path, batch, count):
    free = embedder(detector(tmp_path / "a.onnx"))
    fixed = embedder(detector(tmp_path / "b.onnx", batch=batch))
    images = [image(20 + k, 40) for k in range(count)]  # 70: more than one run, in order
    rows = fixed.embed(images)
    assert rows.shape == (count, CHANNELS) and rows.dtype == np.float32
    assert rows == pytest.approx(free.embed(images), abs=1e-5)


def test_the_projection_keeps_lengths_and_is_the_same_in_every_process(tmp_path):
    path = detector(tmp_path / "d.onnx")
    made, smaller = embedder(path), embedder(path, dim=3)
    images = [image(32, 32) for _ in range(4)]
    whole = made.embed(images)
    assert np.linalg.norm(whole, axis=1) == pytest.approx(np.linalg.norm(made.pooled(images), axis=1), rel=1e-5)
    assert smaller.embed(images).shape == (4, 3)
    assert (embedder(path).embed(images) == whole).all(), "bit for bit"
    with pytest.raises(EmbeddingError, match=f"dim: end has {CHANNELS} channels, 7 numbers"):
        embedder(path, dim=7)


def test_the_size_is_the_files_or_the_exporters(tmp_path):
    free = detector(tmp_path / "free.onnx", size=None)
    assert embedder(free).backbone.height == 640
    noted = detector(tmp_path / "noted.onnx", size=None, meta={"imgsz": "[64, 96]"})
    assert (embedder(noted).backbone.height, embedder(noted).backbone.width) == (64, 96)
    odd = detector(tmp_path / "odd.onnx", size=None, meta={"imgsz": "[" * 300})
    assert embedder(odd).backbone.height == 640, "a note that makes no sense is no note"
    assert embedder(detector(tmp_path / "fixed.onnx")).backbone.height == 32


def test_alpha_is_laid_over_gray(tmp_path):
    made = embedder(detector(tmp_path / "d.onnx"))
    clear = np.zeros((32, 32, 4), np.uint8)
    gray = np.full((32, 32, 3), 114, np.uint8)
    solid = np.concatenate([image(32, 32), np.full((32, 32, 1), 255, np.uint8)], axis=2)
    rows = made.embed([clear, gray, solid, np.ascontiguousarray(solid[..., :3])])
    assert (rows[0] == rows[1]).all() and (rows[2] == rows[3]).all()


def test_the_real_yolo11n_works_unchanged():
    path = data_dir("yolo") / "yolo11n_int8_320.onnx"
    made = embedder(path, dim=32)
    assert made.backbone.tap == "/model.10/cv2/act/Mul_output_0"
    assert (made.backbone.batch, made.backbone.height, made.backbone.channels) == (1, 320, 256)
    images = [image(90, 160), np.zeros((128, 128, 3), np.uint8), image(500, 500)]
    rows = made.embed(images)
    assert np.isfinite(rows).all() and made.failed == 0
    assert (rows == made.embed(images)).all()


@pytest.mark.parametrize("file", [MODELS / "detector_int8.onnx", "default"])
def test_the_shipped_detectors_go_the_same_way(file):
    made = embedder(file, dim=32)
    assert made.backbone.tap.startswith("/model.7/") and made.backbone.projection is not None
    rows = made.embed([image(128, 128), image(480, 640), image(33, 17)])
    assert np.isfinite(rows).all() and np.ptp(rows, axis=0).min() > 0
    with pytest.raises(EmbeddingError, match="dim: "):
        embedder(file, dim=4096)


def test_a_library_that_is_missing_is_named_with_what_installs_it(monkeypatch):
    for name in ("backbone", "embedder"):
        monkeypatch.delitem(sys.modules, f"edge_server.embed.{name}", raising=False)
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(EmbeddingError, match=r"embedding needs onnx, .*freshfield\[embed\]"):
        make_embedder(EmbeddingConfig())


def test_the_cut_model_holds_no_weights_of_the_head(tmp_path):
    backbone = load_backbone(detector(tmp_path / "d.onnx"))
    assert b"impossible" not in backbone.model and b"scales" not in backbone.model
