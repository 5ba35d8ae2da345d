"""The folder of a run: a new one, or that of an earlier run, which is replaced. Any other is refused."""

from __future__ import annotations

import fcntl
import json
import shutil
from pathlib import Path
from typing import IO, Any

MARKER = "run.json"
"""Written first into every run's folder. Only a folder that holds one may be replaced."""
EARLIER = "earlier-run"
"""Where the files of the run that was replaced lie until the new one is up: a mistyped option loses none."""


class FolderError(ValueError):
    """The folder cannot be used; the message says what to do."""


def prepare(out: Path, about: dict[str, Any]) -> IO[str]:
    """Make ``out`` an empty run folder with a marker, locked for as long as the returned file is open. The
    files of an earlier run lie in ``EARLIER`` until ``forget_earlier``.

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
    earlier, part = out / EARLIER, out / f".{EARLIER}"
    before = set(out.iterdir()) - {marker, earlier, part}
    if earlier.exists():  # the last start failed: what lies there is worth more than its logs
        for path in before:
            _delete(path)
    elif before or part.exists():  # what a start that was killed has moved already
        part.mkdir(exist_ok=True)
        for path in before:
            path.rename(part / path.name)
        part.rename(earlier)
    lock.truncate(0)
    json.dump(about, lock, indent=1)
    lock.flush()
    return lock


def forget_earlier(out: Path) -> None:
    """Delete the files of the run that this one replaces."""
    if (earlier := out / EARLIER).exists():
        _delete(earlier.rename(out / f".{EARLIER}"))  # killed meanwhile, this run is the earlier one


def _delete(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
