"""Stores the results of a long computation one by one, so that a rerun computes only the missing ones.

``bench`` and ``frontier`` keep their results in the JSON file that they write anyway, trials and evaluations
in an append-only file of JSON lines.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from edge_server.fields.registry import settings_of
from freshfield.files import Lines

Result = dict[str, Any]


class ResultStore:
    """Results by path: one name or several nested ones.

    results: the known ones, as nested mappings.
    save: called with the path and the result of each new result, to store it permanently.
    """

    def __init__(
        self, results: dict[str, Any] | None = None, save: Callable[[tuple[str, ...], Result], None] | None = None
    ) -> None:
        self.results: dict[str, Any] = {} if results is None else results
        self._save = save
        self._lines: Lines | None = None

    @classmethod
    def in_lines(cls, path: Path) -> ResultStore:
        """A store in a file of JSON lines, ``{"key": ..., **result}``, with one name as path. Incomplete
        lines are ignored; of several lines with one key the last counts. Raises OSError if it cannot be
        opened."""
        path.parent.mkdir(parents=True, exist_ok=True)
        results = {}
        for line in path.read_text(errors="replace").splitlines() if path.exists() else ():
            try:
                found = json.loads(line)
                results[str(found.pop("key"))] = found
            except (ValueError, KeyError, TypeError, AttributeError):
                continue
        lines = Lines(path)
        store = cls(results, lambda key, result: _append(lines, key, result))
        store._lines = lines
        return store

    def close(self) -> None:
        """Close the file of lines; a store of another kind has nothing to close."""
        if self._lines is not None:
            self._lines.close()

    def find(self, *path: str, settings: Mapping[str, Any] | None = None) -> Result | None:
        """The result at ``path`` if it is known; with ``settings``, only if it was computed with these on the
        same kind of processor."""
        found: Any = self.results
        for name in path:
            found = found.get(name) if isinstance(found, dict) else None
        known = isinstance(found, dict) and found.get("settings") == _as_json(settings)
        return found if known else None

    def put(self, *path: str, result: Result) -> Result:
        """Keep and save a result."""
        *folders, last = path
        place = self.results
        for name in folders:
            place = place.setdefault(name, {})
        place[last] = result
        if self._save is not None:
            self._save(path, result)
        return result

    def get(self, *path: str, compute: Callable[[], Result], settings: Mapping[str, Any] | None = None) -> Result:
        """The result at ``path``, computed and stored if ``find`` does not find it.

        compute: called for a missing result.
        settings: JSON values; results of other settings count as missing.
        """
        known = self.find(*path, settings=settings)
        if known is not None:
            return known
        about = {} if settings is None else {"settings": _as_json(settings)}
        return self.put(*path, result={**compute(), **about})


def content_key(parts: Any, length: int = 16) -> str:
    """Hash (hex) of everything that determines a result: ``parts`` (JSON values; the order of names does not
    matter) and the kind of processor, because kernels compiled for another kind round differently."""
    return hashlib.sha256(json.dumps([processor(), parts], sort_keys=True).encode()).hexdigest()[:length]


@cache
def processor() -> str:
    """The kind of processor that kernels are compiled for."""
    import llvmlite.binding as llvm  # what numba compiles with

    return f"{platform.machine()} {llvm.get_host_cpu_name()}"


def settings_digest(name: str, options: Mapping[str, Any] | None = None) -> str:
    """Digest of all settings of a representation, given its name and options. Put it into the settings of a
    result, because a changed default changes the result. Raises ValueError as ``make_field``."""
    return hashlib.sha256(repr(settings_of(name, options)).encode()).hexdigest()[:16]


def _as_json(settings: Mapping[str, Any] | None) -> Any:
    """As they come back from a file, lists for tuples, with the processor."""
    return None if settings is None else json.loads(json.dumps({**settings, "processor": processor()}))


def _append(lines: Lines, path: tuple[str, ...], result: Result) -> None:
    (key,) = path
    lines.write(json.dumps({"key": key, **result}))
