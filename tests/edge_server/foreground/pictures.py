"""Pictures whose foreground is known, and small ONNX models made for the test."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def disc(height: int, width: int, center: tuple[int, int], radius: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """(picture (H, W, 3), truth (H, W)): an orange disc on a noisy blue ground; center is (row, column)."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:height, :width]
    truth = (y - center[0]) ** 2 + (x - center[1]) ** 2 <= radius**2
    picture = np.where(truth[..., None], (230, 120, 20), (40, 70, 160)) + rng.normal(0, 8, (height, width, 3))
    return picture.clip(0, 255).astype(np.uint8), truth


def iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def save_orange_detector(path: Path, masks: bool = True) -> Path:
    """An ONNX with a YOLO head's output: one cell a pixel of an 8 x 8 grid, of which those on orange score,
    with boxes of 40 pixels around them. masks: of a segmentation model, orange at a quarter of the side;
    False: a detection model without them."""
    from onnx import helper

    from tests.edge_server.embed.graphs import save

    grid, side, kinds = 8, 64, ("apple", "orange", "pear")
    step = side // grid
    centers = (np.arange(grid) + 0.5) * step
    x, y = np.meshgrid(centers, centers)
    boxes = np.stack([x.ravel(), y.ravel(), np.full(grid * grid, 40.0), np.full(grid * grid, 40.0)])
    # Orange: much red, little blue. Score of kind 1; the others get none.
    weight = np.array([1.0, 0.0, -1.0], np.float32).reshape(1, 3, 1, 1)
    nodes = [
        helper.make_node("AveragePool", ["images"], ["pooled"], kernel_shape=[step] * 2, strides=[step] * 2),
        helper.make_node("Conv", ["pooled", "weight"], ["orange"]),
        helper.make_node("Relu", ["orange"], ["score"]),
        helper.make_node("Reshape", ["score", "flat"], ["row"]),
        helper.make_node("Mul", ["row", "spread"], ["scores"]),
        helper.make_node("Concat", ["boxes", "scores", *["ones"] * masks], ["output0"], axis=1),
    ]
    spread = np.zeros((1, len(kinds), 1), np.float32)
    spread[0, 1] = 1.0
    constants = {
        "weight": weight,
        "flat": np.array([1, 1, grid * grid], np.int64),
        "spread": spread,
        "boxes": boxes[None].astype(np.float32),
    }
    if masks:
        constants |= {"ones": np.ones((1, 1, grid * grid), np.float32), "half": np.float32([0.17])}
        nodes += [
            helper.make_node("AveragePool", ["images"], ["fine"], kernel_shape=[4, 4], strides=[4, 4]),
            helper.make_node("Conv", ["fine", "weight"], ["fine_orange"]),
            helper.make_node("Sub", ["fine_orange", "half"], ["output1"]),
        ]
    shape = [1, 4 + len(kinds) + masks, grid * grid]
    meta = {"names": str(dict(enumerate(kinds)))}
    further = (("output1", [1, 1, side // 4, side // 4]),) if masks else ()
    return save(path, nodes, [1, 3, side, side], ("output0", shape), constants, opset=13, meta=meta, further=further)


def save_memory_bomb(path: Path, kind: str) -> Path:
    """A segmentation ONNX with one tensor of 400 TB. kind: Expand or Conv."""
    from onnx import helper

    from tests.edge_server.embed.graphs import save

    constants = {"shape": np.array([2**33, 3, 64, 64]), "weight": np.ones((1, 3, 1, 1), np.float32)}
    read = {"Expand": ["images", "shape"], "Conv": ["images", "weight"]}[kind]
    nodes = [
        helper.make_node(kind, read, ["large"], **({"pads": [5_000_000] * 4} if kind == "Conv" else {})),
        helper.make_node("Cast", ["large"], ["floats"], to=1),
        helper.make_node("ReduceMax", ["floats"], ["most"], keepdims=0),
        helper.make_node("Mul", ["images", "most"], ["lit"]),
        helper.make_node("Conv", ["lit", "weight"], ["map"]),
        helper.make_node("AveragePool", ["images"], ["masks"], kernel_shape=[4, 4], strides=[4, 4]),
    ]
    further = (("masks", [1, 3, 16, 16]),)
    return save(path, nodes, [1, 3, 64, 64], ("map", [1, 1, 64, 64]), constants, opset=13, further=further)


def save_endless_loop(path: Path) -> Path:
    """A segmentation ONNX that goes round 2^62 times before it answers."""
    from onnx import TensorProto, helper

    from tests.edge_server.embed.graphs import save

    value, image, truth = helper.make_tensor_value_info, [1, 3, 64, 64], TensorProto.BOOL
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["on"]), helper.make_node("Sin", ["x"], ["y"])],
        "round",
        [value("i", TensorProto.INT64, []), value("go", truth, []), value("x", TensorProto.FLOAT, image)],
        [value("on", truth, []), value("y", TensorProto.FLOAT, image)],
    )
    weight = np.ones((1, 3, 1, 1), np.float32)
    constants = {"rounds": np.array(2**62), "true": np.array(True), "weight": weight}
    nodes = [
        helper.make_node("Loop", ["rounds", "true", "images"], ["turned"], body=body),
        helper.make_node("Conv", ["turned", "weight"], ["map"]),
    ]
    return save(path, nodes, image, ("map", [1, 1, 64, 64]), constants, opset=13)
