"""What a part of the bench is asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from edge_server.experiments.engine import Engine
from edge_server.fields.registry import field_names


class BenchError(RuntimeError):
    """A measurement that failed; the message says why."""


@dataclass
class BenchRun:
    """The request to one part of the bench; a part uses what it needs.

    engine: measures the points, and keeps them.
    quick: fewer repetitions.
    fields: the representations to measure; empty: all.
    scenes: the scenes to measure; empty: all that are there.
    options: options of the representations.
    lpips: folder of LPIPS weights; None: from the environment.
    """

    engine: Engine = field(default_factory=Engine)
    quick: bool = False
    fields: tuple[str, ...] = ()
    scenes: tuple[str, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)
    lpips: Path | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The representations to measure."""
        return self.fields or field_names()
