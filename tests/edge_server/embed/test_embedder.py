"""Any detector becomes an embedder, what is none is refused; frames are embedded once, and a bad one stays isolated."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from edge_server.embed.cache import EmbeddingCache
from edge_server.live.view_decoder import ViewDecoder
from freshfield.frame import Frame
from tests.edge_server.frames import damaged_frame, frame
from tests.support import refused

pytest.importorskip("onnxruntime", reason="the extra embed is not installed")
pytest.importorskip("onnx", reason="the extra embed is not installed")

import onnx
from onnx import TensorProto, helper, numpy_helper

from edge_server.edge_constants import MAX_GRAPH_NODES
from edge_server.embed import EmbeddingError, make_embedder
from edge_server.embed.letterbox import GRAY
from edge_server.embed.settings import EmbeddingConfig
from freshfield import payload
from freshfield.geometry import Pinhole
from tests.conftest import data_dir
from tests.edge_server.embed.graphs import CHANNELS, detector, expected

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
    assert made.backbone.tap == "end" and made.backbone.channels == CHANNELS
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
    refused(EmbeddingError, f"dim: end has {CHANNELS} channels, 7 numbers", embedder, path, dim=7)


def test_the_size_is_the_files_or_the_exporters(tmp_path):
    assert embedder(detector(tmp_path / "free.onnx", size=None)).backbone.height == 640
    noted = detector(tmp_path / "noted.onnx", size=None, meta={"imgsz": "[64, 96]"})
    assert (embedder(noted).backbone.height, embedder(noted).backbone.width) == (64, 96)
    odd = detector(tmp_path / "odd.onnx", size=None, meta={"imgsz": "[" * 300})
    assert embedder(odd).backbone.height == 640, "a note that makes no sense is no note"
    assert embedder(detector(tmp_path / "fixed.onnx")).backbone.height == 32


def test_the_real_yolo11n_and_the_shipped_detector_work_unchanged():
    made = embedder(data_dir("yolo") / "yolo11n_int8_320.onnx", dim=32)
    assert made.backbone.tap == "/model.10/cv2/act/Mul_output_0"
    assert (made.backbone.batch, made.backbone.height, made.backbone.channels) == (1, 320, 256)
    images = [image(90, 160), np.zeros((128, 128, 3), np.uint8), image(500, 500)]
    rows = made.embed(images)
    assert np.isfinite(rows).all()
    assert (rows == made.embed(images)).all()
    shipped = embedder("default", dim=32)
    assert shipped.backbone.tap.startswith("/model.7/") and shipped.backbone.projection is not None
    assert np.ptp(shipped.embed(images), axis=0).min() > 0


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
        refused(EmbeddingError, "image 1: expected uint8", shipped.embed, [HARD["black"], bad])
    clear, gray = shipped.embed([HARD["transparent"], np.full((40, 40, 3), GRAY, np.uint8)])
    assert (clear == gray).all(), "alpha is laid over gray"
    opaque, white = shipped.embed([np.full((40, 40, n), 255, np.uint8) for n in (4, 3)])
    assert (opaque == white).all()


@pytest.mark.stability
def test_a_nan_of_one_frame_costs_no_other_frame_of_its_batch(tmp_path):
    """Of a model that overflows for a bright picture and not for a dark one."""
    nodes = helper.make_node("Mul", ["end", "steep"], ["m"]), helper.make_node("Exp", ["m"], ["e"])
    steep = numpy_helper.from_array(np.float32(1e3), "steep")
    path = detector(tmp_path / "o.onnx", extra=nodes, weights=(steep,))
    made = make_embedder(EmbeddingConfig(str(path), CHANNELS))
    dark = HARD["black"]
    rows = made.embed([dark, HARD["white"], dark])
    assert np.isfinite(rows).all()
    assert rows[0].any() and not rows[1].any() and (rows[0] == rows[2]).all()
    cache, square = EmbeddingCache(made, ViewDecoder().view), Pinhole.from_fov(32, 32, 60.0)
    sent = [payload.encode(np.full((32, 32, 3), level, np.uint8)) for level in (0, 255, 0)]
    items = [frame(f"cam{k}", intrinsics=square, payload=each) for k, each in enumerate(sent)]
    for _ in range(3):
        rows, ok = cache.of(items)
        assert ok.tolist() == [True, False, True] and np.isfinite(rows).all() and not rows[1].any()


def node(kind: str, read: list[str], write: str, **attributes):
    return helper.make_node(kind, read, [write], name=f"/model.1/{write}", **attributes)


def another_input(path: Path, shape: list[int], kind: int = TensorProto.FLOAT) -> None:
    model = onnx.load(str(detector(path)))
    model.graph.input[0].CopyFrom(helper.make_tensor_value_info("images", kind, shape))
    onnx.save(model, str(path))


def chain(kind: str, count: int, times: int = 1, **attributes) -> tuple[onnx.NodeProto, ...]:
    """Each node reads the one before it so many times."""
    return tuple(node(kind, [f"t{k}" if k else "end"] * times, f"t{k + 1}", **attributes) for k in range(count))


def empty_claims(path: Path, dims: tuple[int, ...]) -> None:
    claims = TensorProto(name="k", data_type=TensorProto.FLOAT, dims=dims, raw_data=b"\0" * 8)
    detector(path, extra=(node("Mul", ["end", "k"], "big"),), weights=(claims,))


def no_text(path: Path) -> None:
    path.write_bytes(detector(path).read_bytes().replace(b"images", b"\xffmages"))


# Memory from nothing, and channels beyond those that there are.
HUGE = numpy_helper.from_array(np.array([1, 1, 200_000, 200_000], np.int64), "huge")
BEYOND = numpy_helper.from_array(np.array([0, 1, 2, 99], np.int64), "beyond")
EXPAND, GATHER = node("Expand", ["end", "huge"], "big"), node("Gather", ["end", "beyond"], "some", axis=1)
SCALED = helper.make_node("DynamicQuantizeLinear", ["end"], ["q", "scale", "zero"], name="/model.1/q")

# What is no detector, or would take more memory than there is, and how it is refused.
WRONG = {
    "missing": (lambda path: None, "b.onnx: cannot be read: No such file"),
    "no text": (no_text, "b.onnx: a damaged ONNX file"),
    "no ONNX": (lambda path: path.write_bytes(b"\xff" * 64), "b.onnx: not an ONNX"),
    "classifier": (partial(detector, neck=False), "not a YOLO detection model"),
    "no image": (partial(another_input, shape=[1, 3, 32]), "input images is not"),
    "whole numbers": (partial(another_input, shape=[1, 3, 32, 32], kind=TensorProto.INT64), "input images is not"),
    "expand": (partial(detector, extra=(EXPAND,), weights=(HUGE,)), "holds Expand, which no YOLO backbone does"),
    "scaled": (partial(detector, extra=(SCALED,)), "q is quantised with another scale for every image"),
    "concat": (partial(detector, extra=chain("Concat", 40, times=2, axis=1)), "larger than any backbone's"),
    "chain": (partial(detector, extra=chain("Relu", MAX_GRAPH_NODES)), "10006 nodes, more than any network of images"),
    "claims": (partial(empty_claims, dims=(2**20, 2**20)), "larger than any backbone's"),
    "small claims": (partial(empty_claims, dims=(1, 6, 8, 8)), "cannot load it"),
    "part of it": (partial(detector, meta={"freshfield.projection": "AAAAAAAA" * 11}), "projection is damaged"),
    "breaks when it is run": (partial(detector, extra=(GATHER,), weights=(BEYOND,)), "ONNX Runtime cannot run it"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_file_is_refused_in_one_line_and_by_us(tmp_path, capfd, name):
    """ONNX Runtime would print, in red, what it then raises."""
    make, match = WRONG[name]
    make(tmp_path / "b.onnx")
    refused(EmbeddingError, match, make_embedder, EmbeddingConfig(model=str(tmp_path / "b.onnx"), dim=4))
    assert capfd.readouterr() == ("", "")


DIM = 4


class Means:
    """Embeds a picture as its mean colors, and notes what it was asked for."""

    dim = DIM

    def __init__(self) -> None:
        self.asked: list[int] = []

    def embed(self, images):
        self.asked.append(len(images))
        return np.array([[*i.reshape(-1, 3).mean(0), 1.0] for i in images], np.float32)


def buffered(camera: str = "cam01", sequence: int = 0, **other) -> Frame:
    return frame(camera, sequence, **{"generated_ns": sequence, "received_ns": sequence, **other})


def test_a_frame_is_embedded_once_whoever_asks_again():
    cache = EmbeddingCache(means := Means(), ViewDecoder().view)
    items = [buffered("cam01"), buffered("cam02", 3)]
    first, ok = cache.of(items)
    again, _ = cache.of(list(reversed(items)))
    assert ok.tolist() == [True, True] and first.dtype == np.float32 and first.shape == (2, DIM)
    assert (again == first[::-1]).all()
    assert means.asked == [2]
    cache.of([items[1], buffered("cam01", 1)])
    assert means.asked == [2, 1], "only what is new"
    cache.of([buffered("cam01", 1, session="s2")])
    assert means.asked == [2, 1, 1], "another session with the same number is another frame"


def test_a_frame_that_cannot_be_decoded_is_a_camera_without_embedding():
    means, decoder = Means(), ViewDecoder()
    cache = EmbeddingCache(means, decoder.view)
    for _ in range(3):
        rows, ok = cache.of([damaged_frame("cam01"), buffered("cam02")])
        assert ok.tolist() == [False, True] and (rows[0] == 0).all()
    assert decoder.undecodable == 1 and means.asked == [1]
