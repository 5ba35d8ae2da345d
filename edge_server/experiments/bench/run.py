"""Code shared by the parts of the bench: their request, the recordings, the settings of a result."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from camera_node.sources.datasets.records import DatasetError
from edge_server.experiments.common.result_store import ResultStore, settings_digest
from edge_server.experiments.scenes.multiview_still import MultiviewStill, open_still
from edge_server.fields.registry import settings_of

# Recordings: path below the data folder, and held-out views.
RECORDINGS = {
    "kitchen": ("blender_kitchen/transforms.json", "cam00"),
    "lego": ("lego_synthetic", "8"),
    "fox": ("fox/transforms_2.json", "8"),
}
SYNTHETIC = ("tile", "room")
SCENES = (*SYNTHETIC, *RECORDINGS)


class BenchError(RuntimeError):
    """A measurement that failed; the message says why."""


@dataclass
class BenchRun:
    """The request to one part of the bench; a part uses what it needs.

    quick: fewer repetitions.
    folder: an empty folder for temporary files.
    lpips: folder of LPIPS weights; None: from the environment.
    fields: the representations to measure; empty: all.
    store: results of this part, including those of an earlier run.
    scenes: the scenes to measure; empty: the part's default.
    options: options of the representations.
    only: names of the options (or of the parts of surface) to measure; empty: all.
    model: a YOLO ONNX file; None: the shipped ones.
    """

    quick: bool
    folder: Path = Path()
    lpips: Path | None = None
    fields: tuple[str, ...] = ()
    store: ResultStore = field(default_factory=ResultStore)
    scenes: tuple[str, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)
    only: tuple[str, ...] = ()
    model: Path | None = None


def result_settings(workload: Any, name: str, options: Mapping[str, Any] | None = None, **more: Any) -> dict[str, Any]:
    """The settings with which a result is stored: of the workload and of the representation.

    workload: a dataclass.
    name, options: name and options of the representation.
    """
    return {**dataclasses.asdict(workload), "defaults": settings_digest(name, options), **more}


def label(name: str, options: Mapping[str, Any]) -> str:
    """Options of a representation as text, without those at their defaults. Raises ValueError for unknown
    options or invalid values."""
    usual, chosen = settings_of(name), settings_of(name, options)
    different = {k: v for k, v in options.items() if getattr(usual, k, None) != getattr(chosen, k, v)}
    return ", ".join(f"{k}={v}" for k, v in different.items()) or "default"


def data_file(name: str) -> Path:
    """A file or folder of the data folder. Raises DatasetError if FRESHFIELD_DATA is not set."""
    data = os.environ.get("FRESHFIELD_DATA")
    if not data:
        raise DatasetError(f"set FRESHFIELD_DATA to the folder that holds {name.split('/')[0]}")
    return Path(data) / name


def open_recording(name: str, scale: float) -> MultiviewStill:
    """Open one of ``RECORDINGS``. scale: divides the image sizes. Raises DatasetError."""
    path, holdout = RECORDINGS[name]
    return open_still(str(data_file(path)), holdout=holdout, scale=scale)
