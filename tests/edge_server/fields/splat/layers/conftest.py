"""What the tests of the layers share."""

from __future__ import annotations

import pytest

from edge_server.fields.splat.layers import layered_field, static_layer


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plates of one second, and a short schedule."""
    monkeypatch.setattr(layered_field, "PLATE_S", 1.0)
    monkeypatch.setattr(static_layer, "SHOWN_AFTER", 60)
    monkeypatch.setattr(static_layer, "SCHEDULE", 200)
    monkeypatch.setattr(static_layer, "ROUNDS_FIRST", 5)
    monkeypatch.setattr(static_layer, "ROUNDS_AGAIN", 3)
