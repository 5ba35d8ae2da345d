"""The style of figures: what is drawn is what the file shows."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import to_rgb
from PIL import Image

from edge_server.report.style import CYCLE, figure


def test_a_line_that_another_covers_keeps_its_color_in_the_legend(tmp_path):
    """A palette of few colors took a rare one for its neighbor's."""
    with figure(tmp_path / "a.png", 6) as (_, axes):
        for at in axes[:, 0]:
            for k, color in enumerate(CYCLE[:4]):
                y = np.sin(np.arange(30.0) + min(k, 1 + k // 2))
                at.plot(y, color=color, label=str(k))
                at.fill_between(range(30), y - 0.2, y + 0.2, color=color, alpha=0.15)
            at.legend()
    drawn = np.asarray(Image.open(tmp_path / "a.png").convert("RGB"), float) / 255.0
    for color in CYCLE[:4]:
        assert np.abs(drawn - to_rgb(color)).max(axis=-1).min() < 0.04, color
