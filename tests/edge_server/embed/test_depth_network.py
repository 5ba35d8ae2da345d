"""Depth networks of the user's: what they are fed, what is taken from them, and files that are none."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnxruntime", reason="the extra embed is not installed")
onnx = pytest.importorskip("onnx", reason="the extra embed is not installed")

from onnx import TensorProto, helper  # noqa: E402

from edge_server.embed import EmbeddingError, open_depth_network  # noqa: E402
from edge_server.embed.depth_network import PATCH, SIDE  # noqa: E402
from edge_server.fields.registry import make_field  # noqa: E402
from edge_server.live.field_updater import open_updater  # noqa: E402
from edge_server.scheduler import make_policy  # noqa: E402
from edge_server.settings import read_config  # noqa: E402
from freshfield.scenario import ScenarioError, parse  # noqa: E402
from tests.edge_server.embed.depth_graphs import graph, remembering, weighted  # noqa: E402

WEIGHTS = (0.5, -1.0, 2.0)


@pytest.mark.parametrize("kind", [np.float32, np.float16])
@pytest.mark.parametrize("shape", [(30, 50), (128, 128), (700, 20)])
def test_images_are_normalized_and_come_back_in_their_own_size(tmp_path: Path, shape: tuple[int, int], kind) -> None:
    network = open_depth_network(weighted(tmp_path / "a.onnx", WEIGHTS, kind))
    image = np.broadcast_to(np.array([200, 100, 50], np.uint8), (*shape, 3))
    sent = (np.array([200, 100, 50]) / 255.0 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    found = network(image)
    assert found.dtype == np.float32 and found.shape == shape
    np.testing.assert_allclose(found, sent @ np.array(WEIGHTS), rtol=1e-5 if kind == np.float32 else 1e-2)


def test_the_shorter_side_is_that_of_the_training_and_both_are_whole_patches(tmp_path: Path) -> None:
    network = open_depth_network(weighted(tmp_path / "a.onnx", WEIGHTS))
    assert network._size(128, 128) == (SIDE, SIDE)
    assert network._size(480, 640) == (SIDE, 686) and 686 % PATCH == 0
    assert network._size(1, 4000)[1] <= 2.5 * SIDE, "what attention takes is bounded"


def test_a_model_of_one_size_is_fed_that(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    images = rng.integers(0, 256, (3, 42, 42, 3), dtype=np.uint8)
    relative = rng.random((3, 42, 42), dtype=np.float32)
    network = open_depth_network(remembering(tmp_path / "a.onnx", images, relative, 42))
    for image, depth in zip(images, relative):
        np.testing.assert_allclose(network(image), depth, atol=1e-4)


def _constant(path: Path, output: list[int], value: float = 1.0, channels: int = 3, kind: int = TensorProto.FLOAT):
    """Of 28 x 28 pixels: gives a constant of this shape."""
    constants = {"value": np.full(output, value, np.float32), "none": np.float32(0)}
    nodes = [
        helper.make_node("Cast", ["pixel_values"], ["floats"], to=TensorProto.FLOAT),
        helper.make_node("ReduceMean", ["floats"], ["mean"], keepdims=0),
        helper.make_node("Mul", ["mean", "none"], ["zero"]),
        helper.make_node("Add", ["value", "zero"], ["predicted_depth"]),
    ]
    return graph(path, nodes, [1, channels, 28, 28], output, constants, kind)


WRONG: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (lambda path: None, "cannot be read: No such file"),
    "no ONNX": (lambda path: path.write_bytes(b"PK\x03\x04 not an onnx"), "not an ONNX"),
    "gray": (lambda path: _constant(path, [1, 28, 28], channels=1), "expected a model of images"),
    "whole numbers": (lambda path: _constant(path, [1, 28, 28], kind=TensorProto.INT32), "expected a model of images"),
    "classes": (lambda path: _constant(path, [1, 1000]), r"gave \(1, 1000\), not an inverse depth for each pixel"),
    "huge": (lambda path: graph(path, [_identity()], [1, 3, 2**20, 14], [1, 3, 2**20, 14], {}), "larger than 2048"),
}


def _identity() -> onnx.NodeProto:
    return helper.make_node("Identity", ["pixel_values"], ["predicted_depth"])


@pytest.mark.stability
@pytest.mark.parametrize("name", WRONG)
def test_a_file_that_is_none_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    make, match = WRONG[name]
    make(tmp_path / "b.onnx")
    with pytest.raises(EmbeddingError, match=match) as caught:
        open_depth_network(tmp_path / "b.onnx")
    assert "\n" not in str(caught.value) and "b.onnx" in str(caught.value)


@pytest.mark.stability
def test_what_is_no_number_is_told_as_none(tmp_path: Path) -> None:
    network = open_depth_network(_constant(tmp_path / "a.onnx", [1, 1, 28, 28], value=np.inf))
    assert np.isnan(network(np.zeros((20, 30, 3), np.uint8))).all()


def test_a_scenario_names_it(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    def opened(**edge: object) -> object:
        section = {"depth_network": "a.onnx", **edge}
        given = {"name": "a", "cameras": {"count": 2}, "source": {"kind": "world"}, "edge": section}
        scenario = parse(given, tmp_path / "a.yaml")
        config = read_config(scenario)
        field = make_field(config.field, config.field_options)
        open_updater(scenario, config, make_policy("all", None, np.random.default_rng(0)), field, 0)
        return field

    with pytest.raises(ScenarioError, match=r"a.yaml: edge: depth_network: .*a.onnx: cannot be read"):
        opened()
    weighted(tmp_path / "a.onnx", WEIGHTS)
    assert opened().depth_network.network.name == "a.onnx"
    assert "left unused" not in caplog.text
    opened(field="tensorf")
    assert "edge.depth_network is left unused: only splat in layers" in caplog.text
