"""Any detector of the family becomes an embedder, and what cameras should not send stays finite, bounded, isolated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnxruntime", reason="the extra embed is not installed")
pytest.importorskip("onnx", reason="the extra embed is not installed")

from onnx import helper, numpy_helper

from edge_server.embed import EmbeddingConfig, EmbeddingError, make_embedder
from edge_server.embed.cache import EmbeddingCache
from edge_server.embed.letterbox import GRAY
from edge_server.live.view_decoder import ViewDecoder
from edge_server.settings import read_config
from freshfield import payload
from freshfield.geometry import Pinhole
from freshfield.scenario import parse
from tests.conftest import data_dir
from tests.edge_server.embed.graphs import CHANNELS, detector, expected
from tests.edge_server.frames import frame

RNG = np.random.default_rng(1)


@pytest.fixture(scope="module")
def shipped():
    return make_embedder(EmbeddingConfig())


def image(height: int, width: int) -> np.ndarray:
    return RNG.integers(0, 256, (height, width, 3), dtype=np.uint8)


def embedder(path, **options):
    return make_embedder(EmbeddingConfig(model=str(path), **{"dim": CHANNELS, **options}))


def test_the_backbones_end_is_what_the_neck_enlarges_and_the_head_is_not_run(tmp_path):
    made = embedder(detector(tmp_path / "d.onnx"))
    assert made.backbone.tap == "end"
    images = [image(32, 32) for _ in range(3)]
    ready = np.stack(images).transpose(0, 3, 1, 2) / 255.0
    assert made.pooled(images) == pytest.approx(expected(ready), abs=1e-5)
    assert b"impossible" not in made.backbone.model and b"scales" not in made.backbone.model


@pytest.mark.parametrize(("batch", "count"), [(None, 0), (1, 1), (1, 70), (4, 70)])
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


def test_the_real_yolo11n_and_the_shipped_detector_work_unchanged():
    path = data_dir("yolo") / "yolo11n_int8_320.onnx"
    made = embedder(path, dim=32)
    assert made.backbone.tap == "/model.10/cv2/act/Mul_output_0"
    assert (made.backbone.batch, made.backbone.height) == (1, 320)
    images = [image(90, 160), np.zeros((128, 128, 3), np.uint8), image(500, 500)]
    rows = made.embed(images)
    assert np.isfinite(rows).all() and made.failed == 0
    assert (rows == made.embed(images)).all()
    shipped = embedder("default", dim=32)
    assert shipped.backbone.tap.startswith("/model.7/") and shipped.backbone.projection is not None
    assert np.ptp(shipped.embed(images), axis=0).min() > 0


def test_a_scenario_names_a_model_beside_it():
    def config(**section) -> EmbeddingConfig | None:
        return read_config(parse({"cameras": {"count": 2}, "edge": section}, Path("/somewhere/room.yaml"))).embedding

    assert config() is None and config(embedding={}) == EmbeddingConfig()
    assert config(embedding={"model": "m/yolo.onnx", "dim": 16}) == EmbeddingConfig("/somewhere/m/yolo.onnx", 16)
    assert config(embedding={"model": "default"}).model == "default"


HARD = {
    "black": np.zeros((128, 128, 3), np.uint8),
    "white": np.full((128, 128, 3), 255, np.uint8),
    "one pixel": np.full((1, 1, 3), 200, np.uint8),
    "one row": RNG.integers(0, 256, (1, 4096, 3), dtype=np.uint8),
    "one column": RNG.integers(0, 256, (4096, 1, 3), dtype=np.uint8),
    "flipped view": RNG.integers(0, 256, (60, 80, 3), dtype=np.uint8)[::-1, ::-1],
    "transparent": np.zeros((40, 40, 4), np.uint8),
    "checkers": (np.indices((128, 128)).sum(0)[..., None].repeat(3, 2) % 2 * 255).astype(np.uint8),
}


@pytest.mark.stability
@pytest.mark.parametrize("name", HARD)
def test_every_picture_has_a_finite_embedding_that_its_neighbors_do_not_change(shipped, name):
    alone = shipped.embed([HARD[name]])
    assert alone.shape == (1, shipped.dim) and np.isfinite(alone).all() and alone.any()
    # Far from anything trained on, and still of the size of embeddings: no picture swamps a policy's state.
    assert np.abs(alone).max() < 100.0
    among = shipped.embed([HARD["checkers"], HARD[name], HARD["black"]])
    assert among[1] == pytest.approx(alone[0], abs=1e-4)


@pytest.mark.stability
def test_what_is_no_picture_is_refused_by_number(shipped):
    for bad in (np.zeros((0, 5, 3), np.uint8), np.zeros((5, 5), np.uint8), np.zeros((5, 5, 3))):
        with pytest.raises(EmbeddingError, match="image 1: expected uint8"):
            shipped.embed([HARD["black"], bad])
    clear, gray = shipped.embed([HARD["transparent"], np.full((40, 40, 3), GRAY, np.uint8)])
    assert (clear == gray).all(), "alpha is laid over gray"


@pytest.mark.stability
def test_a_nan_of_one_frame_costs_no_other_frame_of_its_batch(tmp_path):
    """Of a model that overflows for a bright picture and not for a dark one."""
    nodes = helper.make_node("Mul", ["end", "steep"], ["m"]), helper.make_node("Exp", ["m"], ["e"])
    steep = numpy_helper.from_array(np.float32(1e3), "steep")
    path = detector(tmp_path / "o.onnx", extra=nodes, weights=(steep,))
    made = make_embedder(EmbeddingConfig(str(path), CHANNELS))
    dark = HARD["black"]
    rows = made.embed([dark, HARD["white"], dark])
    assert np.isfinite(rows).all() and made.failed == 1
    assert rows[0].any() and not rows[1].any() and (rows[0] == rows[2]).all()
    cache, square = EmbeddingCache(made, ViewDecoder().view), Pinhole.from_fov(32, 32, 60.0)
    items = [
        frame(f"cam{k}", intrinsics=square, payload=payload.encode(np.full((32, 32, 3), v, np.uint8)))
        for k, v in enumerate((0, 255, 0))
    ]
    for _ in range(3):
        rows, ok = cache.of(items)
        assert ok.tolist() == [True, False, True] and np.isfinite(rows).all() and not rows[1].any()
    assert cache.failed == 1, "counted once"
