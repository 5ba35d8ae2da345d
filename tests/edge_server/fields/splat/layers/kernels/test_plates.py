"""The passes over a frame against the same rules, pixel by pixel, in plain Python."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from edge_server.fields.common.threads.thread_pool import CallerPool
from edge_server.fields.splat.layers.kernels.plates import (
    CHANGING,
    FOREGROUND,
    LIKE_STATIC,
    MODES,
    PlateArrays,
    blur,
    compare_with_plate,
    count_exposure,
    vote,
)
from tests.edge_server.fields.splat.layers.kernels.test_masks import cleaned

H, W = 37, 11
# In numbers, so that a change of them is seen.
THRESHOLD, THRESHOLD_UNKNOWN, DEVIATIONS = 10.0, 20.0, 3.5
MEMORY, RUN, SLOWEST_RATE = 60, 12, 1.0 / 24.0


def _plate(seed: int) -> PlateArrays:
    rng = np.random.default_rng(seed)
    weight = np.sort(rng.uniform(0, 12, (MODES, H, W)), axis=0)[::-1]
    weight[2] *= rng.random((H, W)) < 0.5
    return PlateArrays(
        rng.uniform(60, 120, (MODES, H, W, 3)).astype(np.float32),
        rng.uniform(60, 120, (MODES, H, W, 3)).astype(np.float32),
        np.ascontiguousarray(weight, np.float32),
        rng.uniform(10, 30, (H, W)).astype(np.float32),
        rng.integers(0, RUN + 2, (H, W)).astype(np.int32),
        rng.uniform(0, 6, (H, W)).astype(np.float32),
        rng.random((H, W)) < 0.7,
    )


def _frames(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Image, blurred, two earlier frames, static rendering, near the plate's colors."""
    rng = np.random.default_rng(seed)
    image = rng.integers(60, 120, (H, W, 3), np.uint8)
    blurred, static = (rng.uniform(80, 100, (H, W, 3)).astype(np.float32) for _ in range(2))
    return image, blurred, rng.uniform(80, 100, (2, H, W, 3)).astype(np.float32), static


def _masks() -> np.ndarray:
    return np.empty((2, H, W), np.uint8)


