"""The figures of a bench as they come: each is written at once, and a bench that goes on skips it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from edge_server.fields.registry import settings_of


class Interrupted(KeyboardInterrupt):
    """Ctrl-C in the midst of a measurement. figures: what it has by now."""

    def __init__(self, figures: dict[str, Any]) -> None:
        super().__init__()
        self.figures = figures


def settled(name: str, options: Mapping[str, Any] | None = None) -> str:
    """What options of a representation come to, as a digest: with another default, another thing was
    measured, so figures are kept with it. ValueError as ``make_field``."""
    return hashlib.sha256(repr(settings_of(name, options)).encode()).hexdigest()[:16]


def _nowhere() -> None:
    pass


@dataclass
class Kept:
    """figures: of one part of a bench, nested, as JSON takes them. save: writes them, with all the others."""

    figures: dict[str, Any] = field(default_factory=dict)
    save: Callable[[], None] = _nowhere

    def get(
        self, *path: str, measure: Callable[[], dict[str, Any]], settings: dict[str, Any] | None = None
    ) -> dict[str, Any]:
        """The figures at ``path``: those that are there, if they are whole and of the same settings (JSON
        values), else what ``measure`` returns. What an ``Interrupted`` one has is kept, marked so."""
        *folders, last = path
        place = self.figures
        for name in folders:
            place = place.setdefault(name, {})
        if self.has(*path, settings=settings):
            found: dict[str, Any] = place[last]
            return found
        more = {} if settings is None else {"settings": settings}
        try:
            place[last] = {**measure(), **more}
        except Interrupted as stopped:
            place[last] = {**stopped.figures, **more, "interrupted": True}
            raise
        finally:
            self.save()
        return place[last]

    def has(self, *path: str, settings: dict[str, Any] | None = None) -> bool:
        """Whether ``get`` would find the figures there."""
        known: Any = self.figures
        for name in path:
            known = known.get(name) if isinstance(known, dict) else None
        whole = isinstance(known, dict) and not known.get("interrupted")
        return whole and known.get("settings") == settings

    def put(self, name: str, value: Any) -> None:
        """Something said of the whole part."""
        self.figures[name] = value
