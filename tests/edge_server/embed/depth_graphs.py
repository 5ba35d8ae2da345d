"""ONNX graphs of a depth network's form, for tests: no weights of a real one can be had here."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from edge_server.embed.depth_network import DEVIATION, MEAN


def graph(
    path: Path,
    nodes: list,
    image: list,
    output: list,
    constants: dict[str, NDArray],
    kind: int = TensorProto.FLOAT,
    gives: int = TensorProto.FLOAT,
) -> Path:
    """Write a model from ``pixel_values`` (of shape ``image``, type ``kind``) to ``predicted_depth`` (``output``,
    ``gives``)."""
    made = helper.make_graph(
        nodes,
        path.stem,
        [helper.make_tensor_value_info("pixel_values", kind, image)],
        [helper.make_tensor_value_info("predicted_depth", gives, output)],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    path.write_bytes(
        helper.make_model(made, opset_imports=[helper.make_opsetid("", 17)], ir_version=8).SerializeToString()
    )
    return path


def weighted(path: Path, weights: tuple[float, float, float], kind: type = np.float32) -> Path:
    """Of any size: the sum of the normalized channels with these weights, (1, height, width)."""
    onnx_kind = TensorProto.FLOAT if kind == np.float32 else TensorProto.FLOAT16
    nodes = [
        helper.make_node("Conv", ["pixel_values", "weights"], ["map"]),
        helper.make_node("Squeeze", ["map", "axis"], ["predicted_depth"]),
    ]
    constants = {"weights": np.array(weights, kind).reshape(1, 3, 1, 1), "axis": np.array([1], np.int64)}
    return graph(path, nodes, ["n", 3, "h", "w"], ["n", "h", "w"], constants, onnx_kind, onnx_kind)


def remembering(path: Path, images: NDArray[np.uint8], relative: NDArray[np.float32], side: int = 126) -> Path:
    """Of one size: ``relative`` (N, H, W) of that of ``images`` (N, H, W, 3) which is most like the given one."""
    small = np.stack([cv2.resize(i, (side, side), interpolation=cv2.INTER_CUBIC) for i in images]) / 255.0
    keys = ((small - MEAN) / DEVIATION).transpose(0, 3, 1, 2).reshape(len(images), -1).astype(np.float32)
    values = np.stack([cv2.resize(r, (side, side), interpolation=cv2.INTER_LINEAR) for r in relative])
    nodes = [
        helper.make_node("Reshape", ["pixel_values", "row"], ["flat"]),
        helper.make_node("MatMul", ["flat", "keys"], ["dots"]),
        helper.make_node("Sub", ["dots", "halves"], ["likeness"]),
        helper.make_node("Softmax", ["likeness"], ["which"]),
        helper.make_node("MatMul", ["which", "values"], ["found"]),
        helper.make_node("Reshape", ["found", "map"], ["predicted_depth"]),
    ]
    constants = {
        "row": np.array([1, -1], np.int64),
        "keys": np.ascontiguousarray(keys.T),
        "halves": 0.5 * (keys**2).sum(axis=1)[None],
        "values": values.reshape(len(images), -1).astype(np.float32),
        "map": np.array([1, side, side], np.int64),
    }
    return graph(path, nodes, [1, 3, side, side], [1, side, side], constants)