def _off(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.abs(a - b).max(axis=-1)


def test_a_frame_is_compared_with_plate_earlier_frames_and_static_field() -> None:
    plate, (image, _, earlier, static) = _plate(0), _frames(1)
    blurred, difference, masks = np.empty((H, W, 3), np.float32), np.empty((H, W), np.float32), _masks()
    flags, counts = np.zeros((H, -(-W // 8) * 8), np.uint8), np.zeros(2, np.int64)
    limit = np.maximum(np.float32(THRESHOLD), np.float32(DEVIATIONS) * plate.deviation)
    for count in (0, 1, 2):
        for has_static in (False, True):
            given = (image, blurred, plate, tuple(earlier), count, static, has_static, difference)
            CallerPool().run(compare_with_plate, *given, flags, flags.view(np.uint64), masks, counts)
            np.testing.assert_allclose(blurred, cv2.boxFilter(image, cv2.CV_32F, (3, 3)), rtol=1e-6)
            changing = np.zeros((H, W), bool)
            for k in range(count):
                changing |= _off(blurred, earlier[k]) > limit
            beyond = _off(blurred, static)
            unknown = beyond > THRESHOLD_UNKNOWN if has_static else changing
            expected = _off(blurred, plate.blurred[0])
            found = flags[:, :W]
            np.testing.assert_allclose(difference, expected, rtol=1e-6)
            np.testing.assert_array_equal(found & FOREGROUND > 0, np.where(plate.known, expected > limit, unknown))
            np.testing.assert_array_equal(found & CHANGING > 0, changing)
            np.testing.assert_array_equal(found & LIKE_STATIC > 0, has_static & (beyond <= THRESHOLD))
            for flag, mask in ((FOREGROUND, masks[0]), (CHANGING, masks[1])):
                np.testing.assert_array_equal(mask, cleaned(found & flag > 0))
            assert counts.tolist() == [masks[0].sum(), masks[1].sum()]


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (5, 1), (2, 2), (3, 70)])
def test_frames_of_any_size_are_blurred(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(0).integers(0, 256, (*shape, 3), np.uint8)
    blurred = np.empty((*shape, 3), np.float32)
    CallerPool().run(blur, image, blurred)
    np.testing.assert_allclose(blurred, cv2.boxFilter(image, cv2.CV_32F, (3, 3)), rtol=1e-6)


def _vote_plainly(p: PlateArrays, y: int, x: int, image: np.ndarray, blurred: np.ndarray) -> None:
    """One pixel that votes, by the rules of the module."""
    modes = [
        {"w": p.weight[k, y, x], "m": p.means[k, y, x].copy(), "b": p.blurred[k, y, x].copy(), "first": k == 0}
        for k in range(MODES)
    ]
    alive = [m for m in modes if m["w"] > 0.05]
    joined = min(alive, key=lambda m: _off(m["b"], blurred[y, x]), default=None)
    if joined is None or _off(joined["b"], blurred[y, x]) > THRESHOLD:
        joined = min(modes, key=lambda m: m["w"])
        joined["w"], joined["m"], joined["b"] = 1.0, image[y, x].astype(np.float32), blurred[y, x].copy()
        run = 1
    else:
        joined["w"] += 1.0
        run = 0 if joined["first"] else p.run[y, x] + 1
        rate = max(1.0 / joined["w"], SLOWEST_RATE)
        joined["m"] += rate * (image[y, x] - joined["m"])
        joined["b"] += rate * (blurred[y, x] - joined["b"])
    if not joined["first"] and run >= RUN:
        joined["w"], run = modes[0]["w"] + 1.0, 0
    modes.sort(key=lambda m: -m["w"])
    p.run[y, x] = run
    for k, m in enumerate(modes):
        p.weight[k, y, x], p.means[k, y, x], p.blurred[k, y, x] = m["w"], m["m"], m["b"]


@pytest.mark.parametrize("trusts", [False, True])
def test_votes(trusts: bool) -> None:
    rng = np.random.default_rng(3)
    image, blurred, _, static = _frames(2)
    found, plain = _plate(4), _plate(4)
    difference = _off(blurred, plain.blurred[0]).astype(np.float32)
    foreground, changing, held = ((rng.random((H, W)) < share).astype(np.uint8) for share in (0.3, 0.4, 0.2))
    flags, picture = rng.integers(0, 8, (H, W), np.uint8), np.empty((H, W, 3), np.float32)
    votes = changing == 0
    if trusts:
        votes |= (flags & LIKE_STATIC > 0) & (foreground == 0)
    frame = (image, blurred, difference, flags, foreground, changing)
    CallerPool().run(vote, *frame, trusts, held, found, static, True, picture)
    for y in range(H):
        for x in range(W):
            if held[y, x]:
                plain.run[y, x] = 0
                continue
            limit = max(THRESHOLD, DEVIATIONS * plain.deviation[y, x])
            if not foreground[y, x] and plain.known[y, x] and difference[y, x] < 3 * limit:
                plain.deviation[y, x] += 0.05 * (difference[y, x] - plain.deviation[y, x])
            plain.total[y, x] = plain.total[y, x] * (1 - 1 / MEMORY) + 1
            plain.weight[:, y, x] *= 1 - 1 / MEMORY
            plain.weight[:, y, x] *= plain.weight[:, y, x] > 0.05
            if votes[y, x]:
                _vote_plainly(plain, y, x, image, blurred)
            else:
                plain.run[y, x] = 0
            w, total = plain.weight[0, y, x], plain.total[y, x]
            plain.known[y, x] = w >= min(8, 0.9 * total) and w >= 0.3 * total
    for name, mine, theirs in zip(PlateArrays._fields, found, plain, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-5, err_msg=name)
    np.testing.assert_array_equal(picture, np.where(found.known[..., None], found.means[0], static))


def test_exposure_is_counted_where_the_plate_tells_it() -> None:
    plate, counts = _plate(5), np.zeros((3, 3), np.int64)
    plate.means[:, :10] = 10.0  # too dark
    image = np.clip(plate.means[0] * [1.0, 1.1, 0.9] + 0.5, 0, 255).astype(np.uint8)
    CallerPool().run(count_exposure, image, plate, counts)
    used = plate.known[::2, ::2][5:].sum()
    np.testing.assert_array_equal(counts, [[used, 0, 0], [used, used, 0], [used, 0, used]])
