"""Exports the trained detector to ONNX, with its projection for embeddings."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import torch
from numpy.typing import NDArray
from onnx import helper

from edge_server.embed.backbone import OUTPUT, PROJECTION_KEY, load_backbone, pack_projection
from edge_server.experiments.training.detector.dataset import network_inputs
from edge_server.experiments.training.detector.network import Detector
from edge_server.experiments.training.detector.scenes import KINDS

OPSET = 17
INPUT = "images"
_BATCH = 32

Run = Callable[[NDArray[np.float32]], NDArray[np.float32]]
"""Images (n, 3, H, W) in [0, 1] -> output0 (n, 4 + kinds, cells)."""

# Number of axes of the learned projection: the largest dimension of an embedding.
AXES = 64
# Least spread of an axis, relative to the first, so that scaling does not amplify one without information.
_LEAST_SPREAD = 1e-3


def export_onnx(model: Detector, side: int, path: Path, about: dict[str, Any]) -> None:
    """Export the detector for any number of images of any size whose sides are multiples of 16."""
    model = model.eval()
    axes = {INPUT: {0: "n", 2: "height", 3: "width"}, "output0": {0: "n", 2: "cells"}}
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
            output_names=["output0"],
            dynamic_axes=axes,
        )
    exported = onnx.load(str(path))
    onnx.checker.check_model(exported)
    _describe(exported, side, {"task": "detect", **about})
    onnx.save(exported, str(path))


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


def _describe(model: onnx.ModelProto, side: int, about: dict[str, Any]) -> None:
    """Set the metadata that the family's exporter writes, so that its tools can read the file."""
    names = "{" + ", ".join(f"{k}: '{kind}'" for k, kind in enumerate(KINDS)) + "}"
    values = {"stride": "16", "imgsz": f"[{side}, {side}]", "names": names, **about}
    _set_metadata(model, {key: str(value) for key, value in values.items()})


def _set_metadata(model: onnx.ModelProto, values: dict[str, str]) -> None:
    merged = {p.key: p.value for p in model.metadata_props} | values
    del model.metadata_props[:]
    helper.set_model_props(model, merged)
