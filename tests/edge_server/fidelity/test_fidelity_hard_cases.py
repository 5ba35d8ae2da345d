"""Fidelity on the images that break metrics: equal, black, constant, saturated, tiny, poisoned."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from edge_server.fidelity.images import ImageError
from edge_server.fidelity.lpips_weights import open_lpips
from edge_server.fidelity.psnr import PSNR_CEILING_DB, psnr
from edge_server.fidelity.scorer import Scorer
from edge_server.fidelity.ssim import ssim
from tests.conftest import data_dir

pytestmark = pytest.mark.stability
RNG = np.random.default_rng(9)
HARD = {
    "black": np.zeros((40, 40, 3)),
    "white": np.ones((40, 40, 3)),
    "nearly black": np.full((40, 40, 3), 1e-300),
    "subnormal": np.full((40, 40, 3), 5e-324),
    "gray": np.full((40, 40, 3), 0.1),
    "one pixel": np.pad(np.ones((1, 1, 3)), ((20, 19), (20, 19), (0, 0))),
    "checkers": np.indices((40, 40)).sum(0)[..., None].repeat(3, 2) % 2 * 1.0,
    "noise": RNG.random((40, 40, 3)),
    "one channel": np.concatenate([np.ones((40, 40, 1)), np.zeros((40, 40, 2))], axis=2),
}
PAIRS = list(itertools.product(HARD, HARD))


def test_every_pair_scores_finite_and_in_range_and_equal_images_score_the_most():
    for one, other in PAIRS:
        a, b = HARD[one], HARD[other]
        assert 0.0 <= psnr(a, b) <= PSNR_CEILING_DB, (one, other)
        assert -1.0 <= ssim(a, b) <= 1.0, (one, other)
        if one == other:
            assert psnr(a, b) == PSNR_CEILING_DB and ssim(a, b) == pytest.approx(1.0, abs=1e-9), one


def test_ssim_of_two_constant_images_is_the_luminance_term_alone():
    expected = (2 * 0.1 * 1.0 + 1e-4) / (0.1**2 + 1.0**2 + 1e-4)
    assert ssim(HARD["gray"], HARD["white"]) == pytest.approx(expected, abs=1e-12)


def test_lpips_of_every_pair_is_finite_and_not_negative():
    lpips, reason = open_lpips(data_dir("lpips"))
    assert lpips is not None, reason
    distances = lpips.batch(np.stack([HARD[a] for a, _ in PAIRS]), np.stack([HARD[b] for _, b in PAIRS]))
    assert np.isfinite(distances).all() and (distances >= 0.0).all()
    equal = [i for i, (a, b) in enumerate(PAIRS) if a == b]
    assert (distances[equal] == 0.0).all()


@pytest.mark.parametrize("poison", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("which", ["rendering", "held-out frame"])
def test_poison_is_refused_by_name_and_never_scored(poison, which):
    good, bad = np.full((40, 40, 3), 0.5, np.float32), np.full((40, 40, 3), 0.5, np.float32)
    bad[-1, -1, -1] = poison
    pair = (bad, good) if which == "rendering" else (good, bad)
    with pytest.raises(ImageError, match=f"{which}.*row 39, column 39"):
        Scorer().score("h", pair[0], 0, pair[1], 0)
