"""Local folders for files that are not part of the repository."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from camera_node.settings import find_data
from camera_node.sources.datasets.records import DatasetError, read_json
from camera_node.sources.datasets.transforms import EXTENSIONS, TEST, TRAIN
from edge_server.fidelity.lpips_weights import weights_folder
from freshfield.scenario import Scenario, ScenarioError


@dataclass(frozen=True)
class Folders:
    """Local folders for files outside the repository; None: not given.

    data: recorded data sets.
    lpips: weights of LPIPS.
    """

    data: Path | None = None
    lpips: Path | None = None

    def files_of(self, scenario: Scenario) -> list[Path]:
        """Existing files and folders that a scenario's results depend on: its data set, the files that its channel,
        its source (poses) and its edge (models) name, and the weights of LPIPS. Of a data set that is a JSON, also
        the files that it names."""
        data, beside = self.data_of(scenario), [scenario.path.parent]
        if data is not None:  # poses of a video lie there
            beside.append(data if data.is_dir() else data.parent)
        texts = [Path(text).expanduser() for text in _texts([scenario.channel, scenario.source, scenario.edge])]
        named = [file for folder in beside for text in texts if (file := folder / text).is_file()]
        paths = dict.fromkeys((data, *named, *_named_by(data), self.lpips))
        return [path for path in paths if path is not None and path.exists()]

    def data_of(self, scenario: Scenario) -> Path | None:
        """A scenario's data set, beside it or in the data folder; None if it names none, or that is not there."""
        names = [str(scenario.source[key]) for key in ("data", "file") if key in scenario.source]
        with suppress(ScenarioError):
            return find_data(names[0], scenario, self.data) if names else None
        return None


def folders_from(data: Path | None = None, lpips: Path | None = None) -> Folders:
    """The folders given, or those that the environment names (FRESHFIELD_DATA, FRESHFIELD_LPIPS)."""
    data = data or (Path(d) if (d := os.environ.get("FRESHFIELD_DATA")) else None)
    return Folders(data, weights_folder(lpips, data))


def _named_by(data: Path | None) -> list[Path]:
    """The files that a data set's JSON names, such as images, and those that its test part names."""
    if data is None or data.suffix != ".json" or not data.is_file():
        return []
    parts = [data, *([test] if data.name == TRAIN and (test := data.with_name(TEST)).is_file() else [])]
    names: list[str] = []
    with suppress(DatasetError):  # who opens it says what is wrong
        names = [text + end for part in parts for text in _texts(read_json(part)) for end in EXTENSIONS]
    return [*parts, *(data.parent / name for name in names if os.path.isfile(data.parent / name))]


def _texts(section: Any) -> list[str]:
    """Every text in a section of a scenario, and the parts of one in short notation (``trace:FILE``)."""
    if isinstance(section, str):
        return [section, *filter(None, section.split(":")[1:])]
    values = section.values() if isinstance(section, dict) else section if isinstance(section, list) else ()
    return [text for value in values for text in _texts(value)]
