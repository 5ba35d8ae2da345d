"""The passes over a frame against the same rules, pixel by pixel, in plain Python, and masks against OpenCV; what
becomes a plate, and what is foreground: a body that passes, stays, or hides in a change of light."""

import cv2
import numpy as np
import pytest

from edge_server.fields.common.kernels.jit import kernel
from edge_server.fields.splat.layers.kernels import plates
from edge_server.fields.splat.layers.kernels.masks import clean_mask
from edge_server.fields.splat.layers.kernels.plates import MODES, PlateArrays, blur, compare_with_plate, vote
from edge_server.fields.splat.layers.plates import FinePlate, Plate, plain_share
from tests.edge_server.fields.scenes import ring

H, W = 37, 11
# In numbers, so that a change of them is seen.
THRESHOLD, THRESHOLD_UNKNOWN, DEVIATIONS = 10.0, 20.0, 3.5
MEMORY, RUN, SLOWEST_RATE = 60, 12, 1.0 / 24.0
CLOSE, SPECK, HOLE = 5, 10, 0.02


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


def _off(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.abs(a - b).max(axis=-1)


def test_a_frame_is_compared_with_plate_earlier_frames_and_static_field() -> None:
    plate, (image, _, earlier, static) = _plate(0), _frames(1)
    blurred, difference = np.empty((H, W, 3), np.float32), np.empty((H, W), np.float32)
    masks = np.empty((2, H, W), np.uint8)
    flags, counts = np.zeros((H, -(-W // 8) * 8), np.uint8), np.zeros(2, np.int64)
    limit = np.maximum(np.float32(THRESHOLD), np.float32(DEVIATIONS) * plate.deviation)
    for count in (0, 1, 2):
        for has_static in (False, True):
            given = (image, blurred, plate, tuple(earlier), count, static, has_static, difference)
            compare_with_plate(*given, flags, flags.view(np.uint64), masks, counts)
            np.testing.assert_allclose(blurred, cv2.boxFilter(image, cv2.CV_32F, (3, 3)), rtol=1e-6)
            changing = np.zeros((H, W), bool)
            for k in range(count):
                changing |= _off(blurred, earlier[k]) > limit
            beyond = _off(blurred, static)
            unknown = beyond > THRESHOLD_UNKNOWN if has_static else changing
            expected = _off(blurred, plate.blurred[0])
            found = flags[:, :W]
            np.testing.assert_allclose(difference, expected, rtol=1e-6)
            np.testing.assert_array_equal(
                found & plates.FOREGROUND > 0, np.where(plate.known, expected > limit, unknown)
            )
            np.testing.assert_array_equal(found & plates.CHANGING > 0, changing)
            np.testing.assert_array_equal(found & plates.LIKE_STATIC > 0, has_static & (beyond <= THRESHOLD))
            for flag, mask in ((plates.FOREGROUND, masks[0]), (plates.CHANGING, masks[1])):
                np.testing.assert_array_equal(mask, cleaned(found & flag > 0))
            assert counts.tolist() == [masks[0].sum(), masks[1].sum()]


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (5, 1), (2, 2), (3, 70)])
def test_frames_of_any_size_are_blurred(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(0).integers(0, 256, (*shape, 3), np.uint8)
    blurred = np.empty((*shape, 3), np.float32)
    blur(image, blurred)
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
        votes |= (flags & plates.LIKE_STATIC > 0) & (foreground == 0)
    frame = (image, blurred, difference, flags, foreground, changing)
    vote(*frame, trusts, held, found, static, True, picture)
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
    plates.count_exposure(image, plate, counts)
    used = plate.known[::2, ::2][5:].sum()
    np.testing.assert_array_equal(counts, [[used, 0, 0], [used, used, 0], [used, 0, used]])


# --- plates ---------------------------------------------------------------------------------------

SIZE = 48
WALL = cv2.resize(np.random.default_rng(0).integers(60, 180, (12, 12, 3), np.uint8), (SIZE, SIZE))
BODY = slice(16, 32)


@pytest.mark.parametrize("explained", ["nothing", "the body", "by fields not asked"])
def test_a_body_that_stays_becomes_the_plate_unless_what_moves_explains_it(explained: str) -> None:
    """Of fields learned from plates that are not certain nothing is asked: they would confirm what is wrong there."""
    plate, by_itself = Plate(SIZE, SIZE), explained == "by fields not asked"
    opacity = np.zeros((SIZE, SIZE), np.float32)
    opacity[BODY, 20:30] = 1.0  # of a moving set that shows the body
    for _ in range(12):
        assert not plate.take(WALL).any()
    for k in range(20):
        image = WALL.copy()
        image[BODY, 20:30] = 250, 30, 30
        image[:, 40:] = (40, 220)[k % 2]  # a curtain that never holds still
        if explained != "nothing":
            plate.fill_unknown(image / np.float32(255.0))
            plate.exclude_explained(image, image / np.float32(255.0), opacity)
        foreground = plate.take(image, by_itself=by_itself)
    held = explained == "the body"
    assert foreground[BODY, 20:30].all() == held
    expected = WALL[20:28, 22:28] if held else np.full((8, 6, 3), (250, 30, 30))
    np.testing.assert_allclose(plate.picture[20:28, 22:28], expected, atol=1.0)
    curtain = plate.arrays.means[:2, 20:28, 45:, 0]
    assert (np.isclose(curtain, 40, atol=1) | np.isclose(curtain, 220, atol=1)).any() == held


def test_what_is_unknown_shows_and_is_compared_with_the_static_field() -> None:
    plate, image = Plate(SIZE, SIZE), WALL.copy()
    for k in range(20):
        image[:, 30:] = (40, 220)[k % 2]
        plate.take(image)
    assert not plate.known[5:-5, 36:-5].any() and plate.known[:, :26].all()
    plate.fill_unknown(np.full(WALL.shape, 99.0 / 255.0, np.float32))
    np.testing.assert_allclose(plate.picture[5:-5, 36:-5], 99.0, atol=0.1)
    np.testing.assert_allclose(plate.picture[:, :26], WALL[:, :26], atol=1.0)
    image[:, 30:] = 99
    assert not plate.take(image)[5:-5, 36:-5].any()
    image[BODY, 34:44] = 250, 30, 30
    assert plate.take(image)[BODY, 35:43].all()


def test_a_fine_plate_is_at_the_common_exposure_and_leaves_out_what_moves() -> None:
    """The mean of frames divided by their exposures: with twice the light, half the color."""
    whole = ring(2, size=2 * SIZE)[0]
    fine, away = FinePlate(whole), np.zeros((SIZE, SIZE), bool)
    away[:8] = True

    def take(color: int, gain: float) -> None:
        fine.take(np.full(whole.image.shape, color, np.uint8), away, np.full(3, gain, np.float32))

    for color, gain in ((100, 1.0), (160, 2.0), (80, 1.0)):
        assert not fine.known.any()  # of less than three frames
        take(color, gain)
    assert fine.known[20:].all() and not fine.known[:16].any() and fine.count == 3
    np.testing.assert_allclose(fine.color[20:], (100 + 80 + 80) / 3, rtol=1e-5)
    assert not fine.color[:16].any()
    for _ in range(40):
        take(100, 1.0)
    before = fine.color[20:].copy()
    take(180, 1.0)  # counts for a sixteenth
    np.testing.assert_allclose(fine.color[20:], before + (180 - before) / 16, rtol=1e-5)


def test_plain_is_what_changes_by_less_than_two_steps_within_nine_pixels() -> None:
    rng = np.random.default_rng(1)
    grained = rng.normal(128.0, 3.0, (60, 80, 3)).astype(np.float32)
    faint = rng.normal(128.0, 1.0, (60, 80, 3)).astype(np.float32)
    half = np.hstack([grained[:, :40], faint[:, :40]])  # plain where at most three of nine columns are grained
    assert plain_share([grained]) == 0.0 and plain_share([faint]) == 1.0
    assert plain_share([half]) == pytest.approx(39 / 80, abs=0.02)
    assert plain_share([half, faint]) == pytest.approx((39 / 80 + 1.0) / 2, abs=0.01)
    one = faint.copy()
    one[..., 2] = grained[..., 2]
    assert plain_share([one]) < 0.01  # one channel tells places apart


def test_a_plate_takes_images_that_are_views_of_others_and_loads_no_state_of_other_images() -> None:
    image = np.random.default_rng(0).integers(0, 256, (SIZE, SIZE, 3), np.uint8)
    one, other = Plate(SIZE, SIZE), Plate(SIZE, SIZE)
    for _ in range(4):
        one.take(image[::-1, :, ::-1])
        other.take(image[::-1, :, ::-1].copy())
    state = one.state()
    for name, array in other.state().items():
        np.testing.assert_array_equal(state[name], array)
    for name in ("weight", "total", "run", "deviation", "_held", "_frames"):
        with pytest.raises(ValueError, match=f"lacks '{name}'"):
            Plate(SIZE, SIZE).load_state(state | {name: state[name][..., :-1, :]})
