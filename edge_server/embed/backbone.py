"""Finds the end of a YOLO detector's backbone in its ONNX graph, and cuts off the rest.

A YOLO detector has a backbone, which ends in a coarse feature map, and a neck, which first enlarges that map
and joins it with a finer one. So the backbone ends at the input of the first enlargement. This holds for
YOLOv8 (module 9), YOLO11 (module 10), quantized files and files whose nodes an optimizer has renamed. Neck
and head are not loaded.

The file may come from anywhere: it is checked before anything in it is run or allocated.
"""

from __future__ import annotations

import ast
import hashlib
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
from google.protobuf.message import DecodeError
from onnx import TensorProto, helper
from onnx.utils import Extractor

from edge_server import edge_constants as tuned
from edge_server.embed import EmbeddingError
from edge_server.embed.projection import Projection, stored_projection
from freshfield.untrusted import read_bytes

OUTPUT = "pooled"
# The training size of these detectors, unless the file states another.
USUAL_SIDE = 640

_ENLARGE = ("Resize", "Upsample")
_CONVOLVE = ("Conv", "ConvInteger", "QLinearConv")
# Operators of backbones. Those whose output size is in their data (Expand, Tile, ConstantOfShape, Range,
# loops) are missing: a few bytes could request any amount of memory.
_KNOWN = """
Abs Add AveragePool BatchNormalization Cast Clip Concat Constant Conv ConvInteger DequantizeLinear Div
DynamicQuantizeLinear Elu Exp Flatten Gather GlobalAveragePool HardSigmoid HardSwish Identity LeakyRelu MatMul
MatMulInteger MaxPool Mish Mul PRelu Pow QLinearConv QuantizeLinear ReduceMean ReduceMax Relu Reshape Shape Sigmoid
Slice Softmax Softplus Split Sqrt Squeeze Sub Tanh Transpose Unsqueeze
"""
_TYPES: dict[int, type[np.floating]] = {TensorProto.FLOAT: np.float32, TensorProto.FLOAT16: np.float16}


@dataclass(frozen=True)
class Backbone:
    """A detector up to its backbone's end: images (n, 3, height, width) in [0, 1] -> ``pooled`` (n,
    channels).

    model: the ONNX bytes.
    tap: the tensor that is pooled.
    batch: images per run; None: any number.
    digest: start of the source file's SHA-256.
    """

    name: str
    model: bytes
    input: str
    dtype: type[np.floating]
    tap: str
    channels: int
    batch: int | None
    height: int
    width: int
    digest: str
    projection: Projection | None = None


def load_backbone(path: Path) -> Backbone:
    """Load the detector at ``path``. Raises EmbeddingError."""
    data = _read(path)
    model = parse_model(data, path)
    meta = {p.key: p.value for p in model.metadata_props}
    image = _image_input(model, path)
    at = _find_end(model, path)
    cut = _cut(model, image.name, at, path)
    batch, _, height, width = (d.dim_value for d in cut.graph.input[0].type.tensor_type.shape.dim)
    height, width = input_size(height, width, meta, path)
    channels = _check_shapes(cut, batch or 1, height, width, path)
    return Backbone(
        name=path.stem,
        model=cut.SerializeToString(),
        input=image.name,
        dtype=_TYPES[image.type.tensor_type.elem_type],
        tap=at,
        channels=channels,
        batch=batch or None,
        height=height,
        width=width,
        digest=hashlib.sha256(data).hexdigest()[:8],
        projection=stored_projection(meta, channels, path),
    )


def _read(path: Path) -> bytes:
    try:
        return read_bytes(path, tuned.MAX_MODEL_FILE_BYTES)
    except OSError as error:
        raise EmbeddingError(
            f"{path}: cannot be read: {error.strerror}; name a YOLO detection model in ONNX format"
        ) from None


def parse_model(data: bytes, path: Path) -> onnx.ModelProto:
    """The model of an ONNX file, without subgraphs: a loop of 2^62 rounds fits into a hundred bytes. Raises
    EmbeddingError."""
    try:
        model = onnx.load_model_from_string(data)
    except (DecodeError, ValueError, RuntimeError):
        raise EmbeddingError(f"{path}: not an ONNX file, or cut short; export the model again") from None
    if not model.graph.node or not model.opset_import:
        raise EmbeddingError(f"{path}: not an ONNX model; export the model again")
    if len(model.graph.node) > tuned.MAX_GRAPH_NODES:
        raise EmbeddingError(
            f"{path}: has {len(model.graph.node)} nodes, more than any network of images ({tuned.MAX_GRAPH_NODES}); "
            "export the model again"
        )
    loops = sorted({n.op_type for n in model.graph.node for a in n.attribute if a.HasField("g") or a.graphs})
    if loops or model.functions:
        raise EmbeddingError(
            f"{path}: holds {', '.join(loops) or 'functions'}, which no network of images needs; export it "
            "without control flow"
        )
    words = [w for n in model.graph.node for w in (n.op_type, n.name, *n.input, *n.output)]
    words += [named.name for part in (model.graph.initializer, model.graph.input) for named in part]
    if not all(isinstance(word, str) for word in words):  # bytes: no UTF-8
        raise EmbeddingError(f"{path}: a damaged ONNX file; export the model again")
    if any(t.data_location == TensorProto.EXTERNAL for t in model.graph.initializer):
        raise EmbeddingError(f"{path}: its weights lie in a second file; export the model as one file")
    return model


