"""The passes over a frame that update a camera's plate: compare it with the plate, then let its pixels vote.

Frames, means and blurred frames are in steps of 255. Blurred means a mean of 3 x 3 pixels.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.jit import device_function, kernel
from edge_server.fields.splat.layers import layer_constants as tuned
from edge_server.fields.splat.layers.kernels.masks import clean_mask

MODES = 3  # colors a pixel remembers

# Bits that ``compare_with_plate`` writes, the first two in the order of its masks.
FOREGROUND, CHANGING, LIKE_STATIC = 1, 2, 4

_F0, _F1 = np.float32(0.0), np.float32(1.0)


class PlateArrays(NamedTuple):
    """What the pixels of a camera remember. The first mode is the plate.

    means, blurred: float32 (MODES, H, W, 3), running means of the frames and of the blurred frames.
    weight: float32 (MODES, H, W), decaying counts of votes, largest first.
    total: float32 (H, W), decaying count of arrivals.
    run: int32 (H, W), arrivals in a row that joined another mode than the plate.
    deviation: float32 (H, W), mean difference of background from the plate.
    known: bool (H, W), where the plate has enough votes.
    """

    means: NDArray[np.float32]
    blurred: NDArray[np.float32]
    weight: NDArray[np.float32]
    total: NDArray[np.float32]
    run: NDArray[np.int32]
    deviation: NDArray[np.float32]
    known: NDArray[np.bool_]


@device_function
def _difference(a, b, k, y, x):
    """Largest difference of a channel between a[y, x] and b[k, y, x]."""
    d0, d1, d2 = abs(a[y, x, 0] - b[k, y, x, 0]), abs(a[y, x, 1] - b[k, y, x, 1]), (abs(a[y, x, 2] - b[k, y, x, 2]))
    return max(d0, max(d1, d2))


@device_function
def _differences(a, b, scratch, out):
    """``_difference`` of a row's pixels, float32 (W, 3) each, written to float32 (W,). scratch: float32 (3 W,)."""
    left, right = a.reshape(-1), b.reshape(-1)
    for j in range(scratch.size):
        scratch[j] = abs(left[j] - right[j])
    for x in range(out.size):
        out[x] = max(scratch[3 * x], max(scratch[3 * x + 1], scratch[3 * x + 2]))


@device_function
def _blur(image, blurred):
    """Means of 3 x 3 pixels; beyond the image is what is as far within it, without the border itself."""
    height, size = image.shape[0], 3 * image.shape[1]
    sums, ninth = np.empty(size, np.int32), np.float32(1.0 / 9.0)
    for y in range(height):
        above, below = min(abs(y - 1), height - 1), y + 1 if y + 1 < height else max(y - 1, 0)
        over, here, under, row = (
            image[above].reshape(-1),
            image[y].reshape(-1),
            image[below].reshape(-1),
            blurred[y].reshape(-1),
        )
        for j in range(size):
            sums[j] = np.int32(over[j]) + np.int32(here[j]) + np.int32(under[j])
        left, right, between = sums[:-6], sums[6:], row[3:-3]
        for j in range(size - 6):
            between[j] = np.float32(left[j] + sums[j + 3] + right[j]) * ninth
        for c in range(3):
            first, last = min(c + 3, size - 3 + c), size - 3 + c
            row[c] = np.float32(sums[c] + 2 * sums[first]) * ninth
            if last > c:
                row[last] = np.float32(sums[last] + 2 * sums[last - 3]) * ninth


@kernel
def blur(image, blurred):
    """Blur a frame, uint8 (H, W, 3), into float32 (H, W, 3)."""
    _blur(image, blurred)


