"""Finds LPIPS weights, or says what to do where there are none.

A weights folder holds AlexNet's convolutions and the learned channel weights as plain npz arrays:
``alexnet_features.npz`` (torchvision's names, with or without the prefix ``features.``) and ``lin_alex_v0.1.npz``.
"""

from __future__ import annotations

import os
import zipfile
import zlib
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from edge_server.fidelity.lpips import Lpips

FOLDER_VARIABLE = "FRESHFIELD_LPIPS"
FILES = ("alexnet_features.npz", "lin_alex_v0.1.npz")


def weights_folder(given: Path | None = None, data: Path | None = None) -> Path | None:
    """Folder to look for the weights in: the given one, else FRESHFIELD_LPIPS, else ``lpips`` in the data
    folder (``data``, else FRESHFIELD_DATA) if it exists."""
    if given is not None:
        return given
    if named := os.environ.get(FOLDER_VARIABLE):
        return Path(named)
    base = data or (Path(named) if (named := os.environ.get("FRESHFIELD_DATA")) else None)
    return base / "lpips" if base is not None and (base / "lpips").is_dir() else None


def open_lpips(folder: str | Path | None = None) -> tuple[Lpips | None, str | None]:
    """(metric, None), or (None, reason) where the weights are missing or unusable.

    folder: folder with the weights; None takes that of ``weights_folder``.
    The reason, one line for people, says what was looked for, where, and what to do; reports print it as
    ``lpips_missing``.
    """
    place = weights_folder(Path(folder) if folder else None)
    if place is None:
        return None, (
            f"no weights folder given: pass --lpips DIR or set {FOLDER_VARIABLE} to a folder with {' and '.join(FILES)}"
        )
    paths = [place / name for name in FILES]
    absent = [p.name for p in paths if not p.is_file()]
    if absent:
        return None, (
            f"LPIPS: {' and '.join(absent)} not found in {place}: put the weights there, or point "
            f"--lpips or {FOLDER_VARIABLE} to the folder that has them"
        )
    from edge_server.fidelity.lpips import Lpips

    try:
        return Lpips(*paths), None
    except (KeyError, ValueError, OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        return None, f"LPIPS: the weights in {place} cannot be used ({error}): replace the files"
