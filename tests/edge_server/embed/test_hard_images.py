"""Embeddings of what cameras should not send and models should not give: finite, bounded, isolated."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("onnxruntime", reason="the extra embed is not installed")
pytest.importorskip("onnx", reason="the extra embed is not installed")

from onnx import helper, numpy_helper

from edge_server.embed import EmbeddingConfig, EmbeddingError, make_embedder
from edge_server.embed.cache import EmbeddingCache
from edge_server.embed.letterbox import GRAY, letterbox
from edge_server.live.view_decoder import ViewDecoder
from freshfield import payload
from freshfield.geometry import Pinhole
from tests.edge_server.embed.graphs import CHANNELS, detector
from tests.edge_server.frames import frame

pytestmark = pytest.mark.stability

RNG = np.random.default_rng(3)


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


@pytest.fixture(scope="module")
def shipped():
    return make_embedder(EmbeddingConfig())


@pytest.mark.parametrize("name", HARD)
def test_every_picture_has_a_finite_embedding_that_its_neighbors_do_not_change(shipped, name):
    alone = shipped.embed([HARD[name]])
    assert alone.shape == (1, shipped.dim) and np.isfinite(alone).all() and alone.any()
    # Far from anything trained on, and still of the size of embeddings: no picture swamps a policy's state.
    assert np.abs(alone).max() < 100.0
    among = shipped.embed([HARD["checkers"], HARD[name], HARD["black"]])
    assert among[1] == pytest.approx(alone[0], abs=1e-4)


def test_what_is_no_picture_is_refused_by_number(shipped):
    for bad in (np.zeros((0, 5, 3), np.uint8), np.zeros((5, 5), np.uint8), np.zeros((5, 5, 3))):
        with pytest.raises(EmbeddingError, match="image 1: expected uint8"):
            shipped.embed([HARD["black"], bad])
    clear, gray = shipped.embed([HARD["transparent"], np.full((40, 40, 3), GRAY, np.uint8)])
    assert (clear == gray).all(), "alpha is laid over gray"


@pytest.mark.parametrize("shape", [(1, 1), (1, 5000), (5000, 1), (31, 977), (128, 128), (3000, 2)])
def test_a_letterbox_keeps_aspect_and_never_loses_the_picture(shape):
    out = letterbox(np.full((*shape, 3), 7, np.uint8), 64, 96)
    assert out.shape == (64, 96, 3)
    rows, columns = np.nonzero((out == 7).all(axis=2))
    height, width = np.ptp(rows) + 1, np.ptp(columns) + 1
    assert height * width == len(rows), "one solid rectangle"
    assert height == 64 or width == 96
    scale = min(64 / shape[0], 96 / shape[1])
    assert abs(height - max(1, shape[0] * scale)) <= 0.5 and abs(width - max(1, shape[1] * scale)) <= 0.5


@pytest.mark.parametrize("gain", [np.nan, np.inf, 3e38])
def test_a_model_that_gives_nan_or_overflows_gives_zero_rows_that_are_counted(tmp_path, gain):
    made = make_embedder(EmbeddingConfig(str(detector(tmp_path / "d.onnx", gain=gain)), CHANNELS))
    rows = made.embed([HARD["checkers"], HARD["white"]])
    assert np.isfinite(rows).all() and not rows.any() and made.failed == 2


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
