"""Code shared by the parts of the bench: their request, the recordings, names of options."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from camera_node.sources.datasets.records import DatasetError
from edge_server.experiments.engine import Engine
from edge_server.experiments.scenes.multiview_still import MultiviewStill, open_still
from edge_server.fields.registry import field_names, settings_of

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

    engine: measures the points, and keeps them.
    quick: fewer repetitions.
    fields: the representations to measure; empty: all.
    scenes: the scenes to measure; empty: the part's default.
    options: options of the representations.
    lpips: folder of LPIPS weights; None: from the environment.
    """

    engine: Engine = field(default_factory=Engine)
    quick: bool = False
    fields: tuple[str, ...] = ()
    scenes: tuple[str, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)
    lpips: Path | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The representations to measure."""
        return self.fields or field_names()


def label(name: str, options: Mapping[str, Any]) -> str:
    """A representation and its options as text, without those at their defaults. Raises ValueError for unknown
    options or invalid values."""
    usual, chosen = settings_of(name), settings_of(name, options)
    different = {k: v for k, v in options.items() if getattr(usual, k, None) != getattr(chosen, k, v)}
    return ", ".join([name, *(f"{k}={v}" for k, v in different.items())])


def data_file(name: str) -> Path:
    """A file or folder of the data folder. Raises DatasetError if FRESHFIELD_DATA is not set."""
    data = os.environ.get("FRESHFIELD_DATA")
    if not data:
        raise DatasetError(f"set FRESHFIELD_DATA to the folder that holds {name.split('/')[0]}")
    return Path(data) / name


def recorded_files(scene: str) -> list[Path]:
    """What a result on ``scene`` depends on: the folder of a recording, nothing of a synthetic scene."""
    return [data_file(RECORDINGS[scene][0].split("/")[0])] if scene in RECORDINGS else []


def open_recording(name: str, scale: float) -> MultiviewStill:
    """Open one of ``RECORDINGS``. scale: divides the image sizes. Raises DatasetError."""
    path, holdout = RECORDINGS[name]
    return open_still(str(data_file(path)), holdout=holdout, scale=scale)


def available(scenes: tuple[str, ...], asked: bool) -> list[str]:
    """The scenes whose recordings are there. Raises BenchError for a missing one if it was asked for; otherwise
    prints why it is left out."""
    found = []
    for scene in scenes:
        try:
            missing = [str(path) for path in recorded_files(scene) if not path.is_dir()]
            if missing:
                raise DatasetError(f"there is no folder {missing[0]}")
            found.append(scene)
        except DatasetError as error:
            if asked:
                raise BenchError(f"{scene}: {error}") from None
            print(f"  {scene} left out: {error}", flush=True)
    return found
