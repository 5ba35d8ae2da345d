"""Data to export: a field from a checkpoint, and its cameras with their last images."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.export import ExportError, PosedImage, file_names
from edge_server.fields import Field, RefinesCameras, View, checkpoint
from edge_server.fields.registry import make_field, option_help
from freshfield.plugins import refuse_foreign
from freshfield.untrusted import stored_bytes

# In order: a run's last checkpoint, a fit's checkpoint.
NAMES = ("field.npz", "field")


@dataclass(frozen=True)
class Source:
    """A saved field. file: its checkpoint. name: name of the representation. views: the last view of each
    camera."""

    file: Path
    name: str
    field: Field
    views: tuple[View, ...]

    @property
    def shots(self) -> list[PosedImage]:
        """The views as images to write, at the poses that belong to the field's Gaussians: corrected ones, if it
        corrects them."""
        names = file_names([v.camera for v in self.views])
        return [PosedImage(name, v.image, self.pose(v), v.intrinsics) for name, v in zip(names, self.views)]

    def pose(self, view: View) -> NDArray[np.float64]:
        """Camera to world (4, 4) of a view, corrected where the field corrects it."""
        known = self.field.correction(view) if isinstance(self.field, RefinesCameras) else None
        return np.asarray(view.camera_to_world if known is None else known.camera_to_world, np.float64)


def open_source(path: Path, allow_plugins: bool = False) -> Source:
    """Load the field saved in ``path``: a checkpoint, or the folder of a run or fit.

    allow_plugins: also one whose class is from outside (``freshfield.plugins``), which runs its code.
    ExportError: there is none, or it cannot be read.
    """
    file = find_checkpoint(path)
    try:
        state, about = checkpoint.load(file, most_bytes=stored_bytes(file))
        name = str(about["field"])
        refuse_foreign("field", name, str(file), allow_plugins)
        options: dict[str, Any] = dict(about.get("options") or {})
        field = make_field(name, _saved_options(name, options, state), seed=int(about.get("seed", 0)))
        field.load_state(state)
    except KeyError:
        raise ExportError(f"{file}: does not say which representation it is of") from None
    except ValueError as error:
        raise ExportError(f"{file}: {error}") from None
    if not field.views:
        raise ExportError(f"{file}: its field has seen no camera yet: let the run publish an update first")
    return Source(file, name, field, field.views)


def _saved_options(name: str, options: dict[str, Any], state: dict[str, Any]) -> dict[str, Any]:
    """The options a field was made with, without threads and device. The state's own come first."""
    try:
        settings = json.loads(str(state["meta"]))["settings"]
    except (KeyError, ValueError, TypeError):
        return options
    known = set(option_help(name)) - {"threads", "nice", "device", "seed"}
    return {k: tuple(v) if isinstance(v, list) else v for k, v in settings.items() if k in known}


def find_checkpoint(path: Path) -> Path:
    """The checkpoint at ``path`` or in it: a run's last one, else its newest snapshot. ExportError: none."""
    if path.is_file():
        return path
    if not path.is_dir():
        raise ExportError(f"{path}: no such file or folder")
    snapshots = sorted(path.glob("snapshot-*.npz"))[::-1]
    for file in (*(path / name for name in NAMES), *snapshots):
        if file.is_file():
            return file
    raise ExportError(
        f"{path}: holds no checkpoint ({' or '.join(NAMES)}); a run writes it when it ends, "
        "with --checkpoint-every S also meanwhile"
    )


def write_images(folder: Path, shots: list[PosedImage]) -> None:
    """Write NAME.png for every shot, with transparency. ExportError: a file cannot be written."""
    folder.mkdir(parents=True, exist_ok=True)
    for shot in shots:
        code = cv2.COLOR_RGBA2BGRA if shot.image.shape[2] == 4 else cv2.COLOR_RGB2BGR
        if not cv2.imwrite(str(folder / f"{shot.name}.png"), cv2.cvtColor(shot.image, code)):
            raise ExportError(f"{folder / shot.name}.png: cannot be written")
