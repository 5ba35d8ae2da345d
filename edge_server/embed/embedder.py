"""Runs a backbone and projects its features: images -> embeddings (6.31)."""

from __future__ import annotations

import contextlib
import functools
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from edge_server import edge_constants as tuned
from edge_server.embed import EmbeddingError
from edge_server.embed.backbone import OUTPUT, Backbone, parse_model
from edge_server.embed.letterbox import GRAY, blob, checked
from edge_server.embed.projection import mean_and_axes
from freshfield.untrusted import read_bytes

# What ONNX Runtime calls the types of images that are fed to models.
INPUT_TYPES: dict[str, type[np.floating]] = {"tensor(float)": np.float32, "tensor(float16)": np.float16}


class Embedder:
    """A frozen map from images to ``dim`` numbers each.

    name: identifies the map: what was learned with one embedder holds for any other of the same name.
    """

    def __init__(self, backbone: Backbone, dim: int) -> None:
        """dim: as in ``EmbeddingConfig``. Raises EmbeddingError if ``dim`` exceeds the backbone's channels,
        or the model does not run."""
        self.backbone, self.dim = backbone, dim
        of = backbone.name if backbone.projection is not None else backbone.tap
        self._mean, self._axes = mean_and_axes(backbone.projection, backbone.channels, dim, of)
        self.name = f"{backbone.name}-{backbone.digest} {backbone.tap} {backbone.width}x{backbone.height} d{dim}"
        self._session = open_session(backbone.model, backbone.name)
        self.step = backbone.batch or tuned.EMBEDDING_BATCH
        """Images per run."""
        # A model that cannot run fails here, not at the first decision.
        self.pooled([np.full((8, 8, 3), GRAY, np.uint8)])

    def embed(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """Embeddings (n, dim), finite, of uint8 RGB images (H, W, 3) of any size; RGBA is composited over
        gray.

        An image for which the model gives NaN or infinity has a row of zeros, which no other image has.
        EmbeddingError: an array is not an image.
        """
        features = self.pooled(images)
        # A finite feature beyond float32's square root may still overflow in the product.
        with np.errstate(over="ignore", invalid="ignore"):
            rows = np.asarray((features - self._mean) @ self._axes, dtype=np.float32)
        rows[~np.isfinite(rows).all(axis=1)] = 0.0
        return rows

    def pooled(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """Features (n, channels): means over each image of the backbone's last feature map."""
        whole = [checked(image, number) for number, image in enumerate(images)]
        b = self.backbone
        out = np.empty((len(whole), b.channels), dtype=np.float32)
        step = self.step
        for first in range(0, len(whole), step):
            part = blob(whole[first : first + step], b.height, b.width, b.dtype)
            n = len(part)
            if b.batch is not None and n < b.batch:
                part = np.concatenate([part, np.zeros((b.batch - n, *part.shape[1:]), part.dtype)])
            out[first : first + n] = self.run(part)[:n]
        return out

    def run(self, part: NDArray[np.floating]) -> NDArray[np.float32]:
        """Run the model once on prepared input (n, 3, height, width). Returns features (n, channels). Raises
        EmbeddingError if the model fails or gives another shape."""
        try:
            found = np.asarray(self._session.run([OUTPUT], {self.backbone.input: part})[0])
        except Exception as error:  # ONNX Runtime's exceptions share no base class
            raise EmbeddingError(f"{self.backbone.name}: {reason_of(error)}") from None
        if found.shape != (len(part), self.backbone.channels):
            raise EmbeddingError(
                f"{self.backbone.name}: {len(part)} images gave features of shape {found.shape}, expected "
                f"({len(part)}, {self.backbone.channels})"
            )
        return found


def open_model(file: Path) -> ort.InferenceSession:
    """Open the ONNX model in ``file``, which may come from anywhere. Raises EmbeddingError."""
    try:
        data = read_bytes(file, tuned.MAX_MODEL_FILE_BYTES)
    except OSError as error:
        raise EmbeddingError(f"{file}: cannot be read: {error.strerror}; name a model in ONNX format") from None
    parse_model(data, file)
    return open_session(data, str(file))


def open_session(model: bytes, name: str) -> ort.InferenceSession:
    """Open an ONNX model, computed in one thread. name: the model's name in error messages. Raises
    EmbeddingError."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # errors are raised, not printed too
    # Spinning threads would take the field's cores.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    _bound_memory()
    options.add_session_config_entry("session.use_env_allocators", "1")
    try:
        # It prints what it then raises.
        with contextlib.redirect_stdout(io.StringIO()):
            return ort.InferenceSession(
                model,
                options,
                providers=["CPUExecutionProvider"],
                # It computes constants while loading, with memory that nothing bounds.
                disabled_optimizers=["ConstantFolding"],
            )
    except Exception as error:  # ONNX Runtime's exceptions share no base class
        raise EmbeddingError(f"{name}: {reason_of(error, 'load')}") from None


@functools.cache
def _bound_memory() -> None:
    """Give this process's sessions one CPU arena of tuned.MAX_MODEL_BYTES together: what exceeds it fails at once.
    Sizes that depend on data (Expand, Tile, Range) cannot be checked before."""
    cpu = ort.OrtMemoryInfo("Cpu", ort.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, ort.OrtMemType.DEFAULT)
    ort.create_and_register_allocator(cpu, ort.OrtArenaCfg({"max_mem": tuned.MAX_MODEL_BYTES}))


def reason_of(error: Exception, doing: str = "run") -> str:
    """One line on why ONNX Runtime cannot run or load a model. doing: that verb."""
    text = " ".join(str(error).split())
    if "bfc_arena" in text or "bad allocation" in text or "bad_alloc" in text:
        text = f"ONNX models may take {tuned.MAX_MODEL_BYTES >> 20} MB of memory together, and it asks for more"
    return f"ONNX Runtime cannot {doing} it: {text[:200]}"
