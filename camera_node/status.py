"""The node's status file: ``OUT/node-<name>.json``, replaced as a whole about once a second.

Keys: name, pid, session, phase (starting, preparing, streaming, stopped), to, t_ns (machine's clock), and
for each of ``cameras``: fps, held_out, connected, connections, trouble (text or null), clock_offset_ms and
clock_uncertainty_ms (peer minus camera; null before the first exchange), waiting, captured, replaced, sent,
broken, outcomes {accepted, dropped_busy, superseded, "rejected:<reason>"}, missed (ticks the machine was
too slow for) and failed (shots that could not be had).
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

from freshfield.files import write_json


def write_status(path: Path, status: dict[str, Any]) -> None:
    """Replace the file as a whole. A full disk costs a status, not the node."""
    with contextlib.suppress(OSError):
        write_json(path, status)
