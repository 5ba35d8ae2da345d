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


def refused(path, match: str, **options) -> None:
    with pytest.raises(EmbeddingError, match=match) as caught:
        make_embedder(EmbeddingConfig(model=str(path), **{"dim": 4, **options}))
    assert "\n" not in str(caught.value)


def node(kind: str, read: list[str], write: str, **attributes):
    return helper.make_node(kind, read, [write], name=f"/model.1/{write}", **attributes)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04not an onnx", b"\x00" * 4096, b"\xff" * 64])
def test_not_onnx(tmp_path, content):
    path = tmp_path / "a.onnx"
    refused(path, "a.onnx: cannot be read: No such file")
    path.write_bytes(content)
    refused(path, "a.onnx: not an ONNX")
    path.write_bytes(detector(tmp_path / "whole.onnx").read_bytes()[: -len(content) - 1])
    refused(path, "a.onnx: ")


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


def test_a_classifier_and_a_plain_enlargement_are_no_detectors(tmp_path):
    refused(detector(tmp_path / "c.onnx", neck=False), "not a YOLO detection model")
    model = onnx.load(str(detector(tmp_path / "d.onnx")))
    model.graph.node[5].CopyFrom(node("Relu", ["large"], "joined"))  # enlarged, but joined with nothing
    onnx.save(model, str(tmp_path / "e.onnx"))
    refused(tmp_path / "e.onnx", "not a YOLO detection model")


def test_a_backbone_quantised_image_by_image_cannot_be_averaged(tmp_path):
    quantised = helper.make_node("DynamicQuantizeLinear", ["end"], ["q", "scale", "zero"])
    refused(detector(tmp_path / "q.onnx", extra=(quantised,)), "q is quantised with another scale for every image")


def test_inputs_of_another_kind(tmp_path):
    model = onnx.load(str(detector(tmp_path / "d.onnx")))
    for shape, kind in (
        ([1, 1, 32, 32], TensorProto.FLOAT),
        ([1, 3, 32], TensorProto.FLOAT),
        ([1, 3, 32, 32], TensorProto.INT64),
    ):
        model.graph.input[0].CopyFrom(helper.make_tensor_value_info("images", kind, shape))
        onnx.save(model, str(tmp_path / "i.onnx"))
        refused(tmp_path / "i.onnx", "input images is not")
    model.graph.input.append(helper.make_tensor_value_info("text", TensorProto.FLOAT, [1]))
    onnx.save(model, str(tmp_path / "i.onnx"))
    refused(tmp_path / "i.onnx", "expected one input, the images; it has 2: images, text")


def memory_from_nothing(path: Path, kind: str) -> None:
    huge = numpy_helper.from_array(np.array([1, 1, 200_000, 200_000], np.int64), "huge")
    detector(path, extra=(node(kind, ["end", "huge"], "big"),), weights=(huge,))


def joined_with_themselves(path: Path) -> None:
    nodes = tuple(node("Concat", [f"t{k}" if k else "end"] * 2, f"t{k + 1}", axis=1) for k in range(40))
    detector(path, extra=nodes)


def long_chain(path: Path) -> None:
    detector(path, extra=tuple(node("Relu", [f"t{k}" if k else "end"], f"t{k + 1}") for k in range(MAX_NODES)))


def padding(path: Path) -> None:
    kernel = numpy_helper.from_array(np.ones((1, 6, 1, 1), np.float32), "k")
    detector(path, extra=(node("Conv", ["end", "k"], "big", pads=[100_000] * 4),), weights=(kernel,))


def empty_claims(path: Path, dims: tuple[int, ...]) -> None:
    claims = TensorProto(name="k", data_type=TensorProto.FLOAT, dims=dims, raw_data=b"\0" * 8)
    detector(path, extra=(node("Mul", ["end", "k"], "big"),), weights=(claims,))


# What would take more memory than there is, and how it is refused.
BOMBS = {
    "image": (partial(detector, size=1_000_000), "1000000 x 1000000 are not within"),
    **{
        kind: (partial(memory_from_nothing, kind=kind), f"backbone holds {kind}, which no YOLO backbone does")
        for kind in ("Expand", "Tile")
    },
    "concat": (joined_with_themselves, "larger than any backbone's"),
    "chain": (long_chain, "10007 nodes, more than any network of images"),
    "padding": (padding, "larger than any backbone's"),
    "claims": (partial(empty_claims, dims=(2**20, 2**20)), "larger than any backbone's"),
    "small claims": (partial(empty_claims, dims=(1, 6, 8, 8)), "cannot load it"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_refused(tmp_path, name):
    make, match = BOMBS[name]
    make(tmp_path / "b.onnx")
    refused(tmp_path / "b.onnx", match)


def test_a_damaged_projection(tmp_path):
    for text in ("!", "AAAA", "AAAAAAAA" * 11):
        path = detector(tmp_path / "p.onnx", meta={"freshfield.projection": text})
        refused(path, "projection is damaged")


def test_what_breaks_when_it_is_run_is_said_once_and_by_us(tmp_path, capfd):
    """ONNX Runtime would print, in red, what it then raises."""
    beyond = numpy_helper.from_array(np.array([0, 1, 2, 99], np.int64), "beyond")
    gather = node("Gather", ["end", "beyond"], "some", axis=1)
    path = detector(tmp_path / "g.onnx", extra=(gather,), weights=(beyond,))
    refused(path, "ONNX Runtime cannot run it")
    assert capfd.readouterr() == ("", "")
