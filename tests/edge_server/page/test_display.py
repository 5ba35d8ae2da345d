"""The reckoning of ``python -m tests.edge_server.page.display``."""

from __future__ import annotations

import pytest

from tests.edge_server.page.display import _FIRST, _STEP, SHADES, TICK_MS, delays


def test_a_picture_every_100_ms_appears_as_late_as_it_does_and_stands_half_as_long() -> None:
    """Each appears 70 ms after its instant, in the middle of a shade's tick, and the screen is sent twice."""
    seen = []
    for k in range(40):
        rendered_ms = 100 * k + TICK_MS / 2
        shade = _FIRST + _STEP * (int(rendered_ms) // TICK_MS % SHADES)
        seen += [(rendered_ms + 70.0, shade), (rendered_ms + 110.0, shade)]
    seen.insert(7, (900.0, 3))  # a frame in which the page shows something else
    found = delays(seen)
    assert found["pictures"] == 40 and found["pictures_per_s"] == 10.0
    assert found["appears_ms"] == {"p50": 70, "p95": 70}
    assert found["seen_mean_ms"] == pytest.approx(120, abs=1)
