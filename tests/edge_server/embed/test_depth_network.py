"""Depth networks of the user's: what they are fed, what is taken from them, and files that are none."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnxruntime", reason="the extra embed is not installed")
pytest.importorskip("onnx", reason="the extra embed is not installed")

from onnx import TensorProto, helper

from edge_server.embed import EmbeddingError, open_depth_network
from edge_server.embed.depth_network import PATCH, SIDE
from edge_server.fields.registry import make_field
from edge_server.live.field_updater import open_updater
from edge_server.scheduler import make_policy
from edge_server.settings import read_config
from freshfield.scenario import ScenarioError, parse
from tests.edge_server.embed.graphs import save
from tests.support import refused

WEIGHTS = (0.5, -1.0, 2.0)


def weighted(path: Path, kind: type = np.float32) -> Path:
    """Of any size: the sum of the normalized channels with ``WEIGHTS``, (1, height, width)."""
    convolution = helper.make_node("Conv", ["images", "weights"], ["map"])
    nodes = [convolution, helper.make_node("Squeeze", ["map", "axis"], ["depth"])]
    constants = {"weights": np.array(WEIGHTS, kind).reshape(1, 3, 1, 1), "axis": np.array([1], np.int64)}
    types = {} if kind == np.float32 else {"kind": TensorProto.FLOAT16, "gives": TensorProto.FLOAT16}
    return save(path, nodes, ["n", 3, "h", "w"], ("depth", ["n", "h", "w"]), constants, **types)


def constant(path: Path, output: list[int], value: float = 1.0, channels: int = 3, kind: int = TensorProto.FLOAT):
    """Of 28 x 28 pixels: gives a constant of this shape."""
    constants = {"value": np.full(output, value, np.float32)}
    nodes = [helper.make_node("Identity", ["value"], ["depth"])]
    return save(path, nodes, [1, channels, 28, 28], ("depth", output), constants, kind=kind)


@pytest.mark.parametrize("kind", [np.float32, np.float16])
@pytest.mark.parametrize("shape", [(30, 50), (700, 20)])
def test_images_are_normalized_and_come_back_in_their_own_size(tmp_path: Path, shape: tuple[int, int], kind) -> None:
    network = open_depth_network(weighted(tmp_path / "a.onnx", kind))
    image = np.broadcast_to(np.array([200, 100, 50], np.uint8), (*shape, 3))
    sent = (np.array([200, 100, 50]) / 255.0 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    found = network(image)
    assert found.dtype == np.float32 and found.shape == shape
    np.testing.assert_allclose(found, sent @ np.array(WEIGHTS), rtol=1e-5 if kind == np.float32 else 1e-2)


def test_the_shorter_side_is_that_of_the_training_and_both_are_whole_patches(tmp_path: Path) -> None:
    network = open_depth_network(weighted(tmp_path / "a.onnx"))
    assert network._size(128, 128) == (SIDE, SIDE)
    assert network._size(480, 640) == (SIDE, 686) and 686 % PATCH == 0
    assert network._size(1, 4000)[1] <= 2.5 * SIDE, "what attention takes is bounded"
    one_size = open_depth_network(constant(tmp_path / "b.onnx", [1, 1, 28, 28], value=np.inf))
    assert one_size._size(480, 640) == (28, 28)
    assert np.isnan(one_size(np.zeros((20, 30, 3), np.uint8))).all(), "what is no number is told as none"


IDENTITY, HUGE = helper.make_node("Identity", ["images"], ["depth"]), [1, 3, 2**20, 14]
WRONG: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (lambda path: None, "cannot be read: No such file"),
    "no ONNX": (lambda path: path.write_bytes(b"PK\x03\x04 not an onnx"), "not an ONNX"),
    "gray": (lambda path: constant(path, [1, 28, 28], channels=1), "expected a model of images"),
    "whole numbers": (lambda path: constant(path, [1, 28, 28], kind=TensorProto.INT32), "expected a model of images"),
    "classes": (lambda path: constant(path, [1, 1000]), r"gave \(1, 1000\), not an inverse depth for each pixel"),
    "huge": (lambda path: save(path, [IDENTITY], HUGE, ("depth", HUGE), {}), "larger than 2048"),
}


@pytest.mark.stability
@pytest.mark.parametrize("name", WRONG)
def test_a_file_that_is_none_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    make, match = WRONG[name]
    make(tmp_path / "b.onnx")
    assert "b.onnx" in str(refused(EmbeddingError, match, open_depth_network, tmp_path / "b.onnx"))


def test_a_scenario_names_it(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    def opened(**edge: object) -> object:
        scenario = parse({"cameras": {"count": 2}, "edge": {"depth_network": "a.onnx", **edge}}, tmp_path / "a.yaml")
        config = read_config(scenario)
        field = make_field(config.field, config.field_options)
        open_updater(scenario, config, make_policy("all", None, np.random.default_rng(0)), field, 0)
        return field

    refused(ScenarioError, r"a.yaml: edge: depth_network: .*a.onnx: cannot be read", opened)
    weighted(tmp_path / "a.onnx")
    assert opened().depth_network.network.name == "a.onnx"
    assert "left unused" not in caplog.text
    opened(field="tensorf")
    assert "edge.depth_network is ignored: only splat in layers" in caplog.text
