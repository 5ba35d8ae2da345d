"""Finds the end of a YOLO detector's backbone in its ONNX graph, and cuts off the rest.

A YOLO detector has a backbone, which ends in a coarse feature map, and a neck, which first enlarges that map
and joins it with a finer one. So the backbone ends at the input of the first enlargement. This holds for
YOLOv8 (module 9), YOLO11 (module 10), quantized files and files whose nodes an optimizer has renamed. Neck
and head are not loaded.

The file may come from anywhere: it is checked, and what it asks for is bounded (``embedder.open_session``).
"""

from __future__ import annotations

import ast
import base64
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from google.protobuf.message import DecodeError
from numpy.typing import NDArray
from onnx import TensorProto, helper
from onnx.utils import Extractor

from edge_server.embed import EmbeddingError
from freshfield.untrusted import read_bytes

OUTPUT = "pooled"
# Twice the largest detectors of the family, 230 MB.
MAX_FILE_BYTES = 512 * 2**20
MAX_SIDE = 2048
# Three times the largest of the family, quantized. ONNX Runtime takes 1 s to load a chain of so many, 12 s of 30,000.
MAX_NODES = 10_000
# The training size of these detectors, unless the file states another.
USUAL_SIDE = 640
# Written by edge-server train-detector of tag v0.1-all: mean (C,) and axes (C, K) of the pooled features.
PROJECTION_KEY = "freshfield.projection"

_ENLARGE = ("Resize", "Upsample")
_PER_IMAGE = "DynamicQuantizeLinear"
_CONVOLVE = ("Conv", "ConvInteger", "QLinearConv")
_TYPES: dict[int, type[np.floating]] = {TensorProto.FLOAT: np.float32, TensorProto.FLOAT16: np.float16}


@dataclass(frozen=True)
class Backbone:
    """A detector up to its backbone's end: images (n, 3, height, width) in [0, 1] -> ``pooled`` (n,
    channels).

    model: the ONNX bytes.
    tap: the tensor that is pooled.
    batch: images per run; None: any number.
    digest: start of the source file's SHA-256.
    projection: float32 (C + C K,), a model's own mean (C,) and axes (C, K): embeddings are (features - mean) @ axes.
    """

    name: str
    model: bytes
    input: str
    dtype: type[np.floating]
    tap: str
    batch: int | None
    height: int
    width: int
    digest: str
    projection: NDArray[np.float32] | None = None


def load_backbone(path: Path) -> Backbone:
    """Load the detector at ``path``. Raises EmbeddingError."""
    data = _read(path)
    model = parse_model(data, path)
    meta = {p.key: p.value for p in model.metadata_props}
    image = _image_input(model, path)
    at = _find_end(model, path)
    cut = _cut(model, image.name, at, path)
    batch, _, *sides = (d.dim_value for d in cut.graph.input[0].type.tensor_type.shape.dim)
    height, width = input_size(sides, meta, path)
    return Backbone(
        name=path.stem,
        model=cut.SerializeToString(),
        input=image.name,
        dtype=_TYPES[image.type.tensor_type.elem_type],
        tap=at,
        batch=batch or None,
        height=height,
        width=width,
        digest=hashlib.sha256(data).hexdigest()[:8],
        projection=_projection(meta, path),
    )


def _read(path: Path) -> bytes:
    try:
        return read_bytes(path, MAX_FILE_BYTES)
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
    if len(model.graph.node) > MAX_NODES:
        raise EmbeddingError(
            f"{path}: has {len(model.graph.node)} nodes, more than any network of images ({MAX_NODES}); export the "
            "model again"
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
    if any(node.op_type == _PER_IMAGE and tap in node.output for node in cut.graph.node):
        raise EmbeddingError(
            f"{path}: {tap} is quantised with another scale for every image: export the model without that"
        )
    if not any(node.op_type in _CONVOLVE for node in cut.graph.node):
        raise EmbeddingError(f"{path}: no convolution lies between the images and {tap}")
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


def input_size(sides: Sequence[Any], meta: dict[str, str], path: Path) -> tuple[int, int]:
    """(height, width) of a model's input. Raises EmbeddingError.

    sides: as the model has them; a name or 0 where any will do: then those in the exporter's metadata, such as
        ``[640, 640]``, else USUAL_SIDE.
    """
    height, width = (side if isinstance(side, int) else 0 for side in sides)
    if not (height and width):
        try:
            height, width = (int(side) for side in ast.literal_eval(meta["imgsz"]))
        except (KeyError, ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
            height = width = USUAL_SIDE
    if not (1 <= height <= MAX_SIDE and 1 <= width <= MAX_SIDE):
        raise EmbeddingError(f"{path}: images of {width} x {height} are not within 1 to {MAX_SIDE} a side")
    return height, width


def _projection(meta: dict[str, str], path: Path) -> NDArray[np.float32] | None:
    """The projection that a model of ours carries in its metadata; None without one."""
    if PROJECTION_KEY not in meta:
        return None
    try:
        values = np.frombuffer(base64.b64decode(meta[PROJECTION_KEY], validate=True), "<f4")
    except ValueError:
        values = np.full(1, np.nan)
    if not np.isfinite(values).all():
        raise EmbeddingError(f"{path}: its projection is damaged: fetch the file again")
    return values.astype(np.float32)