def _image_input(model: onnx.ModelProto, path: Path) -> onnx.ValueInfoProto:
    weights = {t.name for t in model.graph.initializer}
    inputs = [i for i in model.graph.input if i.name not in weights]
    if len(inputs) != 1:
        names = ", ".join(i.name for i in inputs) or "none"
        raise EmbeddingError(f"{path}: expected one input, the images; it has {len(inputs)}: {names}")
    kind = inputs[0].type.tensor_type
    shape = [d.dim_value for d in kind.shape.dim]
    if kind.elem_type not in _TYPES or len(shape) != 4 or shape[1] not in (0, 3):
        raise EmbeddingError(
            f"{path}: the input {inputs[0].name} is not (n, 3, height, width) of float32 or float16: this is "
            "not a YOLO detection model"
        )
    return inputs[0]


def _find_end(model: onnx.ModelProto, path: Path) -> str:
    """Name of the tensor at the backbone's end."""
    nodes = model.graph.node
    readers: dict[str, list[onnx.NodeProto]] = {}
    for node in nodes:
        for name in node.input:
            readers.setdefault(name, []).append(node)
    seen: set[str] = set()  # after a convolution; an enlargement before any is preprocessing
    for node in nodes:
        behind = node.op_type in _CONVOLVE or any(i in seen for i in node.input)
        if node.op_type in _ENLARGE and behind and _is_joined(node, readers):
            return node.input[0]
        if behind:
            seen.update(node.output)
    raise EmbeddingError(
        f"{path}: no neck that enlarges and joins feature maps was found, so this is not a YOLO detection model"
    )


def _is_joined(node: onnx.NodeProto, readers: dict[str, list[onnx.NodeProto]]) -> bool:
    """Whether an enlarged map is joined with another, possibly after quantization."""
    following = [reader for name in node.output for reader in readers.get(name, [])]
    return any(
        reader.op_type == "Concat"
        or (reader.op_type in ("QuantizeLinear", "DequantizeLinear", "Cast") and _is_joined(reader, readers))
        for reader in following
    )


def _cut(model: onnx.ModelProto, image: str, tap: str, path: Path) -> onnx.ModelProto:
    """The graph from the images to the mean of the tensor ``tap`` over the image."""
    # Exported shapes may be wrong for another size, but the extractor needs an entry per tap.
    model.graph.name = "backbone"
    del model.graph.value_info[:]
    model.graph.value_info.append(helper.make_empty_tensor_value_info(tap))
    try:
        cut = Extractor(model).extract_model([image], [tap])
    except (ValueError, AssertionError) as error:
        raise EmbeddingError(f"{path}: the backbone cannot be cut out: {error}") from None
    unknown = sorted({node.op_type for node in cut.graph.node}.difference(_KNOWN.split()))
    if unknown or cut.functions:
        raise EmbeddingError(
            f"{path}: the backbone holds {', '.join(unknown) or 'functions'}, which no YOLO backbone does"
        )
    if any(node.op_type == "DynamicQuantizeLinear" and tap in node.output for node in cut.graph.node):
        raise EmbeddingError(
            f"{path}: {tap} is quantised with another scale for every image: export the model without that"
        )
    del cut.graph.value_info[:]
    del cut.graph.output[:]
    # A statically quantized map holds integers, with the same offset and scale in every image.
    cut.graph.node.extend(
        [
            helper.make_node("Cast", [tap], ["pooled.float"], to=TensorProto.FLOAT),
            helper.make_node("GlobalAveragePool", ["pooled.float"], ["pooled.mean"]),
            helper.make_node("Flatten", ["pooled.mean"], [OUTPUT]),
        ]
    )
    cut.graph.output.append(helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, None))
    return cut


def input_size(height: int, width: int, meta: dict[str, str], path: Path) -> tuple[int, int]:
    """(height, width) of a model's images: where its input leaves them open (0), those in the exporter's metadata, such
    as ``[640, 640]``, else USUAL_SIDE. EmbeddingError for a size that no image has."""
    if not (height and width):
        try:
            height, width = (int(side) for side in ast.literal_eval(meta["imgsz"]))
        except (KeyError, ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
            height = width = USUAL_SIDE
    if not (1 <= height <= tuned.MAX_MODEL_SIDE_PX and 1 <= width <= tuned.MAX_MODEL_SIDE_PX):
        raise EmbeddingError(
            f"{path}: images of {width} x {height} are not within 1 to {tuned.MAX_MODEL_SIDE_PX} a side"
        )
    return height, width


def _check_shapes(cut: onnx.ModelProto, batch: int, height: int, width: int, path: Path) -> int:
    """Number of channels of the tap. EmbeddingError: a tensor is larger than in any YOLO backbone."""
    fed = onnx.ModelProto()
    fed.CopyFrom(cut)
    for dim, value in zip(fed.graph.input[0].type.tensor_type.shape.dim, (batch, 3, height, width)):
        dim.Clear()
        dim.dim_value = value
    try:
        known = onnx.shape_inference.infer_shapes(fed, data_prop=True)
    except (onnx.shape_inference.InferenceError, RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split())[:160]
        raise EmbeddingError(f"{path}: takes no images of {width} x {height}: {reason}") from None
    shapes = {v.name: [d.dim_value for d in v.type.tensor_type.shape.dim] for v in known.graph.value_info}
    shapes |= {t.name: list(t.dims) for t in cut.graph.initializer}
    for name, shape in shapes.items():
        if math.prod(max(d, 1) for d in shape) > tuned.MAX_TENSOR_ELEMENTS * batch:
            raise EmbeddingError(f"{path}: the tensor {name} of shape {shape} is larger than any backbone's")
    pooled = shapes.get("pooled.float", [])
    if len(pooled) != 4 or pooled[1] < 1:
        raise EmbeddingError(
            f"{path}: the backbone's end is not a feature map (n, channels, height, width) but {pooled or 'unknown'}"
        )
    return int(pooled[1])
