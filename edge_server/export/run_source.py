"""Data to export: a field from a checkpoint, and its cameras with their last images."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from edge_server.export import ExportError
from edge_server.export.viewed_field import ViewedField
from edge_server.fields import Field, View, checkpoint
from edge_server.fields.registry import make_field, option_help
from freshfield.plugins import refuse_foreign
from freshfield.untrusted import stored_bytes

# In order: a run's last checkpoint, a fit's checkpoint.
NAMES = ("field.npz", "field")


class Source(ViewedField):
    """A saved field. file: its checkpoint. The others as of ``ViewedField``."""

    def __init__(self, file: Path, name: str, field: Field, views: tuple[View, ...]) -> None:
        super().__init__(name, field, views)
        self.file = file


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


def holds_checkpoint(path: Path) -> bool:
    """Whether a file is a checkpoint by its name, or a folder holds one."""
    if path.is_dir():
        return any((path / name).is_file() for name in NAMES) or any(path.glob("snapshot-*.npz"))
    return path.is_file() and (path.suffix == ".npz" or path.name in NAMES)


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
