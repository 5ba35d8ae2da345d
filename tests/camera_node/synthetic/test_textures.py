"""Textures: colors in range everywhere, and edges no sharper than promised."""

from __future__ import annotations

import numpy as np
import pytest

from camera_node.synthetic import textures as tx

RED, BLUE, WHITE = (0.9, 0.1, 0.1), (0.1, 0.2, 0.9), (1.0, 1.0, 1.0)
ALL = [
    tx.Plain(RED),
    tx.Noise(tx.Plain(RED), 0.2, 0.3),
    tx.Checker(RED, BLUE, 0.25),
    tx.Stripes(RED, BLUE, 0.3, axis=1),
    tx.Brick(RED, WHITE, 0.5, 0.25),
    tx.Planks(RED, BLUE, 0.3, 1.2),
    tx.Plaid(RED, BLUE, WHITE, 0.2, 0.3),
    tx.Diamonds(RED, BLUE, WHITE, 0.4, 0.5),
    tx.Books([RED, BLUE], WHITE, 0.1, 0.4),
    tx.Gradient(RED, BLUE, -1.0, 1.0),
    tx.Framed(tx.Plain(RED), BLUE, (0.5, 0.5), 0.1),
    tx.Spots(tx.Plain(RED), [(0.0, 0.0, 0.2, BLUE)]),
    tx.Bands(tx.Plain(RED), [(-0.1, 0.1, -0.1, 0.1, BLUE)]),
]


@pytest.mark.parametrize("texture", ALL, ids=lambda t: type(t).__name__)
def test_colors_are_finite_and_in_range_even_far_out(texture):
    rng = np.random.default_rng(0)
    for reach in (1.0, 1e3, 1e9):
        color = texture(rng.uniform(-reach, reach, (2, 500)))
        assert color.shape == (3, 500)
        assert np.isfinite(color).all()
        assert color.min() >= 0.0 and color.max() <= 1.0


@pytest.mark.parametrize("texture", [tx.Checker(RED, BLUE, 0.5, soft=0.05), tx.Stripes(RED, BLUE, 0.5, soft=0.05)])
def test_edges_are_as_soft_as_asked(texture):
    """No step between neighbors is steeper than a smoothstep of that width (slope 1.5 / width)."""
    u = np.linspace(-2, 2, 8001)
    steps = np.abs(np.diff(texture(np.stack([u, np.full_like(u, 0.2)])), axis=1)).max()
    assert steps <= 0.8 * 1.5 / 0.05 * (u[1] - u[0]) * 1.01
