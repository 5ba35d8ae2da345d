"""Masks that are cleaned a bit a pixel against OpenCV's morphology and labels."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from edge_server.fields.common.kernels.jit import kernel
from edge_server.fields.splat.layers.kernels.masks import clean_mask

CLOSE, SPECK, HOLE = 5, 10, 0.02  # in numbers, so that a change of them is seen


@kernel
def _clean(counter, worker, eights, flag, mask):
    counter[0] = clean_mask(eights, flag, mask)


def found(mask: np.ndarray, flag: int = 0) -> np.ndarray:
    """``mask`` as the kernel cleans it; the other flags of the pixels are set."""
    flags = np.zeros((mask.shape[0], -(-mask.shape[1] // 8) * 8), np.uint8)
    flags[:, : mask.shape[1]] = 255 - (mask == 0).astype(np.uint8) * 2**flag
    out, count = np.full(mask.shape, 7, np.uint8), np.zeros(8, np.int64)
    _clean(count, 0, flags.view(np.uint64), flag, out)
    assert count[0] == out.sum()
    return out


def cleaned(mask: np.ndarray) -> np.ndarray:
    """The same by OpenCV."""
    part = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    _, label, stats, _ = cv2.connectedComponentsWithStats(part, connectivity=8)
    keep = stats[:, cv2.CC_STAT_AREA] >= SPECK
    keep[0] = False
    part = cv2.copyMakeBorder(keep[label].astype(np.uint8), *[CLOSE] * 4, cv2.BORDER_CONSTANT, value=0)
    part = cv2.morphologyEx(part, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (CLOSE, CLOSE)))
    part = np.ascontiguousarray(part[CLOSE:-CLOSE, CLOSE:-CLOSE])
    _, label, stats, _ = cv2.connectedComponentsWithStats(1 - part, connectivity=4)
    fill = stats[:, cv2.CC_STAT_AREA] <= HOLE * mask.size
    fill[0] = False
    return part | fill[label]


@pytest.mark.parametrize("seed", range(60))
def test_a_mask_is_cleaned_as_by_opencv(seed: int) -> None:
    """Blobs and dust, of any density, up to the image's border, across words of 64 pixels."""
    rng = np.random.default_rng(seed)
    height, width = (int(n) for n in rng.integers(1, 150, 2))
    coarse = rng.random(rng.integers(1, 30, 2)).astype(np.float32)
    how = (cv2.INTER_NEAREST, cv2.INTER_LINEAR)[seed % 2]
    mask = cv2.resize(coarse, (width, height), interpolation=how) > rng.uniform(0.1, 0.9)
    mask ^= rng.random(mask.shape) < rng.choice([0.0, 0.02, 0.3])
    np.testing.assert_array_equal(found(mask, seed % 3), cleaned(mask))


def test_sizes_of_specks_and_holes() -> None:
    """Ten pixels are no speck; a fiftieth of the image is a hole, and more is none."""
    mask = np.zeros((40, 70), bool)
    mask[5:7, 60:65] = mask[20:23, 60:63] = True  # 10 pixels, 9
    kept = np.zeros((40, 70), bool)
    kept[6:8, 61:66] = True  # as by OpenCV's opening, one pixel further down and to the right
    np.testing.assert_array_equal(found(mask), kept)
    for rows, filled in ((8, True), (9, False)):  # without its corners of 52 and 60 pixels; a fiftieth of 2800 is 56
        ring = np.zeros((40, 70), bool)
        ring[10 : 14 + rows, 10:22] = True
        ring[12 : 12 + rows, 12:20] = False
        assert found(ring)[13 : 13 + rows, 13:21].all() == filled


def test_nothing_and_all() -> None:
    for mask in (np.zeros((9, 9), bool), np.ones((9, 130), bool)):
        np.testing.assert_array_equal(found(mask), mask)
