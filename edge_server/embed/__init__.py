"""Embeddings of frames: the frozen backbone of a YOLO detector, run by ONNX Runtime (6.31).

A frame's embedding z = F_e(frame) is the detector's last backbone feature map, averaged over the image and
projected to ``dim`` numbers. Any detection ONNX exported from YOLOv8 or YOLO11 works; the default is a small
detector trained on our own scenes (``edge-server train-detector`` of tag v0.1-all). The scenario key ``edge.embedding``
enables it; without that key this package is not imported.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from edge_server.embed.settings import DEFAULT, EmbeddingConfig

if TYPE_CHECKING:
    from edge_server.embed.depth_network import DepthNetwork
    from edge_server.embed.embedder import Embedder

MODELS = Path(__file__).parent / "models"
# Its features have a mean cosine of 0.998 with those of the fp32 model, which tag v0.1-all has (detector.json).
DETECTOR = "detector_int8.onnx"


class EmbeddingError(ValueError):
    """A model, setting or image is unusable; the one-line message says what, where and what to do."""


def model_path(name: str) -> Path:
    """The file of a model: a path, or ``default``."""
    return MODELS / DETECTOR if name == DEFAULT else Path(name)


@contextmanager
def onnx_libraries(what: str) -> Iterator[None]:
    """For imports of ONNX's libraries. what: that needs them. EmbeddingError: they are not installed."""
    try:
        yield
    except ModuleNotFoundError as error:
        library = (error.name or "").split(".")[0]
        if library not in ("onnx", "onnxruntime"):
            raise
        raise EmbeddingError(
            f"{what} needs {library}, which is not installed: pip install 'freshfield[embed]'"
        ) from None


def make_embedder(section: EmbeddingConfig) -> Embedder:
    """Create from a section. EmbeddingError: a library is not installed, the file is not a YOLO detector, or
    it cannot have this size."""
    with onnx_libraries("embedding"):
        from edge_server.embed.backbone import load_backbone
        from edge_server.embed.embedder import Embedder
    backbone = load_backbone(model_path(section.model))
    return Embedder(backbone, section.dim)


def open_depth_network(file: Path) -> DepthNetwork:
    """The network of ``edge.depth_network``. EmbeddingError: a library is not installed, or the file holds no such
    network."""
    with onnx_libraries("a depth network"):
        from edge_server.embed.depth_network import DepthNetwork
    return DepthNetwork(file)
