"""The folder of a run: a new one, or that of an earlier run, which is replaced. Any other is refused."""

from __future__ import annotations

import fcntl
import json
import shutil
from pathlib import Path
from typing import IO, Any

MARKER = "run.json"
"""Written first into every run's folder. Only a folder that holds one may be replaced."""


class FolderError(ValueError):
    """The folder cannot be used; the message says what to do."""


def prepare(out: Path, about: dict[str, Any]) -> IO[str]:
    """Make ``out`` an empty run folder with a marker, locked for as long as the returned file is open.

    about: contents of the marker. Raises FolderError if the folder holds anything but an earlier run, or a
    run that is still going on.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        marker = out / MARKER
        if not marker.exists() and any(out.iterdir()):
            raise FolderError(
                f"{out} holds files that are not an earlier run's (no {MARKER} in it); "
                "name an empty or a new folder with --out"
            )
        lock = marker.open("a+")
    except OSError as error:
        raise FolderError(f"cannot use {out} for the run's files: {error.strerror}") from None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        lock.close()
        raise FolderError(f"another run is writing to {out}; end it, or name another with --out") from None
    for path in out.iterdir():
        if path == marker:
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()
    lock.truncate(0)
    json.dump(about, lock, indent=1)
    lock.flush()
    return lock
