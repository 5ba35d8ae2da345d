"""Prepares the folder of a run: a new one, or that of an earlier run, which is replaced. Others are refused, and so
is one that holds a file which no run writes."""

from __future__ import annotations

import fcntl
import json
import shutil
from fnmatch import fnmatchcase
from pathlib import Path
from typing import IO, Any

from freshfield.untrusted import read_json, read_text

MARKER = "run.json"
"""Written first into every run's folder. Only a folder that holds one, with the key KEY in it, may be replaced."""
KEY = "freshfield_run"
"""Tells the marker from another program's file of that name."""
WRITTEN = (
    *("edge.json", "channel.json", "node-*.json", "frontier.json", "processes.jsonl"),
    *("series.jsonl", "shown.jsonl", "ages.jsonl", "poses.jsonl", "ledger-*.tsv", "log-*.txt", "decisions"),
    *("field.npz", "snapshot-*.npz", "truth.png", "rendered.png", "figure-*.png", "report.json", "report.html"),
    *("decision-*.png", ".*.part"),
)
"""Names, with wildcards, of what the processes of a run, and ``edge-server explain``, write into its folder."""
EARLIER = "earlier-run"
"""Subfolder that keeps the replaced run's files until the new run is up, so a mistyped option loses none."""


class FolderError(ValueError):
    """The folder cannot be used; the message says what to do."""


def prepare(out: Path, about: dict[str, Any]) -> IO[str]:
    """Make ``out`` an empty run folder with a marker. The folder is locked while the returned file is open.
    Files of an earlier run are moved to ``EARLIER``, where they stay until ``forget_earlier``.

    about: contents of the marker, besides KEY.
    Raises FolderError if the folder cannot be used, holds other files than a run's, or a run is still using
    it.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        marker = out / MARKER
        _refuse_a_strangers(out)
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
    if earlier.exists():  # the last start failed: keep the run before it, and delete its logs
        for path in before:
            _delete(path)
    elif before or part.exists():  # ``part``: files that a killed start had moved already
        part.mkdir(exist_ok=True)
        for path in before:
            path.rename(part / path.name)
        part.rename(earlier)
    lock.truncate(0)
    json.dump({KEY: [], **about}, lock, indent=1)
    lock.flush()
    return lock


def _refuse_a_strangers(out: Path) -> None:
    """Raise FolderError unless all files in ``out`` are a run's."""
    found = {path.name for path in out.iterdir()}
    if not found:
        return
    elsewhere = "name an empty or a new folder with --out"
    if MARKER not in found:
        raise FolderError(f"{out} holds files that are not an earlier run's (no {MARKER} in it); {elsewhere}")
    kept = {MARKER, EARLIER, f".{EARLIER}"}
    try:
        text = read_text(out / MARKER)
        # A start that was killed before it wrote its marker leaves an empty one.
        if (text or not found <= kept) and read_json(text)[KEY] != []:
            raise ValueError
    except (ValueError, TypeError, KeyError):
        raise FolderError(
            f"{out}: {MARKER} is not of a run of this version of freshfield, so its files stay; delete the folder, or "
            f"{elsewhere}"
        ) from None
    known = (*WRITTEN, *kept)
    if strange := sorted(name for name in found if not any(fnmatchcase(name, pattern) for pattern in known)):
        raise FolderError(f"{out} holds {strange[0]}, which no run wrote; move it, or {elsewhere}")


def forget_earlier(out: Path) -> None:
    """Delete the files of the run that this one replaces."""
    if (earlier := out / EARLIER).exists():
        _delete(earlier.rename(out / f".{EARLIER}"))  # renamed first, in case of a kill in between


def _delete(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
