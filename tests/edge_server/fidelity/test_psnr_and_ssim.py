from __future__ import annotations

import numpy as np
import pytest

from edge_server.fidelity.images import ImageError
from edge_server.fidelity.psnr import PSNR_CEILING_DB, psnr
from edge_server.fidelity.ssim import ssim

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


def reference_ssim(a, b, mask=None):
    """(3.33) window by window, with an explicit 11 x 11 Gaussian: slow, and nothing to get wrong."""
    x = np.arange(-5, 6)
    w = np.exp(-(x[:, None] ** 2 + x[None, :] ** 2) / (2 * 1.5**2))
    w /= w.sum()
    values = []
    for channel in range(3):
        for row in range(a.shape[0] - 10):
            for column in range(a.shape[1] - 10):
                if mask is not None and not mask[row : row + 11, column : column + 11].all():
                    continue
                p = a[row : row + 11, column : column + 11, channel]
                q = b[row : row + 11, column : column + 11, channel]
                mp, mq = (w * p).sum(), (w * q).sum()
                vp, vq = (w * (p - mp) ** 2).sum(), (w * (q - mq) ** 2).sum()
                cov = (w * (p - mp) * (q - mq)).sum()
                c1, c2 = 0.01**2, 0.03**2
                values.append((2 * mp * mq + c1) * (2 * cov + c2) / ((mp**2 + mq**2 + c1) * (vp + vq + c2)))
    return float(np.mean(values))


@pytest.mark.parametrize("shape", [(11, 11), (23, 17), (30, 41)])
def test_equals_the_definition(shape):
    rng = np.random.default_rng(shape[0])
    a = rng.random((*shape, 3))
    b = np.clip(a + rng.normal(0, 0.2, a.shape), 0, 1)
    assert ssim(a, b) == pytest.approx(reference_ssim(a, b), abs=1e-9)


def test_a_mask_leaves_the_windows_that_lie_wholly_within_it():
    rng = np.random.default_rng(5)
    a, b = rng.random((2, 40, 37, 3))
    mask = np.ones((40, 37), bool)
    mask[:9, 3] = mask[30, :20] = mask[39, 36] = False
    assert ssim(a, b, mask) == pytest.approx(reference_ssim(a, b, mask), abs=1e-9)
    assert ssim(a, b, np.ones_like(mask)) == ssim(a, b)
    mask[:] = False
    mask[4:15, 20:31] = True
    assert ssim(a, b, mask) == pytest.approx(reference_ssim(a[4:15, 20:31], b[4:15, 20:31]), abs=1e-9)
    mask[4, 20] = False
    assert ssim(a, b, mask) is None
    with pytest.raises(ImageError, match="at least 11 x 11"):
        ssim(a[:10], b[:10])
