"""Traces and rows made in virtual time, as the live emulator and as a stranger's link would leave them."""

from __future__ import annotations

from pathlib import Path

from channel_emu.model.settings import channel_from_mapping
from channel_emu.model.trace import TraceWriter
from channel_emu.virtual.simulate import simulate


def write_trace(
    path: Path,
    section: dict,
    seed: int = 1,
    cameras: int = 2,
    seconds: float = 120.0,
    frame_period_ms: float | None = None,
) -> Path:
    """A trace of frames made by the arrivals (or periodic ones that the arrivals sample)."""
    config = channel_from_mapping(section)
    names = [f"cam{i:02d}" for i in range(cameras)]
    made = simulate(config, names, seconds, seed, frame_period_ms=frame_period_ms)
    writer = TraceWriter(path, config, seed)
    for run in made.runs:
        for transit in run.transits:
            writer.write(run.camera, "s", transit.number, transit)
    writer.close()
    return path


def write_rows(path: Path, section: dict, seed: int = 1, seconds: float = 120.0, outcomes: bool = False) -> Path:
    """offered_ms, delivered_ms of one camera; what did not come is blank. outcomes: the column that says why."""
    simulate(channel_from_mapping(section), 1, seconds, seed).write_frames(path)
    if not outcomes:
        path.write_text("".join(line.rpartition(",")[0] + "\n" for line in path.read_text().splitlines()))
    return path
