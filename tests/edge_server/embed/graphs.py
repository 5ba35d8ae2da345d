"""Small ONNX graphs of a detector's form, and of forms that are none, for the embedder's tests."""

from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch.nn.functional import conv2d

CHANNELS = 6


def save(
    path: Path,
    nodes,
    images: list,
    output: tuple[str, list | None],
    constants: dict[str, np.ndarray],
    weights: tuple[onnx.TensorProto, ...] = (),
    opset: int = 17,
    meta: dict[str, str] | None = None,
    further: tuple[tuple[str, list], ...] = (),
    kind: int = TensorProto.FLOAT,
    gives: int = TensorProto.FLOAT,
) -> Path:
    """Write a graph from ``images`` (of this shape, type ``kind``) to ``output`` (name and shape), and ``further``
    ones, of type ``gives``."""
    graph = helper.make_graph(
        nodes,
        path.stem,
        [helper.make_tensor_value_info("images", kind, images)],
        [helper.make_tensor_value_info(name, gives, shape) for name, shape in (output, *further)],
        [*(numpy_helper.from_array(value, name) for name, value in constants.items()), *weights],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)
    helper.set_model_props(model, meta or {})
    path.write_bytes(model.SerializeToString())
    return path


def convolutions() -> list[np.ndarray]:
    rng = np.random.default_rng(7)
    return [rng.normal(0, 0.3, shape).astype(np.float32) for shape in ((4, 3, 3, 3), (CHANNELS, 4, 3, 3))]


def detector(
    path: Path,
    size: int | None = 32,
    batch: int | None = None,
    neck: bool = True,
    extra: tuple[onnx.NodeProto, ...] = (),
    weights: tuple[onnx.TensorProto, ...] = (),
    meta: dict[str, str] | None = None,
) -> Path:
    """Two convolutions, and where ``neck``, an enlargement that is joined with the finer map.

    size, batch: None makes them free. extra: nodes behind the backbone's
    end, which is called ``end``. Weights are the same in every file.
    """
    first, second = convolutions()
    nodes = [
        helper.make_node("Conv", ["images", "a"], ["c0"], strides=[2, 2], pads=[1] * 4, name="/model.0/Conv"),
        helper.make_node("Relu", ["c0"], ["fine"], name="/model.0/Relu"),
        helper.make_node("Conv", ["fine", "b"], ["end"], strides=[2, 2], pads=[1] * 4, name="/model.1/Conv"),
        *extra,
    ]
    last = extra[-1].output[0] if extra else "end"
    if neck:
        nodes += [
            helper.make_node("Resize", [last, "", "scales"], ["large"], mode="nearest", name="/model.2/Resize"),
            helper.make_node("Concat", ["large", "fine"], ["joined"], axis=1, name="/model.3/Concat"),
            # A head that cannot run shows that it is not run.
            helper.make_node("Reshape", ["joined", "impossible"], ["output0"], name="/model.4/Reshape"),
        ]
    constants = {"a": first, "b": second, "scales": np.array([1, 1, 2, 2], np.float32)}
    constants["impossible"] = np.array([7, 11, 13], np.int64)
    images, output = [batch or "n", 3, size or "h", size or "w"], "output0" if neck else last
    return save(path, nodes, images, (output, None), constants, weights, meta=meta)


def expected(images: np.ndarray) -> np.ndarray:
    """The pooled features (n, CHANNELS) of ready-made input (n, 3, H, W), by torch."""
    first, second = map(torch.from_numpy, convolutions())
    fine = conv2d(torch.from_numpy(images).float(), first, stride=2, padding=1).relu()
    return conv2d(fine, second, stride=2, padding=1).mean(dim=(2, 3)).numpy()
