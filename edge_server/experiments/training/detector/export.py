"""Exports the trained detector to ONNX, in float32 and static 8 bits, with its projection for embeddings."""

from __future__ import annotations

import contextlib
import logging
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import torch
from numpy.typing import NDArray
from onnx import helper
from onnxruntime.quantization import CalibrationDataReader, CalibrationMethod, QuantFormat, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process

from edge_server.embed.backbone import OUTPUT, PROJECTION_KEY, load_backbone, pack_projection
from edge_server.experiments.training.detector.average_precision import Run
from edge_server.experiments.training.detector.dataset import network_inputs
from edge_server.experiments.training.detector.network import Detector
from edge_server.experiments.training.detector.scenes import KINDS

OPSET = 17
INPUT = "images"
CALIBRATION_IMAGES = 128
_BATCH = 32
# Number of axes of the learned projection: the largest dimension of an embedding.
AXES = 64
# Least spread of an axis, relative to the first, so that scaling does not amplify one without information.
_LEAST_SPREAD = 1e-3


def export_fp32(model: Detector, side: int, path: Path, about: dict[str, Any], kinds: Sequence[str] = KINDS) -> None:
    """Export the detector for any number of images of any size whose sides are multiples of 16."""
    model = model.eval()
    axes = {INPUT: {0: "n", 2: "height", 3: "width"}, "output0": {0: "n", 2: "cells"}}
    if model.prototypes:
        axes["output1"] = {0: "n", 2: "mask_height", 3: "mask_width"}
    with warnings.catch_warnings():
        # The newer exporter needs an additional package and gives the same operators.
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            model,
            (torch.zeros(1, 3, side, side),),
            str(path),
            dynamo=False,
            opset_version=OPSET,
            input_names=[INPUT],
            output_names=[name for name in axes if name != INPUT],
            dynamic_axes=axes,
        )
    exported = onnx.load(str(path))
    onnx.checker.check_model(exported)
    task = "segment" if model.prototypes else "detect"
    _describe(exported, side, {"task": task, **about}, kinds)
    onnx.save(exported, str(path))


def export_int8(fp32: Path, images: NDArray[np.uint8], path: Path) -> None:
    """Quantize to static 8 bits, weights per channel, with ranges calibrated on ``images`` (n, H, W, 3).

    The arithmetic of the boxes stays in float: pixel coordinates do not fit in 8 bits.
    """
    model = onnx.load(str(fp32))
    heads = ("/model.10/", "/model.11/")
    # Not quantized: the last convolutions of the heads and of the prototypes, and what follows them, because
    # logits and distances need their full range.
    inner = [n.name for n in model.graph.node if not n.name.startswith("/model.")]
    last = [
        n.name
        for n in model.graph.node
        if (n.name.startswith(heads) and ".1/" in n.name) or n.name.startswith("/model.12/out/")
    ]
    with _quiet(), tempfile.TemporaryDirectory(prefix="freshfield-int8-") as folder:
        prepared = Path(folder) / "prepared.onnx"
        quant_pre_process(str(fp32), str(prepared), skip_symbolic_shape=True)
        quantize_static(
            str(prepared),
            str(path),
            _Calibration(images),
            quant_format=QuantFormat.QDQ,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            per_channel=True,
            # Seven bits of weights: with eight, processors without VNNI saturate their sums, and a frame
            # would have different embeddings on different machines.
            reduce_range=True,
            calibrate_method=CalibrationMethod.MinMax,
            op_types_to_quantize=["Conv", "Concat", "MaxPool", "Add", "Split", "Resize"],
            nodes_to_exclude=[*inner, *last],
        )
    quantised = onnx.load(str(path))
    del quantised.metadata_props[:]
    quantised.metadata_props.extend(model.metadata_props)
    onnx.save(quantised, str(path))


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence the quantizer, which logs every node to the root logger."""
    root = logging.getLogger()
    level = root.level
    root.setLevel(logging.ERROR)
    try:
        yield
    finally:
        root.setLevel(level)


def add_projection(path: Path, features: NDArray[np.float32]) -> dict[str, float]:
    """Store a projection in the model's metadata: the principal axes of pooled ``features`` (n, C), each
    scaled to unit variance. Returns the share of variance that the first 8, 16, 32 and 64 axes explain."""
    mean = features.mean(axis=0)
    _, spread, axes = np.linalg.svd((features - mean).astype(np.float64), full_matrices=False)
    # The sign of an axis is arbitrary: make its largest entry positive.
    axes *= np.sign(axes[np.arange(len(axes)), np.abs(axes).argmax(axis=1)])[:, None]
    scale = np.maximum(spread, _LEAST_SPREAD * spread[0]) / np.sqrt(len(features))
    kept = min(AXES, len(axes))
    model = onnx.load(str(path))
    text = pack_projection(mean, (axes[:kept] / scale[:kept, None]).T.astype(np.float32))
    _set_metadata(model, {PROJECTION_KEY: text})
    onnx.save(model, str(path))
    share = np.cumsum(spread**2) / (spread**2).sum()
    return {str(k): round(float(share[k - 1]), 4) for k in (8, 16, 32, 64) if k <= len(share)}


def runner(path: Path) -> Run:
    """Function that runs the whole detector in ONNX Runtime."""
    session = _session(str(path))
    return lambda images: np.asarray(session.run(None, {INPUT: images})[0])


def pooled_features(path: Path, images: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Features (n, C) of ``images`` (n, H, W, 3), from which embeddings are projected."""
    side = images.shape[1]
    backbone = load_backbone(path, size=side)
    session = _session(backbone.model)
    out = []
    for part in network_inputs(images, _BATCH):
        out.append(np.asarray(session.run([OUTPUT], {backbone.input: part})[0]))
    return np.concatenate(out)


def _session(model: str | bytes) -> ort.InferenceSession:
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 3
    return ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])


def _describe(model: onnx.ModelProto, side: int, about: dict[str, Any], kinds: Sequence[str]) -> None:
    """Set the metadata that the family's exporter writes, so that its tools can read the file."""
    names = "{" + ", ".join(f"{k}: '{kind}'" for k, kind in enumerate(kinds)) + "}"
    values = {"stride": "16", "imgsz": f"[{side}, {side}]", "names": names, **about}
    _set_metadata(model, {key: str(value) for key, value in values.items()})


def _set_metadata(model: onnx.ModelProto, values: dict[str, str]) -> None:
    merged = {p.key: p.value for p in model.metadata_props} | values
    del model.metadata_props[:]
    helper.set_model_props(model, merged)


class _Calibration(CalibrationDataReader):  # type: ignore[misc]
    def __init__(self, images: NDArray[np.uint8]) -> None:
        self._parts = ({INPUT: part} for part in network_inputs(images, 8))

    def get_next(self) -> dict[str, NDArray[np.float32]] | None:
        return next(self._parts, None)
