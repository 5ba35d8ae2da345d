"""A file that is no detector: one clear line that names it, and no memory or time spent on it."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnxruntime", reason="the extra embed is not installed")
onnx = pytest.importorskip("onnx", reason="the extra embed is not installed")

from onnx import TensorProto, helper, numpy_helper  # noqa: E402

from edge_server.embed import EmbeddingConfig, EmbeddingError, make_embedder  # noqa: E402
from edge_server.embed.backbone import MAX_NODES  # noqa: E402
from tests.edge_server.embed.graphs import detector  # noqa: E402


def node(kind: str, read: list[str], write: str, **attributes):
    return helper.make_node(kind, read, [write], name=f"/model.1/{write}", **attributes)


def joined_with_nothing(path: Path) -> None:
    model = onnx.load(str(detector(path)))
    model.graph.node[5].CopyFrom(node("Relu", ["large"], "joined"))  # enlarged, but joined with nothing
    onnx.save(model, str(path))


def another_input(path: Path, shape: list[int], kind: int = TensorProto.FLOAT) -> None:
    model = onnx.load(str(detector(path)))
    model.graph.input[0].CopyFrom(helper.make_tensor_value_info("images", kind, shape))
    onnx.save(model, str(path))


def memory_from_nothing(path: Path) -> None:
    huge = numpy_helper.from_array(np.array([1 << 30, 6, 8, 8], np.int64), "huge")
    detector(path, extra=(node("Expand", ["end", "huge"], "big"),), weights=(huge,))


def long_chain(path: Path) -> None:
    detector(path, extra=tuple(node("Relu", [f"t{k}" if k else "end"], f"t{k + 1}") for k in range(MAX_NODES)))


def empty_claims(path: Path, dims: tuple[int, ...]) -> None:
    claims = TensorProto(name="k", data_type=TensorProto.FLOAT, dims=dims, raw_data=b"\0" * 8)
    detector(path, extra=(node("Mul", ["end", "k"], "big"),), weights=(claims,))


def beyond(path: Path) -> None:
    channels = numpy_helper.from_array(np.array([0, 1, 2, 99], np.int64), "beyond")
    detector(path, extra=(node("Gather", ["end", "beyond"], "some", axis=1),), weights=(channels,))


# What is no detector, or would take more memory than there is, and how it is refused.
WRONG = {
    "missing": (lambda path: None, "b.onnx: cannot be read: No such file"),
    "empty": (lambda path: path.write_bytes(b""), "b.onnx: not an ONNX"),
    "no ONNX": (lambda path: path.write_bytes(b"\xff" * 64), "b.onnx: not an ONNX"),
    "classifier": (partial(detector, neck=False), "not a YOLO detection model"),
    "enlargement": (joined_with_nothing, "not a YOLO detection model"),
    "no image": (partial(another_input, shape=[1, 3, 32]), "input images is not"),
    "whole numbers": (partial(another_input, shape=[1, 3, 32, 32], kind=TensorProto.INT64), "input images is not"),
    "expand": (memory_from_nothing, "it asks for more"),
    "chain": (long_chain, "10007 nodes, more than any network of images"),
    "claims": (partial(empty_claims, dims=(2**20, 2**20)), "cannot load it"),
    "small claims": (partial(empty_claims, dims=(1, 6, 8, 8)), "cannot load it"),
    "part of it": (partial(detector, meta={"freshfield.projection": "AAAAAAAA" * 11}), "projection is damaged"),
    "breaks when it is run": (beyond, "ONNX Runtime cannot run it"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_file_is_refused_in_one_line_and_by_us(tmp_path, capfd, name):
    """ONNX Runtime would print, in red, what it then raises."""
    make, match = WRONG[name]
    make(tmp_path / "b.onnx")
    with pytest.raises(EmbeddingError, match=match) as caught:
        make_embedder(EmbeddingConfig(model=str(tmp_path / "b.onnx"), dim=4))
    assert "\n" not in str(caught.value) and capfd.readouterr() == ("", "")


def test_every_kind_of_damage_ends_in_one_line(tmp_path):
    whole = detector(tmp_path / "whole.onnx").read_bytes()
    rng = np.random.default_rng(5)
    path, refusals = tmp_path / "damaged.onnx", 0
    for _ in range(150):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), 3):
            data[at] = rng.integers(0, 256)
        path.write_bytes(data)
        try:
            rows = make_embedder(EmbeddingConfig(str(path), 4)).embed([np.zeros((9, 9, 3), np.uint8)])
        except EmbeddingError as error:
            assert "\n" not in str(error)
            refusals += 1
        else:
            assert np.isfinite(rows).all(), "damage in a weight is no damage to the format"
    assert refusals > 20
