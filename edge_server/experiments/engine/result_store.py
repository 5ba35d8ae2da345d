"""Results of a long computation in an append-only file of JSON lines."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from edge_server.experiments.engine.content_key import plain
from freshfield.files import Lines


class ResultStore:
    """Results by key. Each is a line ``{"key": ..., "inputs": ..., "result": ...}`` of the file.

    path: the file, which is made if it does not exist. Incomplete lines are ignored; of several lines with one key
    the last counts. None: results are kept in memory only.
    Raises OSError if the file cannot be opened.
    """

    def __init__(self, path: Path | None = None) -> None:
        self.results: dict[str, Any] = {}
        """The known results by key."""
        self._lines: Lines | None = None
        if path is None:
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        for line in path.read_text(errors="replace").splitlines() if path.exists() else ():
            try:
                found = json.loads(line)
                self.results[str(found["key"])] = found["result"]
            except (ValueError, KeyError, TypeError):
                continue
        self._lines = Lines(path)

    def put(self, key: str, inputs: Any, result: Any) -> None:
        """Keep a result (a JSON value), with its inputs for whoever reads the file."""
        self.results[key] = result
        if self._lines is not None:
            self._lines.write(json.dumps({"key": key, "inputs": inputs, "result": result}, default=plain))

    def close(self) -> None:
        """Close the file."""
        if self._lines is not None:
            self._lines.close()
