"""Digest of the program's own source, so that stored results of other code are not reused."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

import camera_node
import channel_emu
import edge_server
import freshfield

_EXPERIMENTS = "edge_server/experiments"
# Sources that only show or compare results.
_EXCLUDED = (
    "edge_server/page",
    "edge_server/report",
    f"{_EXPERIMENTS}/studies",
    f"{_EXPERIMENTS}/common/statistics.py",
    f"{_EXPERIMENTS}/common/arguments.py",
)
# The files below them that compute results.
_INCLUDED = tuple(f"{_EXPERIMENTS}/studies/{name}.py" for name in ("trial", "viewpoints", "preferences"))


@cache
def source_digest() -> str:
    """Digest of every Python file that can change the result of a trial or of an evaluation."""
    digest = hashlib.sha256()
    for package in (freshfield, camera_node, channel_emu, edge_server):
        root = Path(str(package.__file__)).parent
        for path in sorted(root.rglob("*.py")):
            name = f"{root.name}/{path.relative_to(root).as_posix()}"
            if name in _INCLUDED or not name.startswith(_EXCLUDED):
                digest.update(name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]
