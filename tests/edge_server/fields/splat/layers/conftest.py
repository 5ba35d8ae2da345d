"""What the tests of the layers share."""

import pytest

from edge_server.fields.splat.layers import settings
from edge_server.fields.splat.layers.depth import settings as depth_settings


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plates of one second, and a short schedule."""
    monkeypatch.setattr(settings, "PLATE_S", 1.0)
    monkeypatch.setattr(settings, "SHOWN_AFTER", 60)
    monkeypatch.setattr(settings, "SCHEDULE", 200)
    monkeypatch.setattr(settings, "ROUNDS_FIRST", 5)
    monkeypatch.setattr(settings, "ROUNDS_AGAIN", 3)


@pytest.fixture
def shown_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """What depth teaches, too."""
    monkeypatch.setattr(depth_settings, "SHOWN_AFTER", (20, 40))
