"""A checkpoint as a run leaves it, of a field that has learned the scene ``tile`` a little."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from edge_server.experiments.scenes.multiview_still import synthetic_still
from edge_server.fields import Budget, Field, View, checkpoint
from edge_server.fields.registry import make_field

SMALL = {"gaussians": 512, "start": 256, "seed_cells": 16}


def tile() -> list[View]:
    """What it learned from."""
    return synthetic_still("tile", cameras=9, size=32).training


def saved(
    folder: Path, name: str = "splat", options: dict[str, Any] = SMALL, steps: int = 60, views: list[View] | None = None
) -> Field:
    """Write the checkpoint into ``folder``; returns the field."""
    field = make_field(name, options, seed=3)
    field.fit(views or tile(), Budget(steps=steps))
    checkpoint.save(folder / "field.npz", field.state(), {"field": name, "options": {}, "seed": 3})
    return field
