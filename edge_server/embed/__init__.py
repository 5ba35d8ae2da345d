"""Embeddings of frames: the frozen backbone of a YOLO detector, run by ONNX Runtime (6.31).

A frame's embedding z = F_e(frame) is the detector's last backbone feature map, averaged over the image and
projected to ``dim`` numbers. Any detection ONNX exported from YOLOv8 or YOLO11 works; the default is a small
detector trained on our own scenes (``edge-server train-detector``). The scenario key ``edge.embedding``
enables it; without that key this package is not imported.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from freshfield.scenario import read_section

if TYPE_CHECKING:
    from edge_server.embed.embedder import Embedder

DEFAULT = "default"
MODELS = Path(__file__).parent / "models"
# The faster of the two shipped models; their features have a mean cosine of 0.998 (detector.json).
DETECTOR = "detector_int8.onnx"
PROVIDERS = ("auto", "cpu", "cuda")


class EmbeddingError(ValueError):
    """A model, setting or image is unusable; the one-line message says what, where and what to do."""


class SizeError(EmbeddingError):
    """The model was not exported for this image size."""


@dataclass(frozen=True)
class EmbeddingConfig:
    """The section ``edge.embedding`` of a scenario.

    model: a YOLO detection ONNX, relative to the scenario, or ``default``.
    dim: length of an embedding, at most the channels of the tapped layer.
    size: side of the model's input, pixels; None: the model's own.
    tap: the tensor to embed, or a module of the exporter's such as ``model.9``; None: the backbone's end.
    provider: auto uses CUDA if ONNX Runtime has it.
    threads: number of CPU threads.
    """

    model: str = DEFAULT
    dim: int = 32
    size: int | None = None
    tap: str | None = None
    provider: str = "auto"
    threads: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.dim <= 4096:
            raise ValueError(f"dim: expected 1 to 4096, got {self.dim}")
        if self.size is not None and not 32 <= self.size <= 2048:
            raise ValueError(f"size: expected 32 to 2048 pixels, got {self.size}")
        if self.provider not in PROVIDERS:
            raise ValueError(f"provider: expected one of {', '.join(PROVIDERS)}, got {self.provider!r}")
        if not 1 <= self.threads <= 256:
            raise ValueError(f"threads: expected 1 to 256, got {self.threads}")


def read_embedding(mapping: Mapping[str, Any], scenario: Path) -> EmbeddingConfig:
    """Read the section ``edge.embedding`` of file ``scenario``; raises freshfield.scenario.ScenarioError."""
    values = dict(mapping) if isinstance(mapping, Mapping) else mapping
    config = read_section(EmbeddingConfig, values, f"{scenario}: edge.embedding")
    if config.model == DEFAULT:
        return config
    return EmbeddingConfig(**{**vars(config), "model": str(scenario.parent / config.model)})


def model_path(name: str) -> Path:
    """The file of a model: a path, or ``default``."""
    return MODELS / DETECTOR if name == DEFAULT else Path(name)


def make_embedder(section: EmbeddingConfig) -> Embedder:
    """Create from a section. EmbeddingError: a library is not installed, the file is not a YOLO detector, or
    it cannot have this size or provider."""
    try:
        from edge_server.embed.backbone import load_backbone
        from edge_server.embed.embedder import Embedder
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] not in ("onnx", "onnxruntime"):
            raise
        raise EmbeddingError(
            f"embedding needs {error.name.split('.')[0]}, which is not installed: pip install 'freshfield[embed]'"
        ) from None
    backbone = load_backbone(model_path(section.model), section.tap, section.size)
    return Embedder(backbone, section.dim, section.provider, section.threads)