@kernel
def compare_with_plate(
    image, blurred, plate, earlier, lags, static, has_static, difference, flags, eights, masks, counts
):
    """Blur a frame, compare it with the plate and with earlier frames, and clean what differs.

    image: uint8 (H, W, 3). blurred: float32 (H, W, 3), written.
    plate: ``PlateArrays``.
    earlier: two of float32 (H, W, 3), blurred earlier frames, of which the first ``lags`` count.
    static: float32 (H, W, 3), the static field's rendering, blurred; read if ``has_static``.
    difference: float32 (H, W), written: difference from the plate, of the worst channel.
    flags: uint8 (H, W rounded up to a multiple of 8), written: FOREGROUND, CHANGING (differs from an earlier frame) and
        LIKE_STATIC. eights: the same as uint64.
    masks: uint8 (2, H, W), written: foreground and what changes, see ``clean_mask``. counts: int64 (2,), written: how
        many pixels of each.
    """
    height, width = difference.shape
    least, beyond = np.float32(tuned.THRESHOLD), np.float32(tuned.THRESHOLD_UNKNOWN)
    change, off, other = np.zeros(width, np.float32), np.zeros(width, np.float32), np.zeros(width, np.float32)
    scratch = np.empty(3 * width, np.float32)
    _blur(image, blurred)
    for y in range(height):
        _differences(blurred[y], plate.blurred[0, y], scratch, difference[y])
        if lags > 0:
            _differences(blurred[y], earlier[0][y], scratch, change)
        if lags > 1:
            _differences(blurred[y], earlier[1][y], scratch, other)
            for x in range(width):
                change[x] = max(change[x], other[x])
        if has_static:
            _differences(blurred[y], static[y], scratch, off)
        for x in range(width):
            d = difference[y, x]
            limit = max(least, np.float32(tuned.DEVIATIONS) * plate.deviation[y, x])
            changing = change[x] > limit
            unknown = off[x] > beyond if has_static else changing
            foreground = d > limit if plate.known[y, x] else unknown
            like = has_static & (off[x] <= least)
            flags[y, x] = (
                np.uint8(foreground) * FOREGROUND + np.uint8(changing) * CHANGING + np.uint8(like) * LIKE_STATIC
            )
    for k in range(2):
        counts[k] = clean_mask(eights, k, masks[k])


@device_function
def _swap_modes(plate, y, x, a, b):
    w, u = plate.weight[a, y, x], plate.weight[b, y, x]
    plate.weight[a, y, x], plate.weight[b, y, x] = u, w
    for c in range(3):
        m, n = plate.means[a, y, x, c], plate.means[b, y, x, c]
        plate.means[a, y, x, c], plate.means[b, y, x, c] = n, m
        m, n = plate.blurred[a, y, x, c], plate.blurred[b, y, x, c]
        plate.blurred[a, y, x, c], plate.blurred[b, y, x, c] = n, m


@device_function
def _join(plate, y, x, image, blurred):
    """Add a vote to the nearest mode, or replace the lightest mode where none is near."""
    best, nearest = -1, np.float32(1e9)
    for k in range(MODES):
        if plate.weight[k, y, x] > np.float32(tuned.LEAST_WEIGHT):
            d = _difference(blurred, plate.blurred, k, y, x)
            if d < nearest:
                nearest, best = d, k
    if nearest > np.float32(tuned.THRESHOLD):
        best = 0
        for k in range(1, MODES):
            if plate.weight[k, y, x] < plate.weight[best, y, x]:
                best = k
        plate.weight[best, y, x], plate.run[y, x], rate = _F1, 1, _F1
    else:
        plate.weight[best, y, x] += _F1
        plate.run[y, x] = 0 if best == 0 else plate.run[y, x] + 1
        rate = max(_F1 / plate.weight[best, y, x], np.float32(tuned.SLOWEST_RATE))
    for c in range(3):
        plate.means[best, y, x, c] += rate * (np.float32(image[y, x, c]) - plate.means[best, y, x, c])
        plate.blurred[best, y, x, c] += rate * (blurred[y, x, c] - plate.blurred[best, y, x, c])
    if best > 0:
        if plate.run[y, x] >= tuned.RUN:
            plate.weight[best, y, x], plate.run[y, x] = plate.weight[0, y, x] + _F1, 0
        for k in range(best, 0, -1):
            if plate.weight[k, y, x] > plate.weight[k - 1, y, x]:
                _swap_modes(plate, y, x, k, k - 1)


@device_function
def _learn(rates, seen, means):
    """Move the means of a row, (W, 3), towards what is seen by ``rates``, (3 W,)."""
    to, what = seen.reshape(-1), means.reshape(-1)
    for j in range(what.size):
        what[j] += rates[j] * (np.float32(to[j]) - what[j])


@device_function
def _is_known(weight, total):
    """A plate needs KNOWN_VOTES, or nearly all of fewer arrivals, and a share of all arrivals."""
    enough = min(np.float32(tuned.KNOWN_VOTES), np.float32(tuned.EARLY_SHARE) * total)
    return (weight >= enough) & (weight >= np.float32(tuned.KNOWN_SHARE) * total)


