"""The node's status file: ``OUT/node-<name>.json``, replaced as a whole about once a second.

Keys: name, pid, session, phase (starting, preparing, streaming, stopped), to, t_ns (machine's clock), and
for each of ``cameras``: fps, held_out, connected, connections, trouble (text or null), clock_offset_ms and
clock_uncertainty_ms (peer minus camera; null before the first exchange), waiting, captured, replaced, sent,
broken, outcomes {accepted, dropped_busy, superseded, "rejected:<reason>"}, missed (ticks the machine was
too slow for) and failed (shots that could not be had).
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any


def write_status(path: Path, status: dict[str, Any]) -> None:
    """Write atomically: a reader sees the old file or the new one, never half."""
    part = path.with_name(path.name + ".part")
    part.write_text(json.dumps(status))
    os.replace(part, path)
