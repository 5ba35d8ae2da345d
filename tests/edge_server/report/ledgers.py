"""Writes real ledgers: one call for each process, one tuple for each line."""

from __future__ import annotations

from pathlib import Path

from freshfield.ledger import Ledger


def write(out: Path, role: str, lines, name: str = "x", start_ns: int = 1, closed: bool = True) -> Path:
    """lines: (sequence, event[, detail]) of camera "a", session "s", or (camera, session, sequence, event[,
    detail])."""
    ledger = Ledger(out, role, name, start_ns)
    for t_ns, line in enumerate(lines):
        if isinstance(line[0], int):
            line = ("a", "s", *line)
        camera, session, sequence, event, *detail = line
        ledger.write(t_ns, camera, session, sequence, event, *detail)
    if closed:
        ledger.close(len(lines))
    else:
        ledger._lines.close()  # as a killed process: without the line ``closed``
    return ledger.path