@kernel
def vote(image, blurred, difference, flags, foreground, changing, trusts, held, plate, static, has_static, picture):
    """Update the plate by a frame.

    image: uint8 (H, W, 3). blurred, difference, flags: as in ``compare_with_plate``.
    foreground: uint8 (H, W), pixels that are not the plate: they do not count for its deviation.
    changing: uint8 (H, W), pixels that do not vote; unless ``trusts``, and they are like the static field.
    held: uint8 (H, W), pixels that neither vote nor forget.
    plate: ``PlateArrays``, updated.
    static: float32 (H, W, 3), the static field's rendering; read if ``has_static``.
    picture: float32 (H, W, 3), written: the plate; where that is unknown, the static field.
    """
    height, width = difference.shape
    decay, learning = np.float32(1.0 - 1.0 / tuned.MEMORY), np.float32(tuned.DEVIATION_RATE)
    least, near = np.float32(tuned.LEAST_WEIGHT), np.float32(tuned.THRESHOLD)
    most = np.float32(tuned.DEVIATION_MOST)
    rates, votes, joins_another = np.empty(width, np.float32), np.empty(width, np.bool_), np.empty(width, np.bool_)
    by = np.empty(3 * width, np.float32)
    for y in range(height):
        # Row by row, in loops so small that they are vectorized.
        deviation, total, known, fixed = plate.deviation[y], plate.total[y], plate.known[y], held[y] > 0
        for x in range(width):
            d, old = difference[y, x], deviation[x]
            limit = max(near, np.float32(tuned.DEVIATIONS) * old)
            shows = (not fixed[x]) & (foreground[y, x] == 0) & known[x] & (d < most * limit)
            deviation[x] = old + (d - old) * learning if shows else old
        for x in range(width):
            total[x] = total[x] if fixed[x] else total[x] * decay + _F1
        for k in range(MODES):
            weight = plate.weight[k, y]
            for x in range(width):  # what is forgotten becomes 0: a processor is slow with subnormal numbers
                kept = weight[x] * decay
                kept = kept if kept > least else _F0
                weight[x] = weight[x] if fixed[x] else kept
        first, second, third, run = plate.weight[0, y], plate.weight[1, y], plate.weight[2, y], plate.run[y]
        for x in range(width):
            like = trusts & (foreground[y, x] == 0) & ((flags[y, x] & LIKE_STATIC) != 0)
            votes[x] = (not fixed[x]) & ((changing[y, x] == 0) | like)
        for x in range(width):
            alone = (second[x] <= least) & (third[x] <= least)
            joins = votes[x] & alone & (difference[y, x] <= near) & (first[x] > least)
            first[x] = first[x] + _F1 if joins else first[x]
            rates[x] = max(_F1 / first[x], np.float32(tuned.SLOWEST_RATE)) if joins else _F0
            joins_another[x] = votes[x] & (not joins)
        for x in range(width):
            run[x] = run[x] if joins_another[x] else 0
        for x in range(width):
            for c in range(3):
                by[3 * x + c] = rates[x]
        _learn(by, image[y], plate.means[0, y])
        _learn(by, blurred[y], plate.blurred[0, y])
        for x in range(width):
            if joins_another[x]:
                _join(plate, y, x, image, blurred)
        for x in range(width):
            known[x] = known[x] if fixed[x] else _is_known(first[x], total[x])
        shown, color, still = picture[y].reshape(-1), plate.means[0, y].reshape(-1), static[y].reshape(-1)
        for j in range(shown.size):
            shown[j] = color[j]
        if has_static:
            for x in range(width):
                if not known[x]:
                    for c in range(3):
                        shown[3 * x + c] = still[3 * x + c]


@kernel
def count_exposure(image, plate, counts):
    """Count the pixels where a frame is brighter or darker than the plate, among every fourth pixel of the
    known and well exposed plate.

    counts: int64 (3, 3), written, for each channel: pixels, those brighter and those darker than the plate by
        more than GAIN_STEP.
    """
    counts[:] = 0
    high, low = np.float32(1.0 + tuned.GAIN_STEP), np.float32(1.0 - tuned.GAIN_STEP)
    for y in range(0, image.shape[0], 2):
        for x in range(0, image.shape[1], 2):
            m = plate.means[0, y, x]
            dark, bright = min(m[0], min(m[1], m[2])), max(m[0], max(m[1], m[2]))
            if plate.known[y, x] & (dark > np.float32(tuned.DARK)) & (bright < np.float32(tuned.BRIGHT)):
                for c in range(3):
                    value = np.float32(image[y, x, c])
                    counts[c, 0] += 1
                    counts[c, 1] += np.int64(value > high * m[c])
                    counts[c, 2] += np.int64(value < low * m[c])
