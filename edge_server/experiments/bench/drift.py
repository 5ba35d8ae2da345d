"""Three hundred updates after motion: ``bench_track`` at length, to see whether a field that
follows a moving scene wears out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from edge_server.experiments.bench import track
from edge_server.experiments.bench.track import draw, table
from edge_server.experiments.common.result_store import Kept

__all__ = ["draw", "measure", "table"]

LONG: dict[str, Any] = {"updates": 300}
QUICK: dict[str, Any] = {"updates": 32, "update_s": (0.25,)}
SCENES = ("room",)


def measure(
    quick: bool,
    folder: Path,
    lpips: Path | None = None,
    fields: Sequence[str] = (),
    kept: Kept | None = None,
    scenes: Sequence[str] = (),
    **changed: Any,
) -> dict[str, Any]:
    """As ``bench_track.measure``, with other numbers of updates, and of ``room`` alone unless
    ``scenes`` are asked for."""
    given = {name: value for name, value in changed.items() if value is not None}
    plan = {**(QUICK if quick else LONG), **given}
    return track.measure(quick, folder, lpips, fields, kept, scenes or SCENES, **plan)
