from __future__ import annotations

import numpy as np
import pytest

from edge_server.fidelity.images import ImageError
from edge_server.fidelity.psnr import PSNR_CEILING_DB, psnr

RNG = np.random.default_rng(5)


def test_a_known_error_gives_the_value_of_3_31():
    truth = np.full((9, 7, 3), 100, np.uint8)
    rendering = np.full((9, 7, 3), 110, np.uint8)
    assert psnr(rendering, truth) == pytest.approx(10 * np.log10(255**2 / 100), abs=1e-9)


def test_8_bit_floating_and_transparent_images_agree():
    truth = RNG.integers(0, 256, (12, 12, 3), dtype=np.uint8)
    rendering = RNG.integers(0, 256, (12, 12, 3), dtype=np.uint8)
    assert psnr((rendering / 255).astype(np.float32), truth) == pytest.approx(psnr(rendering, truth), abs=1e-4)
    rgba = np.zeros((4, 4, 4), np.uint8)
    rgba[..., 0] = 255
    assert psnr(rgba, np.zeros((4, 4, 3))) == PSNR_CEILING_DB  # transparent red on black is black
    assert psnr(np.full((4, 4, 3), 1.7), np.ones((4, 4, 3))) == PSNR_CEILING_DB  # clipped, as a screen does


def test_a_mask_restricts_the_mean_and_an_empty_one_gives_nothing():
    truth = np.zeros((4, 4, 3))
    rendering = truth.copy()
    rendering[0, 0] = 0.1
    mask = np.zeros((4, 4), bool)
    assert psnr(rendering, truth, mask) is None
    mask[0, 0] = True
    assert psnr(rendering, truth, mask) == pytest.approx(20.0)
    mask[1, 1] = True
    assert psnr(rendering, truth, mask) == pytest.approx(20.0 + 10 * np.log10(2))


@pytest.mark.parametrize(
    "image, said",
    [
        (np.zeros((4, 4)), "rendering.*shape"),
        (np.zeros((0, 4, 3)), "rendering.*shape"),
        (np.zeros((4, 4, 2)), "rendering.*shape"),
        (np.zeros((4, 4, 3), np.int32), "rendering.*int32"),
        (np.zeros((4, 5, 3)), "5 x 4.*4 x 4"),
    ],
)
def test_what_is_no_image_is_refused_by_name(image, said):
    with pytest.raises(ImageError, match=said):
        psnr(image, np.zeros((4, 4, 3)))
