"""Checkpoints of fields and schedulers: one npz of arrays (no pickle) with facts as JSON inside it."""

from __future__ import annotations

import json
import os
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.edge_constants import MAX_MODEL_BYTES
from freshfield.untrusted import check_file

_FORMAT = "freshfield-{kind}-1"
# RuntimeError: a zip file of a later version, encrypted, or packed in another way.
_UNREADABLE = (OSError, ValueError, TypeError, EOFError, RuntimeError, struct.error, zlib.error, zipfile.BadZipFile)


class CheckpointError(ValueError):
    """An unusable checkpoint; the message says which file and why."""


def save(
    path: Path | str,
    state: Mapping[str, NDArray[Any]],
    about: Mapping[str, Any] | None = None,
    kind: str = "field",
    durable: bool = True,
) -> None:
    """Write a checkpoint. A temporary file is renamed into place, so a crash leaves the old checkpoint or the
    new one.

    path: the npz file; its folder is made.
    state: ``Field.state()``, or the state of another ``kind``.
    about: facts, ready for JSON, that ``load`` returns.
    durable: wait for the disk, so that this also holds if the machine crashes.
    Raises OSError if the folder cannot be written.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    facts = json.dumps({"format": _FORMAT.format(kind=kind), "about": dict(about or {})})
    temporary = path.with_name(f".{path.name}.{os.urandom(6).hex()}.tmp")
    try:
        with temporary.open("xb") as file:
            np.savez(file, allow_pickle=False, __facts__=np.array(facts), **state)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def load(
    path: Path | str, kind: str = "field", most_bytes: int | None = None
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """The state and the facts of a checkpoint.

    most_bytes: largest unpacked size of all arrays together; None: no limit.
    Raises CheckpointError if the file is missing, damaged, larger, or of another kind.
    """
    path, expected = Path(path), _FORMAT.format(kind=kind)
    try:
        check_file(path, MAX_MODEL_BYTES)
        if most_bytes is not None:
            with zipfile.ZipFile(path) as packed:
                size = sum(entry.file_size for entry in packed.infolist())
            if size > most_bytes:
                raise CheckpointError(f"{path}: unpacked it has {size} bytes, which no {kind}'s checkpoint has")
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        facts = json.loads(str(arrays.pop("__facts__")))
    except FileNotFoundError:
        raise CheckpointError(f"{path}: no such checkpoint") from None
    except CheckpointError:
        raise
    except MemoryError:
        raise CheckpointError(f"{path}: damaged: it claims arrays that no memory holds") from None
    except KeyError:
        raise CheckpointError(f"{path}: an npz file, but not a {kind}'s checkpoint") from None
    except _UNREADABLE as error:
        raise CheckpointError(f"{path}: damaged or not a checkpoint ({error})") from None
    if not isinstance(facts, dict) or facts.get("format") != expected:
        raise CheckpointError(f"{path}: written in another format than {expected}")
    if not isinstance(facts.get("about"), dict):
        raise CheckpointError(f"{path}: damaged or not a checkpoint (nothing is said about it)")
    return arrays, facts["about"]
