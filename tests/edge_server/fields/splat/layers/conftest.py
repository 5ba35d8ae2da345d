"""What the tests of the layers share."""

import pytest

from edge_server.fields.splat.layers import layer_constants as tuned
from edge_server.fields.splat.layers.depth import layer_depth_constants as depth_numbers


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plates of one second, and a short schedule."""
    monkeypatch.setattr(tuned, "PLATE_S", 1.0)
    monkeypatch.setattr(tuned, "SHOWN_AFTER", 60)
    monkeypatch.setattr(tuned, "SCHEDULE", 200)
    monkeypatch.setattr(tuned, "ROUNDS_FIRST", 5)
    monkeypatch.setattr(tuned, "ROUNDS_AGAIN", 3)


@pytest.fixture
def shown_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """What depth teaches, too."""
    monkeypatch.setattr(depth_numbers, "SHOWN_AFTER", (20, 40))
