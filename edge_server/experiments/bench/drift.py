"""``bench track`` with three hundred updates: whether the quality of a field that follows a moving scene
decreases."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from edge_server.experiments.bench import track
from edge_server.experiments.bench.run import BenchRun
from edge_server.experiments.bench.track import draw, table

__all__ = ["draw", "measure", "table"]

UPDATES, QUICK_UPDATES, QUICK_UPDATE_S = 300, 32, (0.25,)
SCENES = ("room",)


def measure(run: BenchRun) -> dict[str, Any]:
    """As ``track.measure``, with more updates, and of ``room`` alone unless scenes are asked for."""
    return track.measure(
        replace(
            run,
            scenes=run.scenes or SCENES,
            updates=run.updates or (QUICK_UPDATES if run.quick else UPDATES),
            update_s=run.update_s or (QUICK_UPDATE_S if run.quick else None),
        )
    )
